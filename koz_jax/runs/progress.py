"""The progress bar of a training run, in time over all stages: what they took so far tells what they still take.

Work that was not measured yet is set against what was, by what it costs on CPUs in transitions of gradient updates.
"""

import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from typing import Self

from tqdm import tqdm

from koz_jax.evaluation.digits import significant
from koz_jax.evaluation.summary import Summary
from koz_jax.runs import stages
from koz_jax.runs.stages import Refinement, Stage

# Transitions of a gradient update that take as long as a step of a maneuver in refinement, also where the gradient of
# each maneuver is clipped by itself, and as a case of an evaluation.
_PER_STEP, _PER_CLIPPED_STEP = 0.35, 0.5
_PER_CASE = 100.0


@dataclasses.dataclass
class _Measured:
    """What one kind of work took.  The first time includes compilation, and counts for little."""

    first: float = 0.0  # [s] of one
    seconds: float = 0.0
    count: int = 0

    def add(self, seconds: float, count: int) -> None:
        if not self.first:
            self.first = seconds / count
        else:
            self.seconds += seconds
            self.count += count

    def each(self, guess: float) -> float:
        """[s] of one.  guess: by other work, 0 where there was none; of it and a first time, the shorter is nearer."""
        if self.count:
            return self.seconds / self.count
        return min(filter(None, (self.first, guess)), default=0.0)


def weight(stage: Stage) -> float:
    """Updates that one update, or one iteration, of a stage costs as much as."""
    if not isinstance(stage, Refinement):
        return 1.0
    config, refine = stage.config, stage.config.refine
    per_step = _PER_CLIPPED_STEP if refine.max_maneuver_gradient else _PER_STEP
    return per_step * refine.scenarios * config.refine_steps / config.sac.batch_size


def work(planned: Sequence[Stage], done: int) -> float:
    """Work until ``done``, in updates: what several runs have done can be summed up."""
    return sum(weight(stage) * min(max(done - stage.start, 0), stage.length) for stage in planned)


class TimeEstimate:
    """Time spent and left of all stages, evaluations included."""

    def __init__(self, planned: Sequence[Stage]) -> None:
        """Know nothing yet.  planned: all stages of the run."""
        self._planned = planned
        self._stages = {stage.title: _Measured() for stage in planned}
        self._evaluation = _Measured()

    def computed(self, stage: Stage, count: int, seconds: float) -> None:
        """Take note that so many updates or iterations of a stage took so long."""
        self._stages[stage.title].add(seconds, count)

    def evaluated(self, seconds: float) -> None:
        """Take note that an evaluation took so long."""
        self._evaluation.add(seconds, 1)

    def left(self, done: int) -> float | None:
        """Time [s] that is left at ``done``; None while nothing was measured."""
        return self._between(done, self._planned[-1].end) if self._per_update else None

    def share(self, done: int) -> float:
        """Share of the time that is behind at ``done``, from 0 to 1."""
        behind, ahead = self._between(0, done), self._between(done, self._planned[-1].end)
        return behind / (behind + ahead)

    @property
    def _per_update(self) -> float:
        """[s] by the latest stage that was measured, more than once if there is one; 0 if none was."""
        known = [(self._stages[stage.title], weight(stage)) for stage in reversed(self._planned)]
        often = [measured.each(0.0) / weight for measured, weight in known if measured.count]
        once = [measured.first / weight for measured, weight in known if measured.first]
        return next(iter(often + once), 0.0)

    def _between(self, begin: int, end: int) -> float:
        """Time [s] from one count to another; in units of an update while nothing was measured."""
        per_update = self._per_update or 1.0
        total = 0.0
        for stage in self._planned:
            count = min(end, stage.end) - max(begin, stage.start)
            if count > 0:
                total += count * self._stages[stage.title].each(weight(stage) * per_update)
                evaluations = stage.evaluations_between(max(begin, stage.start), min(end, stage.end))
                cases = _PER_CASE * stage.config.eval_cases / stage.config.sac.batch_size
                total += evaluations * self._evaluation.each(cases * per_update)
        return total


class Progress:
    """The share of the run's time that is behind, the time left, the stage, and the last evaluation."""

    def __init__(
        self,
        planned: Sequence[Stage],
        done: int,
        *,
        enabled: bool,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Show the bar of a run with ``done`` updates and refinement iterations done.

        planned: all of its stages; clock: tells the time [s].
        """
        self._stages = planned
        self._done = done
        self._clock = clock
        self._mark = clock()
        self._evaluated = ""
        self.estimate = TimeEstimate(planned)
        self._bar = tqdm(
            total=1.0,
            initial=self.estimate.share(done),
            file=sys.stderr,
            disable=not enabled,
            dynamic_ncols=True,
            bar_format="{desc}: {percentage:3.0f}%|{bar}| [{elapsed}{postfix}]",
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
        """Say that the first chunk has to be compiled; time counts from now on."""
        self._bar.set_description("compiling (seconds the first time, cached afterwards)")
        self._mark = self._clock()

    def advance(self, done: int) -> None:
        """Move to ``done`` updates and refinement iterations, all of one stage since the last time."""
        stage = stages.before(self._stages, done)
        if done > self._done:
            self.estimate.computed(stage, done - self._done, self._seconds())
        self._done = done
        self._bar.set_description(f"{stage.title} {done - stage.start}/{stage.length}", refresh=False)
        self._show()

    def evaluated(self, summary: Summary) -> None:
        """Show an evaluation, which followed on what was done before."""
        self.estimate.evaluated(self._seconds())
        self._evaluated = (
            f", success {summary.success_rate:.1%}, settled after {significant(summary.settling_time_mean, 1)} s,"
            f" effort {significant(summary.control_effort_mean, 0)}"
        )
        self._show()

    def _seconds(self) -> float:
        """Time since the last call [s]."""
        before, self._mark = self._mark, self._clock()
        return self._mark - before

    def _show(self) -> None:
        left = self.estimate.left(self._done)
        time_left = "" if left is None else f"{tqdm.format_interval(left)} left"
        self._bar.set_postfix_str(time_left + self._evaluated, refresh=False)
        self._bar.n = self.estimate.share(self._done)
        self._bar.refresh()
