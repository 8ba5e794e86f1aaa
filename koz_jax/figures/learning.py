"""Learning curves of one or several runs: read from their logs, brought to common instants, drawn."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from koz_jax.config.task import is_paper_task
from koz_jax.errors import SettingsError, StorageError
from koz_jax.evaluation.summary import PAPER_TABLE
from koz_jax.figures import palette, wording
from koz_jax.runs.folder import RunFolder

if TYPE_CHECKING:
    from koz_jax.figures.style import Axes, Figure

# Share of the time axis that the refinement gets; its iterations are few, but each is a batch of whole maneuvers.
_REFINEMENT_SHARE = 0.2


@dataclasses.dataclass(frozen=True)
class _Panel:
    """One curve: its column, its axis, the factor to the axis' unit, and the paper's value in the column's unit."""

    column: str
    label: str
    factor: float
    paper: float
    logarithmic: bool = False


_PANELS = (
    _Panel("eval/mean_reward", "mean reward [-]", 1.0, PAPER_TABLE.mean_reward),
    _Panel("eval/success_rate", "success [%]", 100.0, PAPER_TABLE.success_rate),
    _Panel("eval/violation_rate", "zone violated [%]", 100.0, PAPER_TABLE.violation_rate),
    _Panel("eval/settling_time_mean", "settling time [s]", 1.0, PAPER_TABLE.settling_time_mean),
    _Panel("eval/control_effort_mean", "control effort [N² m² s]", 1.0, PAPER_TABLE.control_effort_mean),
    _Panel(
        "eval/control_accuracy_deg_mean", "control accuracy [deg]", 1.0, PAPER_TABLE.control_accuracy_deg_mean, True
    ),
)

# Those of a run's ``metrics.csv`` that are drawn.
COLUMNS = ("updates", "curriculum/phase", "refine/cost", *(panel.column for panel in _PANELS))


@dataclasses.dataclass(frozen=True)
class Stages:
    """Where a run passes from one stage to the next, counted in updates and then iterations."""

    phase1: int  # updates of phase 1
    learned: int  # updates of both phases
    length: int  # and iterations of refinement

    def position(self, done: np.ndarray | float) -> np.ndarray:
        """Place on the time axis, in [0, 1]; the refinement gets a fixed share of it."""
        if not 0 < self.learned < self.length:
            return np.asarray(done) / max(self.length, 1)
        return np.asarray(np.interp(done, [0, self.learned, self.length], [0.0, 1.0 - _REFINEMENT_SHARE, 1.0]))


@dataclasses.dataclass(frozen=True)
class Curves:
    """The evaluations of several runs at common instants; nan where a run has none."""

    done: np.ndarray  # (instants,) updates, then iterations
    values: dict[str, np.ndarray]  # by column: (runs, instants)
    stages: Stages
    is_paper_task: bool = False  # whether the paper's numbers are of what was learned


