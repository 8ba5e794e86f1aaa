"""How figures look, and how they are saved.  What draws imports matplotlib through this module."""

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from koz_jax.errors import missing_extra
from koz_jax.storage import files

try:
    import matplotlib
    from matplotlib import ticker
    from matplotlib.axes import Axes as Axes
    from matplotlib.axis import Axis as Axis
    from matplotlib.backends.backend_agg import FigureCanvasAgg as FigureCanvasAgg
    from matplotlib.figure import Figure as Figure
    from matplotlib.lines import Line2D as Line2D
    from matplotlib.patheffects import withStroke
except ImportError as error:
    raise missing_extra(error, "matplotlib", "viz") from None

PNG_DPI = 200
RASTER_DPI = 300  # of point clouds inside a PDF

_LOOK: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.labelsize": 9.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "figure.titlesize": 10.5,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.linewidth": 0.4,
    "grid.color": "#D9D9D9",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.2,
    "lines.solid_capstyle": "round",  # closes a circle without a notch
    "legend.frameon": False,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "pdf.fonttype": 42,  # text stays text
}


@contextlib.contextmanager
def look() -> Iterator[None]:
    """Settings under which figures are made; ``@look()`` on what draws."""
    with matplotlib.rc_context(_LOOK):
        yield


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure without any window or global state.  width, height: [inch]."""
    return Figure(figsize=(width, height), layout="constrained")


@look()
def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as PNG and PDF.  The same figure gives the same bytes.  Returns the files."""
    picture, document = io.BytesIO(), io.BytesIO()
    figure.savefig(picture, format="png", dpi=PNG_DPI, metadata={"Software": None})
    figure.savefig(document, format="pdf", dpi=RASTER_DPI, metadata={"CreationDate": None})
    contents = {folder / f"{name}.png": picture.getvalue(), folder / f"{name}.pdf": document.getvalue()}
    for path, content in contents.items():
        files.write_bytes(path, content)
    return list(contents)


def value_ticks(axis: Axis, most: int = 5) -> None:
    """Put at most so many labelled intervals on an axis; very small and very large numbers share a power of ten."""
    axis.set_major_locator(ticker.MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]))
    formatter = ticker.ScalarFormatter(useOffset=False, useMathText=True)
    formatter.set_powerlimits((-3, 5))
    axis.set_major_formatter(formatter)


def decade_ticks(axis: Axis) -> None:
    """Write all numbers of a logarithmic axis in one form: plain over few decades, powers of ten over many."""
    low, high = sorted(axis.get_view_interval())
    are_many = high > 1e4 * low or low < 1e-4
    axis.set_major_locator(ticker.LogLocator(subs=(1.0,) if high > 100.0 * low else (1.0, 2.0, 5.0)))
    axis.set_major_formatter(ticker.LogFormatterMathtext() if are_many else ticker.FormatStrFormatter("%g"))
    axis.set_minor_formatter(ticker.NullFormatter())


def halo() -> withStroke:
    """Make a white rim around text, which keeps it readable on lines."""
    return withStroke(linewidth=2.5, foreground="white", alpha=0.8)
