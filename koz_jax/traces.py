"""Curves on the unit sphere, for pictures: where the boresight went, the shortest way, the edge of a zone."""

import jax
import jax.numpy as jnp
import numpy as np

from koz_jax import env, rotations
from koz_jax.rollout import History
from koz_jax.scenario import Scenario


def boresight_trace(history: History, boresight_B: jax.Array) -> np.ndarray:
    """Where the boresight looks at every instant.  boresight_B: (3,).  Returns (steps + 1, 3) in inertial axes."""
    return np.asarray(jax.vmap(rotations.rotate, in_axes=(0, None))(history.state.body.q_BN, boresight_B))


def shortest_path(scenario: Scenario, boresight_B: jax.Array, points: int = 91) -> np.ndarray:
    """Where the boresight looks along the shortest (eigen-axis) rotation from start to target.

    boresight_B: (3,).  Returns (points, 3) in inertial axes, the start first.
    """
    q_e = env.attitude_error(env.reset(scenario))
    q_e = jnp.where(q_e[0] < 0.0, -q_e, q_e)  # q and -q are one attitude; this one is the shorter way
    length = rotations.norm(q_e[1:])
    axis = q_e[1:] / jnp.where(length > 0.0, length, 1.0)

    def at(share_left: jax.Array) -> jax.Array:
        left = rotations.from_axis_angle(axis, share_left * rotations.rotation_angle(q_e))
        return rotations.rotate(rotations.multiply(scenario.q_DN, left), boresight_B)

    return np.asarray(jax.vmap(at)(jnp.linspace(1.0, 0.0, points)))


def circle(axis: np.ndarray, half_angle: float, points: int = 121) -> np.ndarray:
    """Directions at one angle from an axis: the edge of a zone.

    axis: (3,) unit; half_angle: [rad].  Returns (points, 3); the last is the first again.
    """
    across = perpendicular(axis)
    around = np.linspace(0.0, 2.0 * np.pi, points)[:, None]
    rim = np.cos(around) * across + np.sin(around) * np.cross(axis, across)
    return np.cos(half_angle) * axis + np.sin(half_angle) * rim


def perpendicular(axis: np.ndarray) -> np.ndarray:
    """Return some unit vector (3,) at a right angle to a unit vector (3,)."""
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    return across / np.linalg.norm(across)


def true_zones(scenario: Scenario) -> list[tuple[np.ndarray, float]]:
    """Axis (3,) in inertial axes and half angle [rad] of every zone that there is."""
    axes, half_angles = np.asarray(scenario.zones.axis_N), np.asarray(scenario.zones.half_angle)
    return [(axis, float(angle)) for axis, angle in zip(axes, half_angles, strict=True) if angle > 0.0]
