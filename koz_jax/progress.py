"""The progress bar of a training run."""

import sys
from typing import Self

from tqdm import tqdm

from koz_jax.config import TrainConfig
from koz_jax.summary import Summary


class Progress:
    """Updates done, updates per second, time left, and the last evaluation."""

    def __init__(self, config: TrainConfig, updates: int, *, enabled: bool) -> None:
        """Show the bar at ``updates`` done."""
        self._phase1 = config.curriculum.phase1.updates
        self._bar = tqdm(
            total=config.curriculum.updates,
            initial=updates,
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

    def compiling(self) -> None:
        """Say that the first chunk has to be compiled."""
        self._bar.set_description("compiling (seconds the first time, cached afterwards)")

    def advance(self, updates: int) -> None:
        """Move to ``updates`` done."""
        self._bar.set_description("phase 1" if updates <= self._phase1 else "phase 2", refresh=False)
        self._bar.update(updates - self._bar.n)

    def evaluated(self, summary: Summary) -> None:
        """Show an evaluation."""
        self._bar.set_postfix_str(
            f"success {summary.success_rate:.1%}, settled after {summary.settling_time_mean:.1f} s,"
            f" effort {summary.control_effort_mean:.0f}"
        )
