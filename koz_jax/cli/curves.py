"""``koz curves``: learning curves of one or several runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tyro.conf import Positional

from koz_jax.cli import invocation
from koz_jax.cli.exit_status import exit_status
from koz_jax.cli.flags import parsing
from koz_jax.config.base import Settings
from koz_jax.errors import SettingsError


class CurvesFlags(Settings):
    """Draw the learning curves of runs: the evaluations on the way, median and spread over the runs."""

    runs: Positional[tuple[Path, ...]]
    """Folders of runs, for example of the same preset with several seeds."""
    out: Path = Path("figures")
    """Folder for learning.png and learning.pdf."""


def main(argv: Sequence[str]) -> int:
    """Read and draw.  Returns the exit status."""
    return exit_status(lambda: _draw(parsing.parse(CurvesFlags, argv, invocation.command("curves"))))


def _draw(asked: CurvesFlags) -> int:
    from koz_jax.figures import learning, style
    from koz_jax.storage import files

    if not asked.runs:
        raise SettingsError("runs: give the folder of one run or more")
    shown = learning.read_curves(asked.runs)
    if not len(shown.done):
        raise SettingsError(f"runs: no evaluation in {', '.join(map(str, asked.runs))} yet")
    files.make_folder("out", asked.out)
    names = ", ".join(run.resolve().name for run in asked.runs[:4]) + (", ..." if len(asked.runs) > 4 else "")
    for path in style.save(learning.draw(shown, f"Learning curves: {names}"), asked.out, "learning"):
        print(f"figure: {path}")
    return 0
