"""What a policy for any spacecraft sees and commands: all in units of the spacecraft, in axes of the instrument.

The observation holds the attitude error, the rate and the nearest zones as the paper's does, but in the units and axes
of ``units``, then what tells spacecraft apart: shape of the inertia, torque, time step, rate limit; what that means for
this motion: how long the torque takes to stop the rate, and to turn by the attitude error; and the urgency.  The action
is an angular acceleration, so that slender bodies are turned about each axis with the same gain.
"""

import jax
import jax.numpy as jnp

from koz_jax.task import dynamics, observation, pointing_constraints, rotations
from koz_jax.task.any_spacecraft import units
from koz_jax.task.any_spacecraft.units import Units
from koz_jax.task.observation_layout import (
    FREE_RATE,
    FULL_ACTION,
    LEAST_RATE,
    LONGEST_TIME,
    SHORTEST_STEP,
    layout,
    zone_part,
)
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.state import EnvState, Model, attitude_error, largest_rate, torque_limits


def observe(state: EnvState, model: Model, urgency: jax.Array | float, zones: int = 1) -> jax.Array:
    """What the policy sees.

    urgency: () in [0, 1].  Returns (entries,), in the order of ``layout(zones, scaled=True)``; a zone that is absent
    reads margin pi, angle pi, and directions zero.
    """
    nearest = observation.nearest_constraints(state, zones)
    axes = units.policy_axes(nearest.boresight_B[0])
    own = units.of(model)
    q_e = attitude_error(state)
    box_B = torque_limits(state, model).box_B
    stopping = jnp.minimum(units.time_of_torque(state.body.omega_BN_B, box_B, model) / own.time, LONGEST_TIME)
    turning = jnp.minimum(units.time_of_torque(2.0 * q_e[1:], box_B, model) / own.time**2, LONGEST_TIME**2 / 2)
    parts = {
        "q_e": jnp.concatenate([q_e[:1], dynamics.matvec(axes, q_e[1:])]),
        "omega_BN_P": own.time * dynamics.matvec(axes, state.body.omega_BN_B),
        "inertia": _entries(axes @ model.inertia_B @ axes.T) / own.inertia,
        "reach": _reach(axes, box_B) / own.torque,
        "step": jnp.log(jnp.maximum(model.dt / (own.time * SHORTEST_STEP), 1.0))[None],
        "rate_limit": _rate_limit(largest_rate(state, model), own)[None],
        "stopping": jnp.stack([stopping, 0.5 * stopping**2]),
        "turning": turning[None],
        "urgency": jnp.full(1, 2.0 * urgency - 1.0),
    }
    for name, values in jax.vmap(_zone_parts, in_axes=(None, 0, None))(state.body.q_BN, nearest, axes).items():
        parts |= {zone_part(number, name): value for number, value in enumerate(values)}
    return jnp.concatenate([parts[name] for name in layout(zones, scaled=True)])


def command(action: jax.Array, state: EnvState, model: Model) -> jax.Array:
    """What the actuators are asked for by an action (3,) in [-1, 1].  Returns (3,), shares of the torque limits."""
    axes = units.policy_axes(observation.nearest_constraints(state, 1).boresight_B[0])
    torque_B = units.torque_for(FULL_ACTION * action, axes, model)
    return torque_B / torque_limits(state, model).box_B


def _rate_limit(largest: jax.Array | None, own: Units) -> jax.Array:
    """Log of the rate limit () [rad/s] over that from which it is none.  Returns (), 0 where there is none."""
    if largest is None:
        return jnp.zeros(())
    return jnp.log(jnp.clip(largest * own.time / FREE_RATE, LEAST_RATE, 1.0))


def _entries(tensor: jax.Array) -> jax.Array:
    """The six entries of a symmetric tensor (3, 3)."""
    return jnp.concatenate([jnp.diag(tensor), jnp.stack([tensor[0, 1], tensor[0, 2], tensor[1, 2]])])


def _reach(axes: jax.Array, box_B: jax.Array) -> jax.Array:
    """Largest torque of the box along each axis.  axes: (3, 3) rows; box_B: (3,) [N m].  Returns (3,) [N m]."""
    return jnp.min(box_B[None] / jnp.maximum(jnp.abs(axes), 1e-6), axis=1)


def _zone_parts(q_BN: jax.Array, zone: PointingConstraint, axes: jax.Array) -> dict[str, jax.Array]:
    offset = pointing_constraints.axis_B(q_BN, zone) - zone.boresight_B
    distance = rotations.norm(offset)
    angle = pointing_constraints.angle_to_axis(q_BN, zone)
    boresight_P = dynamics.matvec(axes, zone.boresight_B)
    direction_P = dynamics.matvec(axes, offset / jnp.where(distance > 0.0, distance, 1.0))
    return {
        "boresight_P": jnp.where(zone.is_present, boresight_P, 0.0),
        "zone_margin": jnp.where(zone.is_present, angle - zone.half_angle, jnp.pi)[None],
        "zone_angle": jnp.where(zone.is_present, angle, jnp.pi)[None],
        "zone_direction_P": jnp.where(zone.is_present, direction_P, 0.0),
    }
