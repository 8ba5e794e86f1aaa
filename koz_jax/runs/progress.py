"""The progress bar of a training run."""

import sys
from collections.abc import Sequence
from typing import Self

from tqdm import tqdm

from koz_jax.evaluation.summary import Summary
from koz_jax.runs import stages
from koz_jax.runs.stages import Stage


class Progress:
    """Updates (then refinement iterations) done, their rate, time left, and the last evaluation."""

    def __init__(self, planned: Sequence[Stage], done: int, *, enabled: bool) -> None:
        """Show the bar of a run with ``done`` updates and refinement iterations done.  planned: all of its stages."""
        self._stages = planned
        self._bar = tqdm(
            total=planned[-1].end,
            initial=done,
            unit="update",
            file=sys.stderr,
            disable=not enabled,
            dynamic_ncols=True,
            smoothing=0.1,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def note(self, text: str) -> None:
        """Print a line above the bar."""
        if not self._bar.disable:
            self._bar.write(text, file=sys.stderr)

    def warn(self, text: str) -> None:
        """Print a warning above the bar; also when there is none."""
        self._bar.write(f"warning: {text}", file=sys.stderr)

    def compiling(self) -> None:
        """Say that the first chunk has to be compiled."""
        self._bar.set_description("compiling (seconds the first time, cached afterwards)")

    def advance(self, done: int) -> None:
        """Move to ``done`` updates and refinement iterations."""
        self._bar.set_description(stages.before(self._stages, done).title, refresh=False)
        self._bar.update(done - self._bar.n)

    def evaluated(self, summary: Summary) -> None:
        """Show an evaluation."""
        self._bar.set_postfix_str(
            f"success {summary.success_rate:.1%}, settled after {summary.settling_time_mean:.1f} s,"
            f" effort {summary.control_effort_mean:.0f}"
        )
