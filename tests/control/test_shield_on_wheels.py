"""The shield of a spacecraft on reaction wheels that hold momentum at the start: zones, rate and momentum are kept."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from koz_jax.config.actuators.wheels import WheelConfig
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import SpacecraftConfig, TaskConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.control.adversarial import AnyAdversary
from koz_jax.control.registry import load_controller
from koz_jax.control.shield.filter import Shield, under_shield
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases, rollout
from koz_jax.evaluation.rollout import History
from koz_jax.task.environment import Reorientation
from koz_jax.task.scenario import paper_test
from koz_jax.task.state import largest_rate

INERTIA = ((0.05, 0.002, 0.0), (0.002, 0.06, 0.001), (0.0, 0.001, 0.03))
MOMENTUM = 0.015
SIDE = float(1.0 / np.sqrt(3.0))
# A pyramid, with a bias of up to 30 % of what a wheel holds.
WHEELS = tuple(
    WheelConfig(axis=(x * SIDE, y * SIDE, SIDE), max_torque=0.004, max_momentum=MOMENTUM, momentum=bias * MOMENTUM)
    for x, y, bias in ((1, 1, 0.3), (-1, 1, -0.2), (-1, -1, 0.1), (1, -1, 0.25))
)
TASK = TaskConfig(spacecraft=SpacecraftConfig(inertia=INERTIA, wheels=WHEELS), episode_seconds=60.0)
ENV = under_shield(Reorientation.from_config(TASK), ShieldConfig())


@jax.jit
def _fly(controller: AnyAdversary, keys: jax.Array) -> tuple[History, jax.Array]:
    def one(key: jax.Array) -> tuple[History, jax.Array]:
        history, result = rollout.fly_and_judge(ENV, controller, ENV.sample(key), substeps=5, key=key)
        return history, result.min_margin

    return jax.vmap(one)(keys)


@functools.cache
def flown(name: str) -> tuple[History, np.ndarray]:
    history, margins = _fly(AnyAdversary.named(name), jax.random.split(jax.random.key(3), 40))
    return history, np.asarray(margins)


@pytest.mark.slow
def test_a_disturbance_that_wheels_have_no_torque_to_brake_against_is_refused():
    """Half of their torque is for their own momentum, and does not count; a disturbance may be half of the rest."""
    weakest = min(TASK.spacecraft.torque_limits)
    for share, refused in ((0.24, False), (0.26, True)):
        config = MonteCarloConfig(
            shield=ShieldConfig(error_bounds=UncertaintyConfig(disturbance_torque=share * weakest))
        )
        if refused:
            with pytest.raises(SettingsError, match=r"disturbance_torque: must be below 0.5 times the torque limit of"):
                cases.environment(TASK, config)
        else:
            made = cases.environment(TASK, config).action_filter
            assert isinstance(made, Shield) and made.brake.torque > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["random", "bang_bang", "adversary", "spin_up"])
def test_nobody_enters_a_zone_or_fills_a_wheel(name):
    history, margins = flown(name)
    assert np.all(margins > 0.0)
    assert np.abs(history.state.actuators).max() < MOMENTUM
    assert name != "spin_up" or np.abs(history.state.actuators).max() > 0.6 * MOMENTUM


@pytest.mark.slow
@pytest.mark.parametrize("name", ["spin_up", "bang_bang"])
def test_the_rate_stays_below_that_from_which_the_wheels_can_stop_the_body(name):
    history, _ = flown(name)
    limits = jax.vmap(jax.vmap(lambda at: largest_rate(at, ENV.model)))(history.state)
    rates = jnp.linalg.norm(history.state.body.omega_BN_B, axis=-1)
    assert np.max(rates / limits) < 1.01


@pytest.mark.slow
def test_the_papers_scenario_is_flown_on_wheels():
    task = TASK.model_copy(update={"episode_seconds": 100.0})
    config = MonteCarloConfig(substeps=5, shield=ShieldConfig())
    history, result = cases.fly_scenario(load_controller("pd"), paper_test(), task, config)
    assert result.success
    assert np.abs(history.state.actuators).max() < MOMENTUM
