"""The observation (Eq. 6 of the paper), declared once: sizes, slices and plots derive from ``LAYOUT``."""

import itertools

import jax
import jax.numpy as jnp

from koz_jax import env, keep_out, rotations
from koz_jax.env import EnvParams, EnvState

LAYOUT = {
    "q_e": 4,  # attitude relative to the target
    "omega_BN_B": 3,  # [rad/s]
    "boresight_B": 3,  # unit vector
    "zone_margin": 1,  # [rad] theta_margin
    "zone_angle": 1,  # [rad] theta
    "zone_direction_B": 3,  # unit vector from the boresight towards the zone's axis
    "q_e0_previous": 1,  # scalar part of q_e one step ago
}
SIZE = sum(LAYOUT.values())
SLICES = {
    name: slice(end - size, end)
    for (name, size), end in zip(LAYOUT.items(), itertools.accumulate(LAYOUT.values()), strict=True)
}


def observe(state: EnvState, params: EnvParams) -> jax.Array:
    """What the controller sees.  Returns (16,), in the order of ``LAYOUT``."""
    boresight_B = params.spacecraft.boresight_B
    zone = jax.tree.map(lambda leaf: leaf[0], state.scenario.zones)
    axis_B = rotations.rotate(rotations.conjugate(state.body.q_BN), zone.axis_N)
    offset = axis_B - boresight_B
    distance = rotations.norm(offset)
    angle = keep_out.angle_to_axis(env.boresight_N(state.body, params.spacecraft), zone)
    parts = {
        "q_e": env.attitude_error(state),
        "omega_BN_B": state.body.omega_BN_B,
        "boresight_B": boresight_B,
        "zone_margin": (angle - zone.half_angle)[None],
        "zone_angle": angle[None],
        # The direction is undefined where the two coincide; zero is finite and points nowhere.
        "zone_direction_B": offset / jnp.where(distance > 0.0, distance, 1.0),
        "q_e0_previous": state.q_e0_previous[None],
    }
    return jnp.concatenate([parts[name] for name in LAYOUT])
