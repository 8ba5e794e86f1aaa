"""Cones whose axes turn: flown as they are, planned for, and kept out of by the shield."""

import jax.numpy as jnp
import numpy as np
import pytest

from koz_jax import maneuver
from koz_jax.config.base import checked
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.presets.named import preset
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import ScenarioConfig, TaskConfig
from koz_jax.config.training import ShieldingConfig, TrainConfig
from koz_jax.control.adversarial import AnyAdversary
from koz_jax.control.registry import load_controller
from koz_jax.control.shield import filter as shield
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases
from koz_jax.task import pointing_constraints
from koz_jax.task.environment import Reorientation
from koz_jax.task.scenario import Scenario

RATE_DEG = 0.5  # eight times that of the Earth seen from a low orbit
ENV = Reorientation.from_config(TaskConfig(episode_seconds=60.0))
TURNING = TaskConfig(episode_seconds=60.0, scenario=ScenarioConfig(cone_rate_deg=RATE_DEG))


def sweeping(rate_deg: float) -> Scenario:
    """At rest where it should be, while a cone of 20 deg comes along the plane of x and y from 60 deg off."""
    axis = (0.5, 0.75**0.5, 0.0)
    zone = (axis, 20.0, (1.0, 0.0, 0.0), (0.0, 0.0, -rate_deg))
    return maneuver((1.0, 0.0, 0.0, 0.0), zones=[zone])


@pytest.mark.slow
def test_the_state_holds_the_constraints_as_they_are_now():
    at = ENV.reset(sweeping(RATE_DEG))
    for _ in range(20):
        at = ENV.step(at, jnp.zeros(3)).state
    expected = pointing_constraints.later(sweeping(RATE_DEG).constraints, 2.0)
    np.testing.assert_allclose(at.scenario.constraints.axis_N, expected.axis_N, atol=1e-5)
    np.testing.assert_allclose(np.rad2deg(ENV.margin(at)), 60.0 - 20.0 - 2.0 * RATE_DEG, atol=1e-3)


@pytest.mark.slow
def test_a_body_at_rest_is_entered_by_a_cone_that_comes():
    """After 80 s at 0.5 deg/s, and not before."""
    still = load_controller("pd")
    for seconds, violated in ((79.0, False), (81.0, True)):
        task = TaskConfig(episode_seconds=seconds)
        _, result = cases.fly_scenario(still, sweeping(RATE_DEG), task)
        assert bool(result.violated) == violated
        np.testing.assert_allclose(np.rad2deg(result.min_margin), 40.0 - RATE_DEG * seconds, atol=0.01)


@pytest.mark.slow
def test_the_shield_gets_out_of_the_way_of_a_cone_that_comes():
    """pd wants to stay where the cone passes: it goes aside, and comes back when the cone has passed."""
    task = TaskConfig(episode_seconds=200.0)
    config = MonteCarloConfig(substeps=5, shield=ShieldConfig(cone_rate_deg=1.0))
    history, result = cases.fly_scenario(load_controller("pd"), sweeping(1.0), task, config)
    assert not result.violated and np.rad2deg(result.min_margin) > 0.05
    errors = np.rad2deg(history.pointing_error)
    assert errors.max() > 5.0 and errors[-1] < 0.25


@pytest.mark.slow
@pytest.mark.parametrize("name", ["random", "adversary", "spin_up"])
def test_whoever_steers_into_a_cone_that_turns_does_not_get_there(name):
    config = MonteCarloConfig(cases=60, seed=7, substeps=5, shield=ShieldConfig())
    found = cases.fly_cases(AnyAdversary.named(name), TURNING, config)
    covered = ~np.asarray(found.unsafe_start)
    assert covered.sum() > 50
    assert not np.any(np.asarray(found.violated)[covered])


def crossing(rate_deg: float) -> Scenario:
    """A quarter turn of the telescope from +y to +x; a cone comes down from 40 deg above the middle of its way."""
    middle, up = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0), np.array([0.0, 0.0, 1.0])
    axis = np.cos(np.deg2rad(40.0)) * middle + np.sin(np.deg2rad(40.0)) * up
    zone = (axis, 20.0, (1.0, 0.0, 0.0), -rate_deg * np.cross(middle, up))
    return maneuver((np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4)), zones=[zone])


@pytest.mark.slow
def test_a_plan_is_made_for_where_the_cone_will_be():
    """The cone is clear of the direct way at the start, and there when the telescope is."""
    task, config = TaskConfig(episode_seconds=60.0), MonteCarloConfig(substeps=5)
    (_, still), (_, coming) = (cases.fly_scenario(load_controller("pd"), crossing(r), task, config) for r in (0.0, 6.0))
    assert not still.violated and coming.violated
    _, planned = cases.fly_scenario(load_controller("planner"), crossing(6.0), task, config)
    assert planned.success and np.rad2deg(planned.min_margin) > 0.5


def test_a_shield_for_slower_cones_is_refused_by_name():
    with pytest.raises(SettingsError, match=r"shield.cone_rate_deg: must be at least 0.5"):
        cases.fly_scenario(load_controller("pd"), sweeping(RATE_DEG), config=MonteCarloConfig(shield=ShieldConfig()))


def test_training_under_a_shield_for_slower_cones_is_refused_by_name():
    changes = {"task": TURNING, "shielding": ShieldingConfig(enabled=True)}
    with pytest.raises(SettingsError, match=r"shield.cone_rate_deg: must be at least 0.5"):
        checked(TrainConfig, **{**dict(preset("smoke")), **changes})


def test_the_faster_cones_may_turn_the_farther_the_shield_keeps_away():
    margins = [
        float(shield.from_config(ShieldConfig(cone_rate_deg=rate), ENV.model).guide.margin) for rate in (0.0, 0.1, 1.0)
    ]
    assert margins[0] < margins[1] < margins[2]
