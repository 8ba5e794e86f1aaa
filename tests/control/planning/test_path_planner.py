"""Planned paths: clear of the zones, as fast as the torque box allows, at rest at both ends."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.states import LOOK, MODEL

from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.planning import attitude_path
from koz_jax.control.planning.path_planner import PathPlanner
from koz_jax.evaluation import cases
from koz_jax.task import rotations
from koz_jax.task.actuators import TorqueBox
from koz_jax.task.state import begin


def drawn_with_zones(count, zones):
    config = TaskConfig.model_validate({"scenario": {"min_zones": 1, "max_zones": zones}})
    draw = MonteCarloConfig(cases=count, seed=2)
    return jax.jit(jax.vmap(lambda i: cases.draw_case(config, draw, i)))(jnp.arange(count))


# Start and target keep 2 deg (0.035 rad) from the zones, so no plan can keep more.
PLANNER = PathPlanner(margin=0.03)


COUNT = 100


@pytest.fixture(scope="module")
def drawn():
    """Cases with one to three zones."""
    return drawn_with_zones(COUNT, 3)


@jax.jit
def _plan(drawn, model):
    def plan(case, key):
        return PLANNER.planned(begin(case, model), model, key)

    return jax.vmap(plan)(drawn, jax.random.split(jax.random.key(1), COUNT))


@pytest.fixture(scope="module")
def plans(drawn):
    return drawn, _plan(drawn, MODEL)


@pytest.mark.slow
def test_planned_paths_stay_clear_of_all_zones(plans):
    drawn, found = plans
    samples = jax.jit(jax.vmap(lambda path: attitude_path.sample(path, 1001)))(found.path)
    look = jax.jit(jax.vmap(jax.vmap(rotations.rotate, in_axes=(0, None)), in_axes=(0, None)))
    looks_N = np.asarray(look(samples.q_BN, LOOK), float)
    cosines = np.einsum("cpi,czi->cpz", looks_N, np.asarray(drawn.constraints.axis_N, float))
    margins = np.arccos(np.clip(cosines, -1, 1)) - np.asarray(drawn.constraints.half_angle, float)[:, None]
    assert (np.asarray(drawn.constraints.half_angle) > 0).sum(axis=1).max() == 3
    assert np.all(margins.min(axis=(1, 2)) >= PLANNER.margin - 1e-3)


@pytest.mark.slow
def test_plans_begin_at_the_start_and_end_at_rest_at_the_target(plans):
    drawn, found = plans
    begin, end = _both_ends(found)
    np.testing.assert_allclose(begin.q_BN, drawn.initial.q_BN, atol=1e-6)
    # The sign too: the maneuver ends at +1.
    np.testing.assert_allclose(end.q_BN, drawn.q_DN, atol=1e-5)
    np.testing.assert_allclose(begin.omega_BN_B, 0.0, atol=1e-6)
    np.testing.assert_allclose(end.omega_BN_B, 0.0, atol=1e-4)


@pytest.mark.slow
def test_plans_need_no_more_torque_than_there_is(plans):
    """The rate along a plan, differentiated, is a torque inside the box, and most of the time at its edge."""
    _, found = plans
    torques = np.abs(needed_torques(found))
    assert np.mean(torques.max(axis=2) > 1.05 * 2.0) < 0.01
    assert np.mean(torques.max(axis=2) > 0.9 * 2.0) > 0.8


@pytest.mark.slow
def test_plans_for_unequal_limits_use_each_of_them(drawn):
    limits = np.array([0.7, 2.0, 1.2])
    found = _plan(drawn, MODEL.replace(actuators=TorqueBox(jnp.array(limits, jnp.float32))))
    shares = np.abs(needed_torques(found)) / limits
    assert np.mean(shares.max(axis=2) > 1.1) < 0.01
    assert np.mean(shares.max(axis=2) > 0.9) > 0.8
    assert np.all(np.mean(shares > 0.9, axis=(0, 1)) > 0.05)
    _, end = _both_ends(found)
    np.testing.assert_allclose(end.q_BN, drawn.q_DN, atol=1e-5)


@jax.jit
@jax.vmap
def _both_ends(plan):
    return tuple(plan.reference(time, jnp.float32(1.0)) for time in (jnp.float32(0.0), plan.timing.duration + 1.0))


@jax.jit
def _changes(plans):
    """Accelerations and rates (plans, 97, 3) along plans."""
    h = 0.02

    def torque(plan, share):
        time = share * plan.timing.duration
        before, now, after = (plan.reference(time + shift, jnp.float32(1.0)).omega_BN_B for shift in (-h, 0.0, h))
        return (after - before) / (2 * h), now

    shares = jnp.linspace(0.02, 0.98, 97)
    return jax.vmap(jax.vmap(torque, in_axes=(None, 0)), in_axes=(0, None))(plans, shares)


def needed_torques(found):
    """Torques (plans, 97, 3) [N m] along plans: the rate, differentiated."""
    acceleration, omega = _changes(found)
    inertia_B, omega = np.asarray(MODEL.inertia_B, float), np.asarray(omega, float)
    momentum = omega @ inertia_B
    return np.asarray(acceleration, float) @ inertia_B + np.cross(omega, momentum)
