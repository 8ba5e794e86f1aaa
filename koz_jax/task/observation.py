"""The observation (Eq. 6 of the paper) of a state, packed in the order of ``observation_layout.layout``."""

import functools

import jax
import jax.numpy as jnp

from koz_jax.task import pointing_constraints, rotations
from koz_jax.task.observation_layout import layout, zone_part
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.state import EnvState, attitude_error


def observe(state: EnvState, zones: int = 1) -> jax.Array:
    """What the controller sees.  Returns (16 + 5 (zones - 1),), in the order of ``layout(zones)``.

    A zone after the first that is absent reads margin pi, angle pi and direction zero.
    """
    nearest = nearest_constraints(state, zones)
    parts = {
        "q_e": attitude_error(state),
        "omega_BN_B": state.body.omega_BN_B,
        "boresight_B": nearest.boresight_B[0],
        "q_e0_previous": state.q_e0_previous[None],
    }
    for number in range(zones):
        seen = _zone_parts(state, jax.tree.map(lambda leaf, i=number: leaf[i], nearest), masked=number > 0)
        parts |= {zone_part(number, name): value for name, value in seen.items()}
    return jnp.concatenate([parts[name] for name in layout(zones)])


def nearest_constraints(state: EnvState, count: int) -> PointingConstraint:
    """The zones with the smallest margins, nearest first, filled up with absent ones.  Returns leaves (count, ...)."""
    zones = state.scenario.constraints
    present = zones.count
    if present > 1:
        ranks = _ranks(pointing_constraints.margins(state.body.q_BN, zones))
        chosen = ranks[None] == jnp.arange(min(count, present))[:, None]
        zones = jax.tree.map(functools.partial(_picked, chosen), zones)
    if count > present:
        zones = pointing_constraints.filled_up(zones, count)
    return zones


def _ranks(values: jax.Array) -> jax.Array:
    """The place of each of a few values (n,) in their ascending order, that of equal ones kept.  Returns (n,) int32.

    To count the smaller ones is many times faster than to sort where there are many environments.
    """
    places = jnp.arange(values.size)
    earlier = (values[None] == values[:, None]) & (places[None] < places[:, None])
    return jnp.sum((values[None] < values[:, None]) | earlier, axis=1)


def _picked(chosen: jax.Array, leaf: jax.Array) -> jax.Array:
    """Rows of a leaf (n, ...), one for each row of ``chosen`` (k, n), which is true at one place.  Returns (k, ...)."""
    return jnp.sum(jnp.where(chosen.reshape(*chosen.shape, *[1] * (leaf.ndim - 1)), leaf[None], 0.0), axis=1)


def _zone_parts(state: EnvState, zone: PointingConstraint, masked: bool) -> dict[str, jax.Array]:
    q_BN = state.body.q_BN
    offset = pointing_constraints.axis_B(q_BN, zone) - zone.boresight_B
    distance = rotations.norm(offset)
    angle = pointing_constraints.angle_to_axis(q_BN, zone)
    parts = {
        "zone_margin": (angle - zone.half_angle)[None],
        "zone_angle": angle[None],
        # The direction is undefined where the two coincide; zero is finite and points nowhere.
        "zone_direction_B": offset / jnp.where(distance > 0.0, distance, 1.0),
    }
    if not masked:
        return parts
    absent = {"zone_margin": jnp.pi, "zone_angle": jnp.pi, "zone_direction_B": 0.0}
    return {name: jnp.where(zone.is_present, value, absent[name]) for name, value in parts.items()}
