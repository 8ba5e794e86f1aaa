"""Quaternion algebra and angles.  Knows nothing of spacecraft.

Convention everywhere: scalar-first unit quaternions q = (q0, q1, q2, q3).  ``q_BN`` is the attitude of the body
frame B relative to the inertial frame N, and takes body components to inertial ones: v_N = q (x) v_B (x) q*.

Formulas are written out by component: each sample is a handful of scalars, and XLA then fuses a whole time step
over the batch into one vectorised loop.
"""

import functools

import jax
import jax.numpy as jnp


@jax.jit
def multiply(a: jax.Array, b: jax.Array) -> jax.Array:
    """Quaternion product a (x) b.  a, b: (4,).  Returns (4,).  Table 1 of the paper."""
    a0, a1, a2, a3 = a
    b0, b1, b2, b3 = b
    return jnp.stack(
        [
            a0 * b0 - a1 * b1 - a2 * b2 - a3 * b3,
            a0 * b1 + a1 * b0 + a2 * b3 - a3 * b2,
            a0 * b2 + a2 * b0 + a3 * b1 - a1 * b3,
            a0 * b3 + a3 * b0 + a1 * b2 - a2 * b1,
        ]
    )


@jax.jit
def conjugate(q: jax.Array) -> jax.Array:
    """Conjugate q* = (q0, -q_vec), the inverse rotation of a unit quaternion.  q: (4,).  Returns (4,)."""
    q0, q1, q2, q3 = q
    return jnp.stack([q0, -q1, -q2, -q3])


@jax.jit
def normalize(v: jax.Array) -> jax.Array:
    """v / |v| along the first axis.  v: (n,), not zero.  Returns (n,)."""
    return v / norm(v)


@jax.jit
def norm(v: jax.Array) -> jax.Array:
    """Euclidean norm of the first axis, differentiable also at zero (where the gradient is zero).  v: (n,)."""
    squared = dot(v, v)
    is_zero = squared == 0.0
    return jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, squared)))


@jax.jit
def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Scalar product.  a, b: (n,).  Returns ()."""
    return functools.reduce(jnp.add, a * b)


@jax.jit
def cross(a: jax.Array, b: jax.Array) -> jax.Array:
    """Vector product a x b.  a, b: (3,).  Returns (3,)."""
    a1, a2, a3 = a
    b1, b2, b3 = b
    return jnp.stack([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1])


@jax.jit
def rotate(q: jax.Array, v: jax.Array) -> jax.Array:
    """Components of q (x) (0, v) (x) q*.  With q = q_BN: v_B to v_N.  q: (4,), v: (3,).  Returns (3,)."""
    q0, q_vec = q[0], q[1:]
    t = 2.0 * cross(q_vec, v)
    return v + q0 * t + cross(q_vec, t)


def from_axis_angle(axis: jax.Array, angle: jax.Array) -> jax.Array:
    """Unit quaternion of a rotation.  axis: (3,) unit; angle: () [rad].  Returns (4,)."""
    half = 0.5 * angle
    return jnp.concatenate([jnp.cos(half)[None], jnp.sin(half) * axis])


@jax.jit
def rotation_angle(q: jax.Array) -> jax.Array:
    """Angle of the rotation q, 2 atan2(|q_vec|, q0).  q: (4,) unit.  Returns () [rad] in [0, 2 pi].

    Exact near zero, where arccos(q0) in float32 has steps of 0.04 deg.
    """
    return 2.0 * jnp.arctan2(norm(q[1:]), q[0])


@jax.jit
def angle_between(a: jax.Array, b: jax.Array) -> jax.Array:
    """Angle between unit vectors, 2 atan2(|a - b|, |a + b|).  a, b: (3,).  Returns () [rad] in [0, pi]."""
    return 2.0 * jnp.arctan2(norm(a - b), norm(a + b))
