"""Saturated quaternion feedback: rest, braking, stability."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.states import MODEL, actions, random_states, state_of, states_of

from koz_jax.control import feedback
from koz_jax.control.quaternion_feedback import QuaternionFeedback
from koz_jax.task import rotations
from koz_jax.task.any_spacecraft import units
from koz_jax.task.state import nominal, propagate


@pytest.mark.slow
def test_pd_rests_at_its_target():
    states = random_states(32, 3, rate=0.0)
    at_target = states.replace(body=states.body.replace(q_BN=states.scenario.q_DN))
    assert np.all(np.abs(actions(QuaternionFeedback(), at_target)) < 1e-4)
    upright = jnp.tile(jnp.eye(4)[0], (32, 1))
    exact = at_target.replace(body=states.body.replace(q_BN=upright), scenario=states.scenario.replace(q_DN=upright))
    assert np.all(actions(QuaternionFeedback(), exact) == 0.0)


@pytest.mark.slow
def test_pd_brakes_in_time():
    """From half a turn away the error falls to the end without overshoot, where it counts on less torque than it has.

    The gains tuned for reward count on a little more.
    """
    far = states_of(
        jnp.eye(4)[1:], jnp.zeros((3, 3)), jnp.tile(jnp.eye(4)[0], (3, 1)), jnp.zeros((3, 0, 3)), jnp.zeros((3, 0))
    )
    controller = QuaternionFeedback(bandwidth=11.0, rate_bandwidth=11.0, torque_share=0.9)

    def one(state):
        def advance(state, _):
            action, _ = controller.decide(state, MODEL, None)
            after = state.replace(body=propagate(state.body, 2.0 * action, nominal(MODEL), MODEL.dt))
            return after, feedback.error_vector(after)

        return jax.lax.scan(advance, state, None, length=300)[1]

    errors = np.asarray(jax.jit(jax.vmap(one))(far))
    about = errors[np.arange(3), :, np.arange(3)]
    assert np.all(about > -1e-3)
    assert np.all(about[:, -1] < 1e-3)


@pytest.mark.slow
def test_pd_without_saturation_has_a_lyapunov_function():
    """V = |e|^2 + |w + k e|^2 / (k r) falls along every motion; e: error vector, k, r: the two bandwidths."""
    controller = QuaternionFeedback(bandwidth=5.5, rate_bandwidth=16.5)
    k, r = (float(gain / units.of(MODEL).time) for gain in (controller.bandwidth, controller.rate_bandwidth))
    rng = np.random.default_rng(1)
    step = MODEL.replace(dt=jnp.float32(0.01))
    target, no_axes, no_angles = jnp.eye(4)[0], jnp.zeros((0, 3)), jnp.zeros(0)

    def value(body):
        error_B = feedback.rotation_vector(body.q_BN)
        follow_B = body.omega_BN_B + k * error_B
        return rotations.dot(error_B, error_B) + rotations.dot(follow_B, follow_B) / (k * r)

    def one(error_B, omega_B):
        state = state_of(feedback.from_rotation_vector(error_B), omega_B, target, no_axes, no_angles)
        action, _ = controller.decide(state, step, None)
        after = propagate(state.body, 2.0 * action, nominal(step), step.dt)
        return jnp.max(jnp.abs(action)), value(state.body), value(after)

    errors = jnp.asarray(0.01 * rng.standard_normal((200, 3)), jnp.float32)
    rates = jnp.asarray(0.003 * rng.standard_normal((200, 3)), jnp.float32)
    strength, before, after = jax.jit(jax.vmap(one))(errors, rates)
    free = np.asarray(strength) < 1.0
    assert free.sum() > 50
    assert np.all(np.asarray(after)[free] < np.asarray(before)[free])
