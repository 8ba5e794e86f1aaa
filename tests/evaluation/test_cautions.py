"""What an agent was not made for is said, once and by name; what it was made for passes in silence."""

import dataclasses
import logging

import jax.numpy as jnp
import pytest
from support import tiny

from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import TaskConfig
from koz_jax.config.training import NetworkConfig
from koz_jax.control.registry import load_controller
from koz_jax.evaluation import cases, cautions, monte_carlo
from koz_jax.task import scenario

AGENT = tiny.untrained_agent()
OWN = AGENT.task


@pytest.fixture
def said(caplog):
    """What was said until now, and clear it."""

    def take() -> list[str]:
        found = [record.getMessage() for record in caplog.records]
        caplog.clear()
        return found

    with caplog.at_level(logging.WARNING):
        yield take


def changed(**changes: object) -> TaskConfig:
    return TaskConfig.model_validate(tiny.merged(OWN.model_dump(), changes))


CHANGES = [
    ({"step_seconds": 0.5}, ["a time step of 0.5 s in place of 0.1"]),
    ({"spacecraft": {"torque_limit": (2.0, 2.0, 1.0)}}, ["torque limits of 2, 2, 1 N m in place of 2, 2, 2"]),
    ({"spacecraft": {"boresight": (0.0, 0.0, 1.0)}}, ["the boresight 0, 0, 1 in place of 1, 0, 0"]),
    (
        {"spacecraft": {"inertia": ((60.0, 0.0, 0.0), (0.0, 50.0, 0.0), (0.0, 0.0, 90.0))}},
        ["moments of inertia of 60, 50, 90 kg m^2 in place of 60, 50, 70", "products of inertia of 0, 0, 0"],
    ),
    ({"scenario": {"separation_deg": 0.5}}, ["0.5 deg between zones and target in place of 2"]),
    ({"scenario": {"max_half_angle_deg": 40.0}}, ["half angles up to 40 deg in place of 30"]),
    ({"scenario": {"max_rate_deg": 2.0}}, ["initial rates up to 2 deg/s in place of 0.001"]),
    ({"scenario": {"max_zones": 3}}, ["it sees the nearest zone of up to 3"]),
]


@pytest.mark.parametrize(("changes", "words"), CHANGES, ids=[words[0] for _, words in CHANGES])
def test_another_task_is_told_in_one_line(said, changes, words):
    cautions.warn_of_differences(AGENT, changed(**changes))
    (line,) = said()
    assert line.startswith("untrained was not made for this: ") and all(word in line for word in words)


def test_its_own_task_or_an_easier_one_is_not_told(said):
    for task in (OWN, changed(scenario={"separation_deg": 5.0, "max_half_angle_deg": 20.0, "max_rate_deg": 0.0})):
        cautions.warn_of_differences(AGENT, task)
    seeing = tiny.untrained_agent(network=NetworkConfig(hidden_sizes=(4,), observed_zones=3))
    cautions.warn_of_differences(seeing, changed(scenario={"max_zones": 3}))
    cautions.warn_of_differences(load_controller("pd", OWN), changed(step_seconds=0.5))  # made for no task
    assert said() == []


SCALED = tiny.untrained_agent(network=NetworkConfig(hidden_sizes=(4,), scaled=True))
OWN_UNIT = OWN.spacecraft.time_unit


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"step_seconds": 0.25 * OWN_UNIT}, ["0.25 T in place of 0.016 to 0.06 (T = sqrt(J / u) = 5.48 s)"]),
        ({"step_seconds": 0.01 * OWN_UNIT}, ["a time step of 0.01 T in place of 0.016 to 0.06"]),
        ({"spacecraft": {"max_rate_deg": 0.5}}, ["a largest rate of 0.048 / T in place of 0.19 or more"]),
        ({"step_seconds": 0.03 * OWN_UNIT, "spacecraft": {"max_rate_deg": 3.0}}, []),
        ({"spacecraft": {"inertia": ((6.0, 0.0, 0.0), (0.0, 5.0, 0.0), (0.0, 0.0, 9.0))}}, []),
    ],
)
def test_an_agent_for_any_spacecraft_is_told_by_steps_and_rates_in_units_of_it(said, changes, words):
    cautions.warn_of_differences(SCALED, changed(**changes))
    lines = said()
    assert len(lines) == bool(words) and all(word in lines[0] for word in words)


def test_an_agent_for_any_spacecraft_that_was_made_for_one_step_is_silent_on_it(said):
    slow = changed(step_seconds=0.2 * OWN_UNIT, spacecraft={"max_rate_deg": 0.5})
    cautions.warn_of_differences(dataclasses.replace(SCALED, task=slow), slow)
    assert said() == []


@pytest.mark.slow
def test_flights_tell_it_once(said):
    other = changed(step_seconds=0.2)
    monte_carlo.run_cases(AGENT, other, MonteCarloConfig(cases=2), progress=False)
    assert sum("time step" in line for line in said()) == 1
    cases.fly_case(AGENT, 0, MonteCarloConfig(cases=2), other)
    assert sum("time step" in line for line in said()) == 1


@pytest.mark.parametrize(
    ("margin_deg", "shield", "words"),
    [
        (2.5, None, []),
        (0.1, None, ["the target is 0.1 deg from the edge of a zone", "trained with 2 deg or more"]),
        (0.05, ShieldConfig(), ["0.05 deg from the edge", "the shield keeps 0.1 deg"]),
        (-3.0, None, ["the target is inside a zone"]),
    ],
)
def test_a_target_that_is_too_close_to_a_zone_is_told(said, margin_deg, shield, words):
    angle = jnp.deg2rad(20.0 + margin_deg)
    drawn = scenario.paper_test()
    zone = drawn.constraints.replace(
        axis_N=jnp.array([[jnp.cos(angle), jnp.sin(angle), 0.0]]), half_angle=jnp.deg2rad(jnp.array([20.0]))
    )
    cautions.warn_of_target(AGENT, drawn.replace(constraints=zone), shield)
    lines = said()
    assert len(lines) == bool(words)
    for word in words:
        assert word in lines[0]


def test_pd_has_no_training_to_be_short_of(said):
    cautions.warn_of_target(load_controller("pd"), scenario.paper_test(), ShieldConfig())
    assert said() == []


def test_units_that_cannot_be_meant_are_told_before_the_flight(said, monkeypatch):
    monkeypatch.setattr(cases, "fly_timed", lambda *_: pytest.fail("something was flown"))
    heavy = changed(spacecraft={"inertia": ((6e7, 0.0, 0.0), (0.0, 5e7, 0.0), (0.0, 0.0, 7e7))}, episode_seconds=100.0)
    with pytest.raises(pytest.fail.Exception):
        monte_carlo.run_cases(load_controller("pd", heavy), heavy, MonteCarloConfig(cases=2), progress=False)
    assert ["a turn by 80 deg takes 1.18e+04 s or more" in line for line in said()] == [True]
