"""Units and axes of a spacecraft: rotations, and one maneuver for all spacecraft of a shape."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from koz_jax.config.task import SpacecraftConfig, TaskConfig
from koz_jax.task import dynamics, rotations
from koz_jax.task.any_spacecraft import units
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.environment import model_from_config

_DIRECTIONS = jax.vmap(rotations.normalize)(jax.random.normal(jax.random.key(5), (64, 3)))


@pytest.mark.parametrize(("inertia", "torque_limit"), [(60.0, 2.0), (0.004, 1e-3), (5e4, (10.0, 20.0, 5.0))])
def test_the_strength_turns_half_a_radian_in_the_unit_of_time(inertia, torque_limit):
    sphere = ((inertia, 0.0, 0.0), (0.0, inertia, 0.0), (0.0, 0.0, inertia))
    body = SpacecraftConfig(inertia=sphere, torque_limit=torque_limit)
    model = model_from_config(TaskConfig(spacecraft=body))
    own = units.of(model)
    start = RigidBodyState(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    end = dynamics.step(start, own.torque * jnp.array([0.0, 0.0, 1.0]), model.inertia_B, own.time)
    np.testing.assert_allclose(rotations.rotation_angle(end.q_BN), 0.5, rtol=1e-3)  # of one Runge-Kutta step
    np.testing.assert_allclose(own.acceleration * own.time**2, 1.0, rtol=1e-6)


def test_the_axes_are_a_rotation_with_the_instrument_along_x():
    axes = jax.vmap(units.policy_axes)(_DIRECTIONS)
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), np.tile(np.eye(3), (64, 1, 1)), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-5)
    np.testing.assert_allclose(jax.vmap(dynamics.matvec)(axes, _DIRECTIONS), np.tile([1, 0, 0], (64, 1)), atol=1e-5)


def test_the_axes_are_the_bodys_for_an_instrument_along_x_and_a_rotation_also_along_minus_x():
    np.testing.assert_array_equal(units.policy_axes(jnp.array([1.0, 0.0, 0.0])), np.eye(3))
    np.testing.assert_array_equal(units.policy_axes(jnp.array([-1.0, 0.0, 0.0])), np.diag([-1.0, -1.0, 1.0]))


@pytest.mark.slow
def test_the_axes_are_a_continuous_function_of_the_instrument():
    away = _DIRECTIONS[_DIRECTIONS[:, 0] > -0.9]
    nudged = jax.vmap(rotations.normalize)(away + 1e-3 * jnp.array([[0.3, -0.5, 0.8]]))
    change = jax.vmap(units.policy_axes)(nudged) - jax.vmap(units.policy_axes)(away)
    assert float(jnp.abs(change).max()) < 0.02


def test_the_torque_gives_a_body_at_rest_the_acceleration_that_was_asked_for():
    inertia = ((0.05, 0.002, 0.0), (0.002, 0.06, 0.001), (0.0, 0.001, 0.02))
    model = model_from_config(TaskConfig(spacecraft=SpacecraftConfig(inertia=inertia, torque_limit=4e-3)))
    axes, asked_P = units.policy_axes(_DIRECTIONS[3]), jnp.array([0.2, -0.5, 0.3])
    torque_B = units.torque_for(asked_P, axes, model)
    reached_B = np.linalg.solve(np.array(inertia), np.asarray(torque_B, np.float64))
    expected_B = np.asarray(axes).T @ np.asarray(asked_P) * float(units.of(model).acceleration)
    np.testing.assert_allclose(reached_B, expected_B, rtol=1e-4)