def read_metrics(run: Path) -> dict[str, np.ndarray]:
    """Read the columns of a run's ``metrics.csv`` that are drawn.  Returns arrays (rows,), nan where a cell is empty.

    Raises:
        SettingsError: there is no such file.
        StorageError: it is not one that a training wrote.

    """
    path = run / "metrics.csv"
    if not path.is_file():
        raise SettingsError(f"runs: {run} is not a run folder (it has no metrics.csv)")
    try:
        # A training under way may not have finished its last line.
        lines = path.read_bytes().decode("utf-8").rpartition("\n")[0]
        rows = list(csv.DictReader(io.StringIO(lines), strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise StorageError(f"{path}: cannot be read as CSV: {error}") from None
    if not rows:
        raise StorageError(f"{path}: has no rows yet; the run has logged nothing")
    missing = [name for name in COLUMNS if name not in rows[0]]
    if missing:
        raise StorageError(f"{path}: has no column {missing[0]!r}; it is not a training's log")
    try:
        columns = {name: np.array([float(row[name] or "nan") for row in rows]) for name in COLUMNS}
    except ValueError as error:
        raise StorageError(f"{path}: a cell is not a number: {error}") from None
    if not np.isfinite(columns["updates"]).all():
        raise StorageError(f"{path}: has a row without its number of updates")
    return columns


def stages(logs: list[dict[str, np.ndarray]]) -> Stages:
    """Find the stages of the longest run, which stand for all.

    Raises:
        SettingsError: the refinement of some begins where others still learn; one axis cannot show both.

    """

    def last(log: dict[str, np.ndarray], rows: np.ndarray) -> int:
        return int(np.max(log["updates"][rows], initial=0.0))

    begins = {last(log, np.isnan(log["refine/cost"])) for log in logs if np.isfinite(log["refine/cost"]).any()}
    if len(begins) > 1:
        raise SettingsError(f"runs: draw runs of one preset together; these learned for {sorted(begins)} updates")
    log = max(logs, key=lambda log: log["updates"].max())
    learning, in_phase1 = np.isnan(log["refine/cost"]), log["curriculum/phase"] == 1
    # The row at the end of phase 1 carries the curriculum of what comes next: phase 2.
    ended = learning & ~in_phase1
    if not in_phase1.any():
        phase1 = 0
    else:
        phase1 = int(log["updates"][ended].min()) if ended.any() else last(log, learning)
    return Stages(phase1, learned=last(log, learning), length=last(log, np.ones_like(learning)))


def read_curves(runs: Sequence[Path]) -> Curves:
    """Read the logs of runs, and whether all of them learn the paper's task.

    Raises:
        SettingsError: a folder is not a run's, or the runs cannot share an axis.
        StorageError: a file of a run cannot be read.

    """
    logs = [read_metrics(run) for run in runs]
    return curves(logs, is_paper_task=all(_learns_the_papers_task(RunFolder(run)) for run in runs))


def _learns_the_papers_task(run: RunFolder) -> bool:
    """Whether the run's settings say so; without them nothing is known."""
    return run.config.is_file() and is_paper_task(run.read_config().task)


def curves(logs: list[dict[str, np.ndarray]], is_paper_task: bool = False) -> Curves:
    """Bring the evaluations of several runs to common instants; between its own a run is interpolated."""
    evaluated = [np.isfinite(log["eval/mean_reward"]) for log in logs]
    done = np.unique(np.concatenate([log["updates"][rows] for log, rows in zip(logs, evaluated, strict=True)]))

    def at_instants(log: dict[str, np.ndarray], column: str) -> np.ndarray:
        known = np.isfinite(log[column])
        if not known.any():
            return np.full(len(done), np.nan)
        return np.interp(done, log["updates"][known], log[column][known], left=np.nan, right=np.nan)

    values = {panel.column: np.stack([at_instants(log, panel.column) for log in logs]) for panel in _PANELS}
    return Curves(done, values, stages(logs), is_paper_task)


def draw(shown: Curves, title: str = "") -> Figure:
    """Draw the curves: the median of the runs as a line, from the lowest to the highest as a band.

    The paper's values are drawn where the runs learn its task.
    """
    from koz_jax.figures import style

    with style.look():
        figure = style.new_figure(6.8, 7.0)
        panels = figure.subplots(3, 2, sharex=True)
        for axes, panel in zip(panels.flat, _PANELS, strict=True):
            _draw_panel(axes, _in_shown_unit(panel, shown), shown)
            _draw_stages(axes, shown.stages)
        for column in panels.T:
            figure.align_ylabels(column)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        # The label of the common time axis heads the legend: the layout makes room for one thing below the panels.
        label = "gradient updates, + refinement iterations"
        figure.legend(handles, labels, title=label, title_fontsize=9, loc="outside lower center", ncols=len(handles))
        figure.suptitle(title)
    return figure


def _in_shown_unit(panel: _Panel, shown: Curves) -> _Panel:
    """Efforts are shown in a unit that suits the spacecraft."""
    if panel.column != "eval/control_effort_mean":
        return panel
    values = shown.values[panel.column]
    unit = wording.effort_unit(float(np.max(values, initial=0.0, where=np.isfinite(values))))
    return dataclasses.replace(panel, label=f"control effort [{unit.name}]", factor=unit.factor)


def _draw_panel(axes: Axes, panel: _Panel, shown: Curves) -> None:
    from koz_jax.figures import style

    values = panel.factor * shown.values[panel.column]
    known = np.isfinite(values).any(axis=0)
    x, values = shown.stages.position(shown.done[known]), values[:, known]
    runs = len(values)
    if runs > 1:
        low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
        axes.fill_between(
            x, low, high, color=palette.SKY, alpha=0.45, linewidth=0, label=f"lowest to highest of {runs}"
        )
    label = f"median of {runs} runs" if runs > 1 else "evaluation during training"
    axes.plot(x, np.nanmedian(values, axis=0), color=palette.BLUE, marker=".", markersize=4, label=label)
    if shown.is_paper_task:
        label = "paper's agent, 10,000 cases"
        axes.axhline(panel.factor * panel.paper, color=palette.VERMILLION, linestyle="--", linewidth=1.0, label=label)
    axes.set_ylabel(panel.label)
    if panel.logarithmic:
        axes.set_yscale("log")
        style.decade_ticks(axes.yaxis)
    else:
        style.value_ticks(axes.yaxis)


def _draw_stages(axes: Axes, found: Stages) -> None:
    """Separate and name the stages; ticks say where each ends."""
    ends = {"phase 1": found.phase1, "phase 2": found.learned, "refine": found.length}
    begin, ticks = 0, {0.0: "0"}
    for name, end in ends.items():
        if end <= begin:
            continue
        left, right = (float(found.position(at)) for at in (begin, end))
        axes.text(0.5 * (left + right), 1.01, name, transform=axes.get_xaxis_transform(), ha="center", fontsize=7.5)
        axes.axvline(right, color=palette.GREY, linewidth=0.8, linestyle=":")
        ticks[right] = _count(end) if name != "refine" else f"+{_count(end - begin)}"
        begin = end
    axes.set_xticks(list(ticks), list(ticks.values()))
    axes.set_xlim(0.0, 1.02)


def _count(number: int) -> str:
    """A count in few characters: 400, 40k, 2.5M."""
    factor, unit = (1e6, "M") if number >= 1e6 else (1e3, "k") if number >= 1e3 else (1.0, "")
    return f"{number / factor:.3g}{unit}"
