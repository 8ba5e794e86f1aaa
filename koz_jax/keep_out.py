"""Geometry of keep-out zones: cones of inertial directions that the boresight must not enter (Eq. 4)."""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax import rotations

# A cone of this half angle holds no direction: its margin is at least pi everywhere.  It stands for "no zone".
NO_ZONE_HALF_ANGLE = -jnp.pi


class KeepOutZone(struct.PyTreeNode):
    """One bright cone, or a stack of them along a leading axis."""

    axis_N: jax.Array  # (3,) unit vector to the bright object, in inertial axes (n_F of the paper)
    half_angle: jax.Array  # () [rad] (theta_F of the paper)


def angle_to_axis(direction_N: jax.Array, zone: KeepOutZone) -> jax.Array:
    """theta, the angle between a direction and the zone's axis.  direction_N: (3,) unit.  Returns () [rad]."""
    return rotations.angle_between(direction_N, zone.axis_N)


def margin(direction_N: jax.Array, zone: KeepOutZone) -> jax.Array:
    """theta_margin = theta - theta_F; the zone is violated when it is <= 0.  direction_N: (3,).  Returns () [rad]."""
    return angle_to_axis(direction_N, zone) - zone.half_angle


def no_zones(count: int) -> KeepOutZone:
    """A stack of absent zones.  Returns leaves (count, ...)."""
    return KeepOutZone(
        axis_N=jnp.tile(jnp.array([1.0, 0.0, 0.0]), (count, 1)), half_angle=jnp.full(count, NO_ZONE_HALF_ANGLE)
    )


def smallest_margin(direction_N: jax.Array, zones: KeepOutZone) -> jax.Array:
    """Margin to the nearest of several zones (stacked along a leading axis).  direction_N: (3,).  Returns () [rad]."""
    return jnp.min(jax.vmap(margin, in_axes=(None, 0))(direction_N, zones))
