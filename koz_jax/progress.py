"""The progress bar of a training run."""

import sys
from typing import Self

from tqdm import tqdm

from koz_jax.config import TrainConfig
from koz_jax.summary import Summary


class Progress:
    """Updates (then refinement iterations) done, their rate, time left, and the last evaluation."""

    def __init__(self, config: TrainConfig, done: int, *, enabled: bool) -> None:
        """Show the bar with ``done`` updates and refinement iterations done."""
        self._stages = (
            (config.curriculum.phase1.updates, "phase 1"),
            (config.curriculum.updates, "phase 2"),
            (config.length, "refine"),
        )
        self._bar = tqdm(
            total=config.length,
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
        self._bar.set_description(next(name for end, name in self._stages if done <= end), refresh=False)
        self._bar.update(done - self._bar.n)

    def evaluated(self, summary: Summary) -> None:
        """Show an evaluation."""
        self._bar.set_postfix_str(
            f"success {summary.success_rate:.1%}, settled after {summary.settling_time_mean:.1f} s,"
            f" effort {summary.control_effort_mean:.0f}"
        )
