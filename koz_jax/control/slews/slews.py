"""A choice of slews from an attitude, and what a slew comes to; kinematics only.

Eighteen slews turn by a fixed angle about the body axes and the axes midway between two of them, one turns towards the
target: by the same angle, or all the way where that is less.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from koz_jax.control import feedback
from koz_jax.task import pointing_constraints, rotations
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.state import EnvState, attitude_error

SLEW_ANGLE = float(np.deg2rad(20.0))  # [rad]

# Instants of a slew at which its margin is looked at.
_INSTANTS = 8

_THERE = 1e-3  # [rad]

_corners = [np.array(way, float) for way in itertools.product((-1, 0, 1), repeat=3)]
AXES_B = np.array([way / np.linalg.norm(way) for way in _corners if 1 <= np.abs(way).sum() <= 2], np.float32)  # (18, 3)

COUNT = len(AXES_B) + 1


class Slewed(struct.PyTreeNode):
    """What a slew comes to."""

    state: EnvState  # at rest
    angle: jax.Array  # () [rad] by which it turns
    margin: jax.Array  # () [rad] smallest margin on the way


def at_rest(state: EnvState, q_BN: jax.Array) -> EnvState:
    """The same maneuver at another attitude (4,), at rest."""
    rested = state.replace(body=RigidBodyState(q_BN, jnp.zeros(3)))
    q_e = attitude_error(rested)
    return rested.replace(angle=rotations.rotation_angle(q_e), q_e0_previous=q_e[0])


def is_there(state: EnvState) -> jax.Array:
    """Whether an attitude is that of the target.  Returns () bool."""
    return state.angle < _THERE


def slew(state: EnvState, choice: jax.Array) -> Slewed:
    """Slew from an attitude at rest.  choice: () int32, below ``COUNT``."""
    error_B = feedback.error_vector(state)
    left = rotations.norm(error_B)
    home_B = -error_B * jnp.minimum(1.0, SLEW_ANGLE / jnp.maximum(left, SLEW_ANGLE))
    turn_B = jnp.concatenate([SLEW_ANGLE * AXES_B, home_B[None]])[choice]

    def turned(share: jax.Array) -> jax.Array:
        return rotations.multiply(state.body.q_BN, feedback.from_rotation_vector(share * turn_B))

    shares = (jnp.arange(_INSTANTS) + 1.0) / _INSTANTS
    way = jax.vmap(turned)(shares)
    margins = jax.vmap(pointing_constraints.smallest_margin, in_axes=(0, None))(way, state.scenario.constraints)
    return Slewed(at_rest(state, rotations.normalize(way[-1])), rotations.norm(turn_B), jnp.min(margins))
