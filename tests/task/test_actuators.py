"""Actuators: torques of a command, and the box and balls of what can be asked for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from koz_jax.config.task import SpacecraftConfig, TaskConfig
from koz_jax.task import environment
from koz_jax.task.actuators import TorqueBox, TorqueLimits

LIMITS = st.lists(st.floats(0.015625, 100.0, width=32), min_size=3, max_size=3)
COMMANDS = st.lists(st.floats(-3.0, 3.0, width=32), min_size=3, max_size=3)

AT_REST = jnp.zeros(3)
apply = jax.jit(lambda box, command: box.apply(command, box.initial_state(), AT_REST, jnp.eye(3), jnp.float32(0.1)))


@given(LIMITS, COMMANDS)
def test_torque_of_a_box_is_the_clipped_command_times_the_limit_of_each_axis(limits, command):
    torque_B, state = apply(TorqueBox(jnp.array(limits)), jnp.array(command))
    np.testing.assert_allclose(torque_B, np.array(limits) * np.clip(command, -1.0, 1.0), rtol=1e-6, atol=1e-30)
    assert state is None


@given(LIMITS)
def test_the_balls_are_inside_and_around_the_box(limits):
    found = TorqueLimits(jnp.array(limits))
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    brake = float(TorqueBox(jnp.array(limits)).brake_torque)
    assert np.all(np.abs(brake * directions) <= np.float32(limits) * (1 + 1e-6))
    # No larger ball is inside: along the weakest axis the box ends there.
    assert brake == np.float32(min(limits))
    corner = np.linalg.norm(limits)
    torques = np.random.default_rng(1).uniform(-1.0, 1.0, (500, 3)) * limits
    assert np.all(np.linalg.norm(torques, axis=1) <= float(found.largest) * (1 + 1e-6))
    # Nor is a smaller one around it.
    assert float(found.largest) == pytest.approx(corner, rel=1e-6)
    assert float(found.scale) == pytest.approx(corner / np.sqrt(3.0), rel=1e-6)


@pytest.mark.parametrize("limit", [0.3, 2.0, 1.7])
def test_a_box_with_one_limit_is_the_scalar_of_before(limit):
    """One number for all axes: torque = limit * command to the last bit, and all three sizes are the paper's."""
    config = TaskConfig(spacecraft=SpacecraftConfig(torque_limit=limit))
    actuators = environment.model_from_config(config).actuators
    commands = jnp.array(np.random.default_rng(0).uniform(-1.5, 1.5, (100, 3)), jnp.float32)
    torques_B = jax.vmap(lambda command: apply(actuators, command)[0])(commands)
    np.testing.assert_array_equal(torques_B, np.float32(limit) * np.clip(commands, -1.0, 1.0))
    limits = actuators.limits(None, AT_REST)
    assert actuators.brake_torque == np.float32(limit)
    assert float(limits.scale) == pytest.approx(limit, rel=1e-6)
    assert float(limits.largest) == pytest.approx(np.sqrt(3.0) * limit, rel=1e-6)


def test_limits_are_traced():
    """Other limits, as a batch of spacecraft has them, need no other compilation and no loop."""
    boxes = TorqueBox(jnp.array([[1.0, 2.0, 3.0], [0.1, 0.2, 0.3]]))
    torques_B = jax.vmap(lambda box: apply(box, jnp.array([1.0, -1.0, 0.5]))[0])(boxes)
    np.testing.assert_allclose(torques_B, [[1.0, -2.0, 1.5], [0.1, -0.2, 0.15]], rtol=1e-6)
