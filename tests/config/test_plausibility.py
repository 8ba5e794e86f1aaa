"""Units of magnitude: what cannot be meant is said before anything is computed, with the number."""

import logging
import math

import numpy as np
import pytest
from support.tiny import MANEUVER_FILES

from koz_jax.agents.record import read_agent_record, shipped_agents, shipped_folder
from koz_jax.config import plausibility
from koz_jax.config.actuators.agility import Agility, about, agilities, rate_at_start
from koz_jax.config.maneuvers.maneuver_file import load_maneuver
from koz_jax.config.presets.named import PRESETS, preset
from koz_jax.config.task import SpacecraftConfig, TaskConfig
from koz_jax.errors import SettingsError
from koz_jax.task.environment import model_from_config
from koz_jax.task.state import nominal_rate

INERTIA = ((60.0, 5.0, 1.0), (5.0, 50.0, 2.0), (1.0, 2.0, 70.0))
CUBESAT = {"inertia": ((0.05, 0.0, 0.0), (0.0, 0.06, 0.0), (0.0, 0.0, 0.02)), "torque_limit": 0.004}
SMALLSAT = {"inertia": ((12.0, 0.0, 0.0), (0.0, 10.0, 0.0), (0.0, 0.0, 8.0)), "torque_limit": (0.4, 0.4, 0.3)}


def scaled(inertia: tuple[tuple[float, ...], ...], factor: float) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(factor * entry for entry in row) for row in inertia)


def task(step_seconds: float = 0.1, **spacecraft: object) -> TaskConfig:
    return TaskConfig.model_validate({"spacecraft": spacecraft, "step_seconds": step_seconds})


@pytest.mark.parametrize(
    "sound",
    [
        *(config.task for config in PRESETS.values()),
        *(read_agent_record(shipped_folder() / name).task for name in shipped_agents()),
        task(0.2, **CUBESAT),
        task(0.5, **CUBESAT),
        task(**SMALLSAT),
    ],
)
def test_the_papers_task_and_the_examples_are_silent(sound, caplog):
    assert plausibility.findings(sound, 80.0, 180.0) == []
    plausibility.check(sound, 80.0, 180.0)
    assert caplog.records == []


@pytest.mark.parametrize(
    ("wrong", "seconds"),
    [
        # kg mm^2 in place of kg m^2: a thousand times as long as the 80 deg turn of the paper's body
        (task(inertia=scaled(INERTIA, 1e6)), 1.11e4),
        # g cm^2 in place of kg m^2
        (task(0.2, **(CUBESAT | {"inertia": scaled(CUBESAT["inertia"], 1e7)})), 1.67e4),
        # mN m were meant, and N m given to a body of tonnes
        (task(inertia=scaled(INERTIA, 1e3)), 352.0),
    ],
)
def test_too_heavy_a_body_is_refused_with_the_time_of_its_fastest_turn(wrong, seconds):
    with pytest.raises(SettingsError) as refused:
        plausibility.check(wrong, 80.0, 180.0)
    message = str(refused.value)
    assert message.startswith("task.spacecraft: a turn by 80 deg takes ") and "kg m^2 and N m?" in message
    assert float(message.split()[7]) == pytest.approx(seconds, rel=0.01)


def test_a_body_that_manages_only_some_turns_is_warned_of(caplog):
    sluggish = TaskConfig.model_validate({"episode_seconds": 18.0})
    with caplog.at_level(logging.WARNING):
        plausibility.check(sluggish, 80.0, 180.0)
    (record,) = caplog.records
    assert "a turn by 180 deg takes 20.8 s or more" in record.getMessage()


def test_a_training_episode_that_is_too_short_for_the_body_is_warned_of(caplog):
    """The body turns by 180 deg in 34 s: episodes of 100 s and of 40 s hold that, a refinement of 30 s does not."""
    refine = preset("fast").refine.model_copy(update={"horizon_seconds": 30.0})
    slow = preset("fast").model_copy(update={"task": task(inertia=INERTIA, torque_limit=0.75), "refine": refine})
    with caplog.at_level(logging.WARNING):
        plausibility.check_training(slow)
    (record,) = caplog.records
    assert record.getMessage().startswith("refine.horizon_seconds: is 30 s, and a turn by 180 deg takes 34")


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_silent(name, caplog):
    plausibility.check_training(PRESETS[name])
    assert caplog.records == []


