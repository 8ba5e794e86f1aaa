"""Torque that leads the boresights around zones and away from them, where a request cannot pass."""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.config.shield import ShieldConfig
from koz_jax.control.shield.brake_path import Brake
from koz_jax.task import dynamics, pointing_constraints, rotations
from koz_jax.task.actuators import TorqueLimits
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.state import Model, nominal_rate

# In units of T = sqrt(J / u), J a third of the trace of the inertia, u the strength of the actuators.
_SECONDS_T = 0.09
_RATE_T = 0.574

# [rad] How far it leads in a time step, at most.
_ARC = 0.1

# Of a rate limit, which coasting may reach about other axes.
_RATE_SHARE = 0.5

# A request is taken to act for so many times the guide's own seconds where it is asked to which side it pushes, and
# what is missing to the margin is made good in as many.
AHEAD = 2.0


# Steps in which a slow craft comes to rest, whatever it is asked for, with the one that is decided on.
_STEPS = 6.0


class Guide(struct.PyTreeNode):
    """A guide made for one spacecraft; traced."""

    margin: jax.Array  # () [rad] that it keeps from every zone
    rate: jax.Array  # () [rad/s] with which a boresight is led around a zone
    seconds: jax.Array  # () [s] in which the rate is taken up
    tilt: jax.Array  # () tangent of the angle by which the way around leads away from the zone


def from_config(
    config: ShieldConfig, brake: Brake, margin: jax.Array, seconds: jax.Array, limits: TorqueLimits, model: Model
) -> Guide:
    """Make a guide: as fast as the settings say, or as suits the spacecraft.

    margin: () [rad] of the shield; the guide's is larger by what comes closer before it leads away, see ``soon``.
    seconds: () [s], see ``take_up_seconds``.
    """
    wanted = _RATE_T / _unit(limits, model)
    if config.guide_rate_deg is not None:
        wanted = jnp.deg2rad(jnp.float32(config.guide_rate_deg))
    rate = jnp.minimum(wanted, _ARC / model.dt)
    largest = nominal_rate(model)
    if largest is not None:
        rate = jnp.minimum(rate, _RATE_SHARE * largest)
    e = brake.inertia_error
    return Guide(
        margin=margin + brake.approach * brake.soon,
        rate=rate,
        seconds=seconds,
        # A brake path that may be wrong by this share of its length then still leads away.
        tilt=e / (1.0 - e) + brake.disturbance / brake.torque + (rate * model.dt) ** 2,
    )


def take_up_seconds(limits: TorqueLimits, model: Model) -> jax.Array:
    """Time in which a guide takes up its rate.  Returns () [s]."""
    return jnp.maximum(_SECONDS_T * _unit(limits, model), model.dt)


def soon(seconds: jax.Array, dt: jax.Array) -> jax.Array:
    """Time in which a guide that takes up its rate in so many seconds leads away from a zone.  Returns () [s].

    The rate that leads away grows with what is missing to twice the margin: where all is missing that comes closer in
    this time, it is at least AHEAD times as fast as that comes.
    """
    return 2.0 * AHEAD * seconds + _STEPS * dt


def _unit(limits: TorqueLimits, model: Model) -> jax.Array:
    """T.  Returns () [s]."""
    return jnp.sqrt(jnp.trace(model.inertia_B) / (3.0 * limits.scale))


def torques(
    guide: Guide,
    body: RigidBodyState,
    torque_B: jax.Array,
    constraints: PointingConstraint,
    limits: TorqueLimits,
    model: Model,
) -> tuple[jax.Array, jax.Array]:
    """Lead around the nearest zone, to the side that the boresight moves or is pushed to, and away from all near ones.

    torque_B: (3,) [N m] that is requested.  Returns two torques (3,) [N m] within the box: one that leads around and
    away, one that only leads away.
    """
    margins = pointing_constraints.margins(body.q_BN, constraints)
    margins = jnp.where(constraints.is_present, margins, jnp.inf)
    away_B = jax.vmap(_turn_away, in_axes=(None, 0))(body.q_BN, constraints)
    nearest = jnp.argmin(margins)
    side_B = rotations.cross(away_B[nearest], constraints.boresight_B[nearest])
    inverse_B = dynamics.inverse(model.inertia_B)
    pushed_B = dynamics.angular_acceleration(body.omega_BN_B, torque_B, model.inertia_B, inverse_B)
    soon_B = body.omega_BN_B + AHEAD * guide.seconds * pushed_B
    sideways = jnp.where(rotations.dot(soon_B, side_B) >= 0.0, guide.rate, -guide.rate)
    missing = jnp.clip((2.0 * guide.margin - margins) / (AHEAD * guide.seconds), 0.0, guide.rate)
    away_rate_B = jnp.sum(missing[:, None] * away_B, axis=0)
    # What leads away from other zones does not take from what leads away from the nearest.
    taken = jnp.maximum(missing[nearest] - rotations.dot(away_rate_B, away_B[nearest]), 0.0)
    away_rate_B += taken * away_B[nearest]
    around_B = sideways * side_B + guide.tilt * guide.rate * away_B[nearest]
    gyroscopic_B = dynamics.gyroscopic_torque(body.omega_BN_B, model.inertia_B)

    def towards(rate_B: jax.Array) -> jax.Array:
        change_B = (rate_B - body.omega_BN_B) / guide.seconds
        wanted_B = dynamics.matvec(model.inertia_B, change_B) + gyroscopic_B
        return wanted_B / jnp.maximum(1.0, jnp.max(jnp.abs(wanted_B) / limits.box_B))

    return towards(around_B + away_rate_B), towards(away_rate_B)


def _turn_away(q_BN: jax.Array, constraint: PointingConstraint) -> jax.Array:
    """Body axis about which a turn leads the boresight away from the zone's axis; zero where they are in line.

    Returns (3,) unit vector, square to the boresight.
    """
    turn_B = rotations.cross(pointing_constraints.axis_B(q_BN, constraint), constraint.boresight_B)
    size = rotations.norm(turn_B)
    return turn_B / jnp.where(size > 0.0, size, 1.0)
