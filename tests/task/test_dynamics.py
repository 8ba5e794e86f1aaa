import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import oracle

from koz_jax.task import dynamics
from koz_jax.task.dynamics import RigidBodyState

TUMBLE = np.array([0.3, -0.5, 0.4])  # [rad/s], far above what a maneuver reaches


@functools.partial(jax.jit, static_argnames="steps")
def _trajectory(
    state: RigidBodyState, torque_B: jax.Array, inertia_B: jax.Array, dt: float, steps: int
) -> RigidBodyState:
    """All states after the start; leaves (steps, ...)."""

    def advance(state: RigidBodyState, _: None) -> tuple[RigidBodyState, RigidBodyState]:
        state = dynamics.step(state, torque_B, inertia_B, dt)
        return state, state

    return jax.lax.scan(advance, state, None, length=steps)[1]


@jax.jit
def _end(state: RigidBodyState, torque_B: jax.Array, inertia_B: jax.Array, dt: float, steps: int) -> RigidBodyState:
    """The last state; ``steps`` is traced."""
    return jax.lax.fori_loop(0, steps, lambda _, at: dynamics.step(at, torque_B, inertia_B, dt), state)


def _fly(
    dtype: type, q: np.ndarray, omega: np.ndarray, torque: np.ndarray, dt: float, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    start = RigidBodyState(jnp.array(q, dtype), jnp.array(omega, dtype))
    flown = _trajectory(start, jnp.array(torque, dtype), jnp.array(oracle.INERTIA, dtype), dt, steps)
    return np.asarray(flown.q_BN), np.asarray(flown.omega_BN_B)


Q0 = oracle.random_attitude(np.random.default_rng(0))


@pytest.fixture(scope="module")
def tumbling() -> tuple[np.ndarray, np.ndarray]:
    with jax.enable_x64(True):
        return _fly(np.float64, Q0, TUMBLE, np.zeros(3), 0.02, 2000)


def test_torque_free_motion_conserves_inertial_angular_momentum(tumbling):
    momentum_N = oracle.rotation(tumbling[0]).apply(tumbling[1] @ oracle.INERTIA)
    start = oracle.rotation(Q0).apply(oracle.INERTIA @ TUMBLE)
    # The body momentum itself must move, or the law says nothing about the gyroscopic term.
    assert np.linalg.norm(tumbling[1][-1] - TUMBLE) > 0.01
    np.testing.assert_allclose(momentum_N, np.broadcast_to(start, momentum_N.shape), atol=1e-7)


def test_torque_free_motion_conserves_kinetic_energy(tumbling):
    energy = 0.5 * np.sum(tumbling[1] * (tumbling[1] @ oracle.INERTIA), axis=1)
    np.testing.assert_allclose(energy, 0.5 * TUMBLE @ oracle.INERTIA @ TUMBLE, rtol=1e-8)


def test_float32_conserves_momentum_over_a_whole_maneuver():
    omega = 0.3 * TUMBLE
    q, w = _fly(np.float32, Q0, omega, np.zeros(3), oracle.DT, 1000)
    momentum_N = oracle.rotation(q).apply(w.astype(np.float64) @ oracle.INERTIA)
    start = oracle.rotation(Q0).apply(oracle.INERTIA @ omega)
    drift = np.linalg.norm(momentum_N - start, axis=1) / np.linalg.norm(start)
    assert drift.max() < 1e-4


def test_attitude_keeps_unit_norm():
    q, _ = _fly(np.float32, Q0, TUMBLE, np.array([2.0, -2.0, 1.0]), oracle.DT, 1000)
    np.testing.assert_allclose(np.linalg.norm(q.astype(np.float64), axis=1), 1.0, atol=3e-7)


def test_runge_kutta_converges_with_order_four():
    torque = np.array([2.0, -1.0, 1.5])
    seconds = 3.2
    q_exact, w_exact = oracle.propagate(Q0, TUMBLE, torque, seconds)
    steps = np.array([8, 16, 32, 64])
    errors = []
    with jax.enable_x64(True):
        for count in steps:
            start = RigidBodyState(jnp.array(Q0), jnp.array(TUMBLE))
            end = _end(start, jnp.array(torque), jnp.array(oracle.INERTIA), seconds / count, int(count))
            errors.append([np.linalg.norm(end.q_BN - q_exact), np.linalg.norm(end.omega_BN_B - w_exact)])
    orders = -np.diff(np.log2(errors), axis=0)
    # The last halving is closest to the limit.
    np.testing.assert_allclose(orders[-1], 4.0, atol=0.25)
    assert np.all(orders > 3.5)


def test_a_maneuver_with_torque_agrees_with_an_adaptive_integrator():
    torque = np.array([1.0, 2.0, -1.5])
    omega = np.array([0.01, -0.02, 0.03])
    q, w = _fly(np.float32, Q0, omega, torque, oracle.DT, 100)
    q_exact, w_exact = oracle.propagate(Q0, omega, torque, 10.0)
    np.testing.assert_allclose(q[-1], q_exact, atol=1e-5)
    np.testing.assert_allclose(w[-1], w_exact, atol=1e-6)


def test_torque_about_a_principal_axis_from_rest_gives_uniform_angular_acceleration():
    inertia_B = jnp.diag(jnp.array([40.0, 50.0, 60.0]))
    rest = RigidBodyState(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3))
    flown = _trajectory(rest, jnp.array([0.0, 2.0, 0.0]), inertia_B, 0.1, 50)
    t = 0.1 * np.arange(1, 51)
    np.testing.assert_allclose(flown.omega_BN_B[:, 1], 2.0 / 50.0 * t, rtol=1e-5)
    np.testing.assert_allclose(flown.q_BN[:, 2], np.sin(0.25 * 2.0 / 50.0 * t**2), rtol=1e-5, atol=1e-7)


