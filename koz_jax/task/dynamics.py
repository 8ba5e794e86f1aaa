"""Rigid-body attitude kinematics and dynamics (Eq. 1 and 2 of the paper), one fixed step at a time."""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.task import rotations


class RigidBodyState(struct.PyTreeNode):
    """Attitude and rate of the body."""

    q_BN: jax.Array  # (4,) unit quaternion, body relative to inertial
    omega_BN_B: jax.Array  # (3,) [rad/s], body relative to inertial, in body axes


class StoredMomentum(struct.PyTreeNode):
    """Angular momentum that turns with the body beside its own, as of wheels."""

    momentum_B: jax.Array  # (3,) [N m s] now
    torque_B: jax.Array  # (3,) [N m] that it gives to the body, at its own cost


@jax.jit
def matvec(matrix: jax.Array, vector: jax.Array) -> jax.Array:
    """Matrix times vector, as a sum of columns.  matrix: (3, 3), vector: (3,).  Returns (3,)."""
    m = [[matrix[i, j] for j in range(3)] for i in range(3)]
    v1, v2, v3 = vector
    return jnp.stack([row[0] * v1 + row[1] * v2 + row[2] * v3 for row in m])


@jax.jit
def inverse(inertia_B: jax.Array) -> jax.Array:
    """Inverse of a symmetric matrix by cofactors.  inertia_B: (3, 3).  Returns (3, 3)."""
    c1, c2, c3 = inertia_B
    adjugate = jnp.stack([rotations.cross(c2, c3), rotations.cross(c3, c1), rotations.cross(c1, c2)])
    return adjugate / rotations.dot(c1, adjugate[0])


@jax.jit
def gyroscopic_torque(omega_BN_B: jax.Array, inertia_B: jax.Array) -> jax.Array:
    """w x (I w), the torque that keeps a rate.  omega_BN_B: (3,) [rad/s]; inertia_B: (3, 3).  Returns (3,) [N m]."""
    return rotations.cross(omega_BN_B, matvec(inertia_B, omega_BN_B))


def peak_rate_form(inertia_B: jax.Array) -> jax.Array:
    """M, with w . M w the square of the largest rate of the torque-free motion through the rate w.  Returns (3, 3).

    With a <= b <= c the principal moments, the squared rate is a linear function of squared momentum and energy where a
    component of w vanishes.  Every torque-free motion passes where that of b does, and has its largest rate there:
    M = ((a + c) I - I^2) / (a c).
    """
    a, _, c = jnp.linalg.eigvalsh(inertia_B)
    return ((a + c) * inertia_B - inertia_B @ inertia_B) / (a * c)


@jax.jit
def angular_acceleration(
    omega_BN_B: jax.Array, torque_B: jax.Array, inertia_B: jax.Array, inverse_inertia_B: jax.Array
) -> jax.Array:
    """Euler's equation, I dw/dt = tau - w x (I w) (Eq. 2).

    omega_BN_B: (3,) [rad/s]; torque_B: (3,) [N m]; inertia_B and its inverse: (3, 3).  Returns (3,) [rad/s^2].
    """
    return matvec(inverse_inertia_B, torque_B - gyroscopic_torque(omega_BN_B, inertia_B))


@jax.jit
def attitude_rate(q_BN: jax.Array, omega_BN_B: jax.Array) -> jax.Array:
    """Kinematics, dq/dt = q (x) (0, w) / 2 (Eq. 1).  q_BN: (4,); omega_BN_B: (3,) [rad/s].  Returns (4,) [1/s]."""
    return 0.5 * rotations.multiply(q_BN, jnp.concatenate([jnp.zeros_like(omega_BN_B[:1]), omega_BN_B]))


@jax.jit
def step(
    state: RigidBodyState,
    torque_B: jax.Array,
    inertia_B: jax.Array,
    dt: jax.Array | float,
    stored: StoredMomentum | None = None,
) -> RigidBodyState:
    """One Runge-Kutta step of order 4 with the torque held (zero-order hold), attitude renormalised.

    torque_B: (3,) [N m], all of it; inertia_B: (3, 3) [kg m^2], with wheels as dead weight; dt: () [s].  Stored
    momentum h adds the gyroscopic torque w x h.
    """
    inverse_B = inverse(inertia_B)

    def net(at: RigidBodyState, seconds: jax.Array | float) -> jax.Array:
        if stored is None:
            return torque_B
        return torque_B - rotations.cross(at.omega_BN_B, stored.momentum_B - seconds * stored.torque_B)

    def derivative(at: RigidBodyState, seconds: jax.Array | float) -> RigidBodyState:
        return RigidBodyState(
            attitude_rate(at.q_BN, at.omega_BN_B),
            angular_acceleration(at.omega_BN_B, net(at, seconds), inertia_B, inverse_B),
        )

    def ahead(slope: RigidBodyState, h: jax.Array | float) -> RigidBodyState:
        return jax.tree.map(lambda x, dx: x + h * dx, state, slope)

    k1 = derivative(state, 0.0)
    k2 = derivative(ahead(k1, 0.5 * dt), 0.5 * dt)
    k3 = derivative(ahead(k2, 0.5 * dt), 0.5 * dt)
    k4 = derivative(ahead(k3, dt), dt)
    mean_slope = jax.tree.map(lambda a, b, c, d: (a + 2.0 * (b + c) + d) / 6.0, k1, k2, k3, k4)
    end = ahead(mean_slope, dt)
    return RigidBodyState(rotations.normalize(end.q_BN), end.omega_BN_B)
