"""The progress bar counts time over all stages, evaluations included; told by a clock that the test turns."""

import re

import pytest
from support import tiny

from koz_jax.evaluation.summary import PAPER_TABLE
from koz_jax.runs import progress, stages
from koz_jax.runs.progress import Progress, TimeEstimate

# 64 updates of each phase with an evaluation every 32, and 8 iterations with one every 4.
PLANNED = stages.plan(tiny.CONFIG)
FIRST, SECOND, REFINE = PLANNED
RATIO = progress.weight(REFINE)
CASES = 100.0 * 12 / 16  # updates that an evaluation is guessed to cost


class Clock:
    """A clock that stands unless it is moved."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_evaluations_are_counted_as_the_run_makes_them():
    for stage in PLANNED:
        made = [done for done in range(stage.start + 1, stage.end + 1) if stage.is_evaluated_at(done)]
        for begin in range(stage.start, stage.end + 1):
            for end in range(begin, stage.end + 1):
                assert stage.evaluations_between(begin, end) == sum(begin < done <= end for done in made)


def test_an_iteration_weighs_as_much_as_its_maneuvers():
    """A step of one is a third of a transition, half where each maneuver's gradient is clipped."""
    assert RATIO == pytest.approx(0.35 * (4 * 10) / 16)
    clipped = stages.plan(tiny.changed({"refine": {"max_maneuver_gradient": 0.1}}))[-1]
    assert progress.weight(clipped) == pytest.approx(0.5 * (4 * 10) / 16)
    assert progress.weight(FIRST) == 1.0
    assert progress.work(PLANNED, 0) == 0.0
    assert progress.work(PLANNED, 136) == pytest.approx(128 + 8 * RATIO)


def test_what_was_measured_tells_what_is_left():
    estimate = TimeEstimate(PLANNED)
    assert estimate.left(0) is None and estimate.share(0) == 0.0
    estimate.computed(FIRST, 16, 40.0)  # compiled on the way
    estimate.computed(FIRST, 16, 8.0)
    estimate.evaluated(30.0)
    estimate.evaluated(3.0)
    # 96 updates of 0.5 s, 8 iterations of so many updates; of 6 evaluations, 1 is behind
    assert estimate.left(32) == pytest.approx(96 * 0.5 + 8 * RATIO * 0.5 + 5 * 3.0)
    left = 96 * 0.5 + 8 * RATIO * 0.5 + 5 * 3.0
    assert estimate.share(32) == pytest.approx((32 * 0.5 + 3.0) / (32 * 0.5 + 3.0 + left))
    # Each stage then tells by itself, but not what it compiles at first.
    estimate.computed(SECOND, 16, 160.0)
    assert estimate.left(80) == pytest.approx(48 * 0.5 + 8 * RATIO * 0.5 + 4 * 3.0)
    estimate.computed(SECOND, 16, 16.0)
    estimate.computed(REFINE, 2, 50.0)
    assert estimate.left(80) == pytest.approx(48 * 1.0 + 8 * RATIO * 1.0 + 4 * 3.0)
    estimate.computed(REFINE, 2, 20.0)
    assert estimate.left(132) == pytest.approx(4 * 10.0 + 3.0)
    assert estimate.left(136) == 0.0 and estimate.share(136) == 1.0


def test_the_bar_of_a_whole_run_tells_the_time_that_it_takes(capsys):
    """Updates of 0.5 s, iterations of 20 s, evaluations of 4 s: 64 + 160 + 24 s, which it knows once all were met."""
    clock, took = Clock(), {"update": 0.5, "iteration": 20.0, "evaluation": 4.0}
    total = 128 * took["update"] + 8 * took["iteration"] + 6 * took["evaluation"]
    done, told, spent = 0, {}, 0.0
    with Progress(PLANNED, 0, enabled=True, clock=clock) as bar:
        bar.compiling()
        while (stage := stages.after(PLANNED, done)) is not None:
            end = stage.chunk_end(done)
            each = took["iteration" if stage is REFINE else "update"]
            clock.now += each * (end - done)
            spent += each * (end - done)
            done = end
            bar.advance(done)
            if stage.is_evaluated_at(done):
                clock.now += took["evaluation"]
                spent += took["evaluation"]
                bar.evaluated(PAPER_TABLE)
            told[done] = (bar.estimate.left(done), total - spent, bar.estimate.share(done))
    for at in (132, 136):  # the refinement has been met
        assert told[at][0] == pytest.approx(told[at][1])
    assert told[132][2] == pytest.approx(1.0 - told[132][1] / total, abs=0.01)
    # Before, the share is behind the truth only by what the ratio of an iteration is off.
    assert told[128][0] == pytest.approx(8 * RATIO * took["update"] + 2 * took["evaluation"])
    assert told[136][2] == 1.0
    shown = capsys.readouterr().err
    assert re.search(r"refine 4/8: .*00:44 left, success 97\.0%, settled after 27\.8 s, effort 76\.0", shown)
    assert "100%" in shown.rpartition("refine 8/8")[2]


def test_a_resumed_run_begins_where_it_stopped(capsys):
    clock = Clock()
    with Progress(PLANNED, 128, enabled=True, clock=clock) as bar:
        bar.compiling()
        clock.now += 30.0
        bar.advance(130)
        assert bar.estimate.left(130) == pytest.approx(6 * 15.0 + 2 * CASES * 15.0 / RATIO)
        clock.now += 20.0
        bar.advance(132)
        assert bar.estimate.left(132) == pytest.approx(4 * 10.0 + CASES * 10.0 / RATIO)
    assert "refine 4/8" in capsys.readouterr().err