def test_a_rate_about_a_body_axis_turns_the_body_about_that_axis():
    """Handedness of the kinematics: a positive rate about z carries body x towards inertial y."""
    inertia_B = jnp.diag(jnp.array([40.0, 50.0, 60.0]))
    state = RigidBodyState(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, np.pi / 2 / 5.0]))
    flown = _trajectory(state, jnp.zeros(3), inertia_B, 0.1, 50)
    np.testing.assert_allclose(oracle.rotation(flown.q_BN[-1]).apply([1.0, 0.0, 0.0]), [0.0, 1.0, 0.0], atol=1e-5)


def test_inverse_agrees_with_numpy_for_physical_inertias():
    rng = np.random.default_rng(3)
    inertias = np.stack([oracle.INERTIA, *(oracle.random_inertia(rng) for _ in range(50))])
    found = jax.jit(jax.vmap(dynamics.inverse))(inertias.astype(np.float32))
    np.testing.assert_allclose(found, np.linalg.inv(inertias), rtol=1e-4, atol=1e-7)


def test_spacecraft_with_different_parameters_fly_side_by_side():
    rng = np.random.default_rng(4)
    inertias = np.stack([oracle.random_inertia(rng) for _ in range(4)])
    torque = np.array([1.0, 2.0, -1.5])
    start = RigidBodyState(jnp.array(Q0, jnp.float32), jnp.array(TUMBLE, jnp.float32))
    fly = jax.jit(jax.vmap(lambda inertia_B: dynamics.step(start, jnp.array(torque, jnp.float32), inertia_B, 0.1)))
    ends = fly(inertias.astype(np.float32))
    for i, inertia in enumerate(inertias):
        q_exact, w_exact = oracle.propagate(Q0, TUMBLE, torque, 0.1, inertia)
        np.testing.assert_allclose(ends.q_BN[i], q_exact, atol=1e-6)
        np.testing.assert_allclose(ends.omega_BN_B[i], w_exact, atol=1e-6)
