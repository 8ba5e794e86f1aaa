"""What is measured of a peer: its declared result, and the clock that measures it."""

import itertools
import math
import time
from collections.abc import Sequence

from mlp import MlpController, evaluate

from koz_jax.config.base import Settings
from koz_jax.config.task import TaskConfig
from koz_jax.evaluation.summary import Summary

TARGETS = (0.5, 0.9, 0.95, 0.99)


class Point(Settings):
    """How far a training was at one moment."""

    seconds: float
    """Training time so far [s]."""
    env_steps: int
    """Environment steps so far."""
    updates: int
    """Gradient updates so far."""
    success_rate: float
    """Share of the evaluation's cases that settled without a violation."""
    mean_reward: float
    """Mean reward of the evaluation's cases."""


class PeerResult(Settings):
    """What came of one peer."""

    name: str
    """Name of the peer."""
    recipe: str
    """Its settings in words."""
    version: str
    """Version of the library."""
    minutes: float
    """Training time it was given [min]."""
    cores: int
    """CPU cores it could use."""
    load_before: float
    """Load average of the machine over the minute before."""
    load_after: float
    """Load average over its last minute."""
    points: tuple[Point, ...]
    """Evaluations on the way."""
    updates_per_second: float | None
    """Gradient updates per second at the paper's sizes, in the best stretch; None with too few evaluations."""
    cases: int
    """Cases of the final Monte Carlo."""
    table: dict[str, float | None]
    """The final Monte Carlo of its best policy; None where there is no settled case to average over."""

    def seconds_to(self, success_rate: float) -> float | None:
        """Training time to the first evaluation with this success rate; None if there is none [s]."""
        return next((point.seconds for point in self.points if point.success_rate >= success_rate), None)

    def updates_to(self, success_rate: float) -> int | None:
        """Gradient updates to the first evaluation with this success rate; None if there is none."""
        return next((point.updates for point in self.points if point.success_rate >= success_rate), None)


class OutOfTimeError(Exception):
    """The training time is spent."""


class Recorder:
    """Evaluates a policy now and then, with a clock that stands still meanwhile."""

    def __init__(self, minutes: float, every_s: float = 15.0, cases: int = 1000) -> None:
        """Start the clock."""
        self.points: list[Point] = []
        self.best: MlpController | None = None
        self._limit_s = 60.0 * minutes
        self._every_s = every_s
        self._cases = cases
        self._score = (-math.inf, -math.inf)
        self._evaluating_s = 0.0
        self._start = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Training time so far [s]."""
        return time.perf_counter() - self._start - self._evaluating_s

    @property
    def due(self) -> bool:
        """Whether it is time to evaluate again."""
        last = self.points[-1].seconds if self.points else 0.0
        return self.seconds >= min(last + self._every_s, self._limit_s)

    def record(self, env_steps: int, updates: int, controller: MlpController) -> None:
        """Evaluate a policy and keep the best.

        Raises:
            OutOfTimeError: the training time is spent.

        """
        seconds, paused = self.seconds, time.perf_counter()
        summary = evaluate(controller, TaskConfig(), self._cases)
        score = (summary.success_rate, summary.mean_reward)
        if score > self._score:
            self._score, self.best = score, controller
        self.points.append(
            Point(
                seconds=seconds,
                env_steps=env_steps,
                updates=updates,
                success_rate=summary.success_rate,
                mean_reward=summary.mean_reward,
            )
        )
        print(
            f"  {seconds:5.0f} s, {updates} updates: {summary.success_rate:.1%}, {summary.mean_reward:.0f}", flush=True
        )
        self._evaluating_s += time.perf_counter() - paused
        if seconds >= self._limit_s:
            raise OutOfTimeError


def rate(points: Sequence[Point]) -> float | None:
    """Gradient updates per second in the best stretch between two evaluations, as others may use the machine too."""
    learning = [point for point in points if point.updates > 0]
    stretches = itertools.pairwise(learning)
    return max(((b.updates - a.updates) / (b.seconds - a.seconds) for a, b in stretches), default=None)


def rows(summary: Summary) -> dict[str, float | None]:
    """A summary for JSON."""
    return {name: None if math.isnan(value) else value for name, value in vars(summary).items()}
