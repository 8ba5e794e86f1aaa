"""The observation (Eq. 6 of the paper) of a state, packed in the order of ``layout``."""

import jax
import jax.numpy as jnp

from koz_jax import env, keep_out, rotations
from koz_jax.env import EnvParams, EnvState
from koz_jax.keep_out import KeepOutZone
from koz_jax.layout import LAYOUT, SIZE, SLICES, layout, size, slices, zone_part

__all__ = ["LAYOUT", "SIZE", "SLICES", "layout", "observe", "size", "slices"]


def observe(state: EnvState, params: EnvParams, zones: int = 1) -> jax.Array:
    """What the controller sees.  Returns (16 + 5 (zones - 1),), in the order of ``layout(zones)``.

    A zone after the first that is absent reads margin pi, angle pi and direction zero.
    """
    parts = {
        "q_e": env.attitude_error(state),
        "omega_BN_B": state.body.omega_BN_B,
        "boresight_B": params.spacecraft.boresight_B,
        "q_e0_previous": state.q_e0_previous[None],
    }
    nearest = _nearest(state, params, zones)
    for number in range(zones):
        seen = _zone_parts(state, params, jax.tree.map(lambda leaf, i=number: leaf[i], nearest), masked=number > 0)
        parts |= {zone_part(number, name): value for name, value in seen.items()}
    return jnp.concatenate([parts[name] for name in layout(zones)])


def _nearest(state: EnvState, params: EnvParams, count: int) -> KeepOutZone:
    """The zones with the smallest margins, nearest first, filled up with absent ones.  Returns leaves (count, ...)."""
    zones = state.scenario.zones
    present = zones.half_angle.shape[0]
    if present > 1:
        margins = jax.vmap(keep_out.margin, in_axes=(None, 0))(env.boresight_N(state.body, params.spacecraft), zones)
        order = jnp.argsort(margins)[:count]
        zones = jax.tree.map(lambda leaf: leaf[order], zones)
    if count > present:
        zones = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), zones, keep_out.no_zones(count - present))
    return zones


def _zone_parts(state: EnvState, params: EnvParams, zone: KeepOutZone, masked: bool) -> dict[str, jax.Array]:
    boresight_B = params.spacecraft.boresight_B
    axis_B = rotations.rotate(rotations.conjugate(state.body.q_BN), zone.axis_N)
    offset = axis_B - boresight_B
    distance = rotations.norm(offset)
    angle = keep_out.angle_to_axis(env.boresight_N(state.body, params.spacecraft), zone)
    parts = {
        "zone_margin": (angle - zone.half_angle)[None],
        "zone_angle": angle[None],
        # The direction is undefined where the two coincide; zero is finite and points nowhere.
        "zone_direction_B": offset / jnp.where(distance > 0.0, distance, 1.0),
    }
    if not masked:
        return parts
    absent = {"zone_margin": jnp.pi, "zone_angle": jnp.pi, "zone_direction_B": 0.0}
    return {name: jnp.where(zone.half_angle > 0.0, value, absent[name]) for name, value in parts.items()}
