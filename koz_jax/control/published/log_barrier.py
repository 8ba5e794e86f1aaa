"""The potential of Lee & Mesbahi and of Yang et al.: distance to the target, times logarithmic barriers of the zones.

    V(q) = (b1 + b2 sum of -log(room)) |q - q_d|^2,   room = -q' M_F q / 2 = (cos(theta_F) - r . n) / 2, in (0, 1)

r is where an instrument looks and n the axis of a cone that it is kept out of, for as many pairs of an instrument and
a cone as there are.  A mandatory zone has room = q' M_M q / 2 = (r . n - cos(theta_M)) / 2.  Here it is a keep-out
cone of pi - theta_M about -n, whose room is the same; so both kinds share one weight, as in the published cases
(k1 = k2).  The papers make the matrices M convex by a multiple of the identity.  That changes the gradient along q
alone, which vec(q* (x) grad V) does not have.

The target is q_d as it is given: that of q_d and -q_d which is nearer at the start, see ``task.maneuver``.
"""

import math

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.control.feedback import Gain
from koz_jax.task import dynamics, rotations
from koz_jax.task.actuators import TorqueLimits
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.scenario import Scenario
from koz_jax.task.state import EnvState

# Units of diag(50, 45, 80) kg m^2 with 2 N m about each axis, the spacecraft that the published gains are for.  Divided
# by them gains are in units of T and u, and on that spacecraft they are the published ones.
TORQUE = 2.0  # [N m] u
TIME = math.sqrt((50.0 + 45.0 + 80.0) / 3.0 / TORQUE)  # [s] T

# Below this, about 0.03 deg from an edge, the barrier goes on as a straight line; the papers' has no value in a zone.
_LEAST_ROOM = 1e-4


class LogBarrierPotential(struct.PyTreeNode):
    """V as a function of the attitude; without unit."""

    away: Gain  # () b1, weight of the distance to the target alone
    barrier: Gain  # () b2 k, weight of each zone's barrier

    def value(self, q_BN: jax.Array, scenario: Scenario) -> jax.Array:
        """V.  q_BN: (4,).  Returns ()."""
        zones = scenario.constraints
        barriers = jnp.where(zones.is_present, jax.vmap(_barrier, in_axes=(None, 0))(q_BN, zones), 0.0)
        difference = q_BN - scenario.q_DN
        return (self.away + self.barrier * jnp.sum(barriers)) * rotations.dot(difference, difference)

    def slope(self, q_BN: jax.Array, scenario: Scenario) -> jax.Array:
        """vec(q* (x) grad V), twice the change of V with a small turn about each body axis.  Returns (3,) [1/rad]."""
        gradient = jax.grad(self.value)(q_BN, scenario)
        return rotations.multiply(rotations.conjugate(q_BN), gradient)[1:]

    def slope_and_change(self, state: EnvState) -> tuple[jax.Array, jax.Array]:
        """The slope, and its time derivative (3,) [1/(rad s)] in the motion of the body; zones are taken to rest.

        That is the Hessian of V times the motion, exactly; the equation that the papers' text has for it is not needed.
        """
        q_BN = state.body.q_BN
        moving = dynamics.attitude_rate(q_BN, state.body.omega_BN_B)
        return jax.jvp(lambda at: self.slope(at, state.scenario), (q_BN,), (moving,))


def action(torque_B: jax.Array, limits: TorqueLimits) -> jax.Array:
    """Action (3,) for a torque (3,) [N m], each component of which is cut at its limit."""
    return jnp.clip(torque_B / limits.box_B, -1.0, 1.0)


def _barrier(q_BN: jax.Array, zone: PointingConstraint) -> jax.Array:
    look_N = rotations.rotate(q_BN, zone.boresight_B)
    room = 0.5 * (jnp.cos(zone.half_angle) - rotations.dot(look_N, zone.axis_N))
    return jnp.maximum(_LEAST_ROOM - room, 0.0) / _LEAST_ROOM - jnp.log(jnp.maximum(room, _LEAST_ROOM))