def test_too_agile_a_body_is_warned_of(caplog):
    """A 1U with 2 N m: u dt^2 / J is 12 rad a step."""
    with caplog.at_level(logging.WARNING):
        plausibility.check(task(inertia=((0.0017, 0, 0), (0, 0.0017, 0), (0, 0, 0.0017))), 80.0, 180.0)
    (record,) = caplog.records
    assert "11.8 rad a step" in record.getMessage()


def test_a_half_angle_that_is_never_drawn_is_told():
    too_wide = TaskConfig.model_validate({"scenario": {"max_half_angle_deg": 95.0}})
    with pytest.raises(SettingsError, match=r"max_half_angle_deg: is never drawn above 88 deg.*got 95"):
        plausibility.check(too_wide, 80.0, 180.0)
    # Under a narrower draw the same default is only a remark.
    (found,) = plausibility.findings(TaskConfig(), 40.0, 60.0)
    assert "never drawn above 28 deg" in found.text and not found.hopeless


def test_the_fastest_turn_is_that_of_a_bang_bang_torque():
    """Half the way with full torque, half against it, integrated; about an axis that is not a body axis too."""
    agility = Agility(moment=50.0, torque=2.0)
    seconds = agility.turn_seconds(180.0)
    assert seconds == pytest.approx(2.0 * math.sqrt(math.pi * 50.0 / 2.0))
    times = np.linspace(0.0, seconds, 100_001)
    rate = np.cumsum(np.where(times < seconds / 2, 1.0, -1.0) * 2.0 / 50.0) * times[1]
    assert np.sum(rate) * times[1] == pytest.approx(math.pi, rel=1e-3) and rate[-1] == pytest.approx(0.0, abs=1e-3)
    turned = np.array([[1, -1, 0], [1, 1, 0], [0, 0, math.sqrt(2)]]) / math.sqrt(2)
    body = turned @ np.diag([1.0, 2.0, 2.5]) @ turned.T
    spacecraft = SpacecraftConfig.model_validate({"inertia": body.tolist(), "torque_limit": 1.0})
    # Along a diagonal of two axes the box holds sqrt(2) times the torque.
    found = {round(agility.moment, 6): agility.torque for agility in agilities(spacecraft)}
    assert found == pytest.approx({1.0: math.sqrt(2), 2.0: math.sqrt(2), 2.5: 1.0})
    for moment, axis_B in zip((1.0, 2.0, 2.5), turned.T, strict=True):
        assert about(spacecraft, axis_B) == pytest.approx((moment, found[moment]))


def test_a_turn_at_a_largest_rate_speeds_up_coasts_and_brakes():
    agility, rate = Agility(moment=50.0, torque=2.0), math.radians(0.5)
    assert agility.turn_seconds(120.0, rate) == pytest.approx(240.0 + rate / agility.acceleration)
    fastest = math.sqrt(math.pi * agility.acceleration)  # in the middle of a half turn
    assert agility.turn_seconds(180.0, fastest) == pytest.approx(agility.turn_seconds(180.0))
    assert agility.turn_seconds(180.0, 2.0 * fastest) == agility.turn_seconds(180.0)
    assert agility.turn_seconds(180.0, 0.0) == math.inf


@pytest.mark.parametrize("name", ["leo_6u", "cmg_smallsat", "minxss_3u", "cubesat_6u"])
def test_the_largest_rate_is_what_the_actuators_say_at_the_start(name):
    own = load_maneuver(MANEUVER_FILES[name]).task.spacecraft
    start = nominal_rate(model_from_config(TaskConfig(spacecraft=own)))
    assert rate_at_start(own) == pytest.approx(math.inf if start is None else float(start), rel=1e-4)


def test_a_turn_that_takes_too_long_at_the_largest_rate_is_told_and_not_refused(caplog):
    """Not all controllers keep it, so that something may be learned."""
    with caplog.at_level(logging.WARNING):
        plausibility.check(task(max_rate_deg=0.5), 80.0, 180.0)
    (record,) = caplog.records
    assert "a turn by 180 deg takes 360 s or more at 0.5 deg/s, the largest rate (max_rate_deg)" in record.getMessage()
