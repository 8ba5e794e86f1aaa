"""Feedback on a potential, against its gradient by differences in float64."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.states import LOOK, MODEL, actions, random_states

from koz_jax.control.potential import Potential, PotentialFeedback
from koz_jax.task.any_spacecraft import units
from koz_jax.task.pointing_constraints import smallest_margin
from koz_jax.task.state import attitude_error


def potential_value(vector_B, state, potential, look_B):
    """V of the attitude turned by a rotation vector, in float64."""
    q0, *q_vec = np.asarray(state.body.q_BN, float)
    d0, *d_vec = np.asarray(state.scenario.q_DN, float)
    body = Rotation.from_quat([*q_vec, q0]) * Rotation.from_rotvec(vector_B)
    error = (Rotation.from_quat([*d_vec, d0]).inv() * body).as_quat()
    # The sign of the quaternion, which a rotation does not have, is that of the state.
    sign = np.sign(float(attitude_error(state)[0]) * error[3])
    away = 2.0 * (1.0 - sign * error[3])
    value = 1.0
    zones = state.scenario.constraints
    for axis_N, half_angle in zip(np.asarray(zones.axis_N, float), np.asarray(zones.half_angle, float), strict=True):
        if half_angle > 0.0:
            edge = np.cos(half_angle + potential.margin)
            value -= potential.barrier * np.log((edge - axis_N @ body.apply(look_B)) / (1.0 + edge))
    return away * value


@pytest.mark.slow
def test_potential_torque_is_minus_the_gradient_and_damping():
    controller = PotentialFeedback(frequency=0.11)
    frequency = float(controller.frequency / units.of(MODEL).time)
    potential = Potential(controller.barrier, controller.margin)
    states = random_states(96, 31, rate=0.01)
    found = 2.0 * actions(controller, states)
    inertia_B, look_B = np.asarray(MODEL.inertia_B, float), np.asarray(LOOK)
    checked = 0
    for i in range(96):
        state = jax.tree.map(lambda leaf, i=i: leaf[i], states)
        margin = float(smallest_margin(state.body.q_BN, state.scenario.constraints))
        if margin < 0.15 or np.abs(found[i]).max() > 1.9:
            continue
        ways = 1e-5 * np.eye(3)
        gradient_B = [
            (potential_value(way, state, potential, look_B) - potential_value(-way, state, potential, look_B)) / 2e-5
            for way in ways
        ]
        omega_B = np.asarray(state.body.omega_BN_B, float)
        acceleration_B = -2 * frequency**2 * np.array(gradient_B)
        acceleration_B -= 2 * controller.damping * frequency * omega_B
        expected = inertia_B @ acceleration_B + np.cross(omega_B, inertia_B @ omega_B)
        np.testing.assert_allclose(found[i], expected, rtol=2e-3, atol=2e-4)
        checked += 1
    assert checked > 20
