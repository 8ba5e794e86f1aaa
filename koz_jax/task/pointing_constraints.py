"""Pointing constraints: cones of inertial directions that an instrument must not look into (Eq. 4 of the paper).

The socket for spacecraft engineers: a constraint is data, a pair of an instrument and a cone, and several of them are
a stack along a leading axis.  Everything else (observation, reward, shield, planners, figures) reads the stack, and
knows no other boresight.  Geometry is of one constraint; stacks are mapped over by ``margins``.

A cone of half angle f that an instrument is kept in is the one of 180 deg - f about the opposite direction that it is
kept out of.  Axes may turn: the state of a maneuver holds its constraints as they are now, and ``later`` says where
they will be.
"""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.task import rotations
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE


class PointingConstraint(struct.PyTreeNode):
    """One instrument and one cone that it must not look into, or a stack of such pairs along a leading axis."""

    boresight_B: jax.Array  # (3,) unit vector of the instrument, in body axes
    axis_N: jax.Array  # (3,) unit vector to the bright object, in inertial axes (n_F of the paper)
    half_angle: jax.Array  # () [rad] (theta_F of the paper); ``ABSENT_HALF_ANGLE`` stands for no cone
    axis_rate_N: jax.Array | None = None  # (3,) [rad/s] angular velocity of the axis, inertial; None where none turns

    @property
    def is_present(self) -> jax.Array:
        """Whether there is a cone at all, also one of which the half angle is no number.  Returns () bool."""
        return ~(self.half_angle <= 0.0)

    @property
    def count(self) -> int:
        """Number of constraints in a stack."""
        return self.half_angle.shape[0]


def keep_out(boresight_B: jax.Array, axis_N: jax.Array, half_angle: jax.Array) -> PointingConstraint:
    """Make one constraint of floats.  boresight_B, axis_N: (3,) unit vectors; half_angle: () [rad]."""
    return PointingConstraint(boresight_B, axis_N, half_angle)


def keep_in(boresight_B: jax.Array, axis_N: jax.Array, half_angle: jax.Array) -> PointingConstraint:
    """One constraint to look into a cone, not out of it.  As ``keep_out``."""
    return PointingConstraint(boresight_B, -axis_N, jnp.pi - half_angle)


def absent(count: int, boresight_B: jax.Array) -> PointingConstraint:
    """Stand-ins for no constraint of an instrument, with a margin of at least pi everywhere.  Returns a stack."""
    return PointingConstraint(
        boresight_B=jnp.tile(boresight_B, (count, 1)),
        axis_N=jnp.tile(jnp.array([1.0, 0.0, 0.0]), (count, 1)),
        half_angle=jnp.full(count, ABSENT_HALF_ANGLE, jnp.float32),
    )


def filled_up(constraints: PointingConstraint, count: int) -> PointingConstraint:
    """A stack with absent ones at its end, ``count`` in all."""
    empty = absent(count - constraints.count, constraints.boresight_B[0])
    if constraints.axis_rate_N is not None:
        empty = empty.replace(axis_rate_N=jnp.zeros_like(empty.axis_N))
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), constraints, empty)


def later(constraints: PointingConstraint, seconds: jax.Array | float) -> PointingConstraint:
    """A stack as it is a time () [s] later, when axes have turned."""
    if constraints.axis_rate_N is None:
        return constraints
    turned_N = jax.vmap(_turned, in_axes=(0, 0, None))(constraints.axis_N, constraints.axis_rate_N, seconds)
    return constraints.replace(axis_N=turned_N)


def _turned(axis_N: jax.Array, rate_N: jax.Array, seconds: jax.Array | float) -> jax.Array:
    speed = rotations.norm(rate_N)
    about_N = rate_N / jnp.where(speed > 0.0, speed, 1.0)
    return rotations.normalize(rotations.rotate(rotations.from_axis_angle(about_N, speed * seconds), axis_N))


def boresight_N(q_BN: jax.Array, constraint: PointingConstraint) -> jax.Array:
    """Where the instrument looks.  q_BN: (4,).  Returns (3,) unit vector in inertial axes."""
    return rotations.rotate(q_BN, constraint.boresight_B)


def axis_B(q_BN: jax.Array, constraint: PointingConstraint) -> jax.Array:
    """Where the cone is, seen from the body.  q_BN: (4,).  Returns (3,) unit vector in body axes."""
    return rotations.rotate(rotations.conjugate(q_BN), constraint.axis_N)


@jax.jit
def angle_to_axis(q_BN: jax.Array, constraint: PointingConstraint) -> jax.Array:
    """theta, the angle between the boresight and the cone's axis.  q_BN: (4,).  Returns () [rad]."""
    return rotations.angle_between(boresight_N(q_BN, constraint), constraint.axis_N)


@jax.jit
def margin(q_BN: jax.Array, constraint: PointingConstraint) -> jax.Array:
    """theta_margin = theta - theta_F; the constraint is violated when it is <= 0.  q_BN: (4,).  Returns () [rad]."""
    return angle_to_axis(q_BN, constraint) - constraint.half_angle


@jax.jit
def margins(q_BN: jax.Array, constraints: PointingConstraint) -> jax.Array:
    """Margin of each of several constraints.  q_BN: (4,).  Returns (constraints,) [rad]."""
    return jax.vmap(margin, in_axes=(None, 0))(q_BN, constraints)


@jax.jit
def smallest_margin(q_BN: jax.Array, constraints: PointingConstraint) -> jax.Array:
    """Margin of the constraint that is nearest to being violated.  q_BN: (4,).  Returns () [rad]."""
    return jnp.min(margins(q_BN, constraints))
