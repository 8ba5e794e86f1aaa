"""What is drawn on the unit sphere, as points; and how a viewer far away sees it.  Draws nothing.

Directions are NumPy arrays (..., 3) of unit vectors in inertial axes.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from koz_jax.config import attitudes
from koz_jax.evaluation.rollout import History
from koz_jax.task import rotations


@dataclasses.dataclass(frozen=True)
class Zone:
    """A keep-out zone, on the host."""

    axis_N: np.ndarray  # (3,) unit vector
    half_angle: float  # [rad]
    last_axis_N: np.ndarray | None = None  # (3,) axis at the end of the maneuver; None where it does not turn
    rate_N: np.ndarray | None = None  # (3,) [rad/s] angular velocity of the axis; None where it does not turn

    @property
    def turns(self) -> bool:
        """Whether its axis turns."""
        return self.rate_N is not None

    @property
    def size(self) -> str:
        """How large it is, for legends; of more than half of the sphere, the cone that is left."""
        half_angle_deg = np.rad2deg(self.half_angle)
        if half_angle_deg > 90.0:
            return f"kept in {180.0 - half_angle_deg:.1f}°"
        return f"half angle {half_angle_deg:.1f}°"


def zones(history: History) -> list[Zone]:
    """The zones of the telescope as they are at the start; stand-ins for "no zone" are left out.

    Where other instruments look is not drawn, so their zones are left out too.
    """
    first, last = (
        jax.tree.map(lambda leaf, at=at: np.asarray(leaf[at], np.float64), history.state.scenario.constraints)
        for at in (0, -1)
    )
    rates_N = np.zeros_like(first.axis_N) if first.axis_rate_N is None else first.axis_rate_N
    turns = np.any(rates_N, axis=1)
    own = np.all(np.isclose(first.boresight_B, first.boresight_B[0]), axis=1)
    return [
        Zone(
            attitudes.normalized(first.axis_N[i]),
            float(first.half_angle[i]),
            attitudes.normalized(last.axis_N[i]) if turns[i] else None,
            rates_N[i] if turns[i] else None,
        )
        for i in np.flatnonzero(own & (first.half_angle > 0.0))
    ]


def zone_names(found: list[Zone]) -> list[str]:
    """What to call zones in legends: numbered from 1 where there are several."""
    return (
        [f"zone {number}" for number in range(1, len(found) + 1)] if len(found) > 1 else ["keep-out zone"] * len(found)
    )


def boresight(history: History) -> np.ndarray:
    """The telescope in body axes, that of the first constraint.  Returns (3,) unit vector."""
    return np.asarray(history.state.scenario.constraints.boresight_B[0, 0])


def boresight_trace(history: History) -> np.ndarray:
    """Where the telescope looked at every instant.  Returns (steps + 1, 3)."""
    turned = jax.vmap(rotations.rotate, in_axes=(0, None))(history.state.body.q_BN, jnp.asarray(boresight(history)))
    return np.asarray(turned, np.float64)


def shortest_path(
    q_BN: np.ndarray | jax.Array,
    q_DN: np.ndarray | jax.Array,
    boresight_B: np.ndarray,
    points: int = 201,
) -> np.ndarray:
    """Trace of the boresight along the eigen-axis rotation from an attitude to the desired one.

    q_BN, q_DN: (4,) unit; boresight_B: (3,).  Returns (points, 3), start first.
    """
    q_DN = jnp.asarray(q_DN)
    q_e = rotations.multiply(rotations.conjugate(q_DN), jnp.asarray(q_BN))
    q_e = jnp.where(q_e[0] < 0.0, -q_e, q_e)  # q and -q are one attitude; this sign has the shorter rotation
    angle, sine = rotations.rotation_angle(q_e), rotations.norm(q_e[1:])
    axis = jnp.where(sine > 0.0, q_e[1:] / jnp.maximum(sine, 1e-12), jnp.array([1.0, 0.0, 0.0]))

    def looking(angle: jax.Array) -> jax.Array:
        q_LN = rotations.multiply(q_DN, rotations.from_axis_angle(axis, angle))
        return rotations.rotate(q_LN, jnp.asarray(boresight_B))

    return np.asarray(jax.vmap(looking)(jnp.linspace(angle, 0.0, points)), np.float64)


def zone_turns(zone: Zone, seconds: np.ndarray) -> np.ndarray:
    """How far a zone has turned since the start.  seconds: (n,) [s].  Returns quaternions (n, 4)."""
    rate_N = np.zeros(3) if zone.rate_N is None else zone.rate_N
    speed = np.linalg.norm(rate_N)
    return attitudes.turn_about(rate_N / (speed or 1.0), speed * seconds)


def zone_circle(zone: Zone, points: int = 361) -> np.ndarray:
    """Edge of a zone on the sphere: all directions at the half angle from its axis.  Returns (points, 3), closed."""
    across = np.cross(zone.axis_N, np.eye(3)[np.argmin(np.abs(zone.axis_N))])
    across /= np.linalg.norm(across)
    turn = np.linspace(0.0, 2.0 * np.pi, points)[:, None]
    around = across * np.cos(turn) + np.cross(zone.axis_N, across) * np.sin(turn)
    return zone.axis_N * np.cos(zone.half_angle) + around * np.sin(zone.half_angle)


def inside(directions_N: np.ndarray, zone: Zone) -> np.ndarray:
    """Which directions lie in a zone or on its edge.  directions_N: (..., 3).  Returns (...) bool."""
    return directions_N @ zone.axis_N >= np.cos(zone.half_angle)


def graticule(step_deg: float = 30.0, points: int = 181) -> list[np.ndarray]:
    """Meridians and parallels of the inertial axes.  Returns lines (points, 3)."""
    lines = []
    along = np.linspace(-np.pi / 2, np.pi / 2, points)
    for longitude in np.deg2rad(np.arange(0.0, 360.0, step_deg)):
        lines.append(_direction(longitude, along))
    around = np.linspace(0.0, 2.0 * np.pi, points)
    for latitude in np.deg2rad(np.arange(-90.0 + step_deg, 90.0, step_deg)):
        lines.append(_direction(around, latitude))
    return lines


def _direction(longitude: np.ndarray | float, latitude: np.ndarray | float) -> np.ndarray:
    x, y, z = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


@dataclasses.dataclass(frozen=True)
class View:
    """A viewer far away (orthographic projection)."""

    axes_N: np.ndarray  # (3, 3) rows: to the right, up, and towards the viewer

    def project(self, points_N: np.ndarray) -> np.ndarray:
        """points_N: (..., 3).  Returns (..., 3): right, up, and depth (positive on the side that faces the viewer)."""
        return points_N @ self.axes_N.T

    def sphere_directions(self, pixels: int) -> np.ndarray:
        """What a square picture of the sphere shows.  Returns (pixels, pixels, 3), nan beside the sphere; top first."""
        across = np.linspace(-1.0, 1.0, pixels)
        right, up = np.meshgrid(across, -across)
        squared = 1.0 - right**2 - up**2
        depth = np.sqrt(np.where(squared >= 0.0, squared, np.nan))
        return np.stack([right, up, depth], axis=-1) @ self.axes_N


def view_of(points_N: np.ndarray) -> View:
    """Look at points so that the one nearest to the horizon is as far from it as can be.

    points_N: (n, 3).  The inertial z axis points up in the picture where it can.
    """
    candidates = _spread_directions(2000)
    towards_N = candidates[np.argmax((candidates @ points_N.T).min(axis=1))]
    up_N = np.array([0.0, 1.0, 0.0]) if abs(towards_N[2]) > 0.97 else np.array([0.0, 0.0, 1.0])
    right_N = np.cross(up_N, towards_N)
    right_N /= np.linalg.norm(right_N)
    return View(np.stack([right_N, np.cross(towards_N, right_N), towards_N]))


def _spread_directions(count: int) -> np.ndarray:
    """Directions spread evenly over the sphere (Fibonacci's spiral).  Returns (count, 3)."""
    index = np.arange(count)
    return _direction(index * np.pi * (3.0 - np.sqrt(5.0)), np.arcsin(1.0 - (2.0 * index + 1.0) / count))


def front_and_back(projected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parts of a line on the side that faces the viewer and on the other; nan where a part is interrupted.

    projected: (n, 3) of ``View.project``.  Returns two arrays (n, 2).
    """
    front = projected[:, 2] >= 0.0
    # A step over the horizon belongs to the far side, so that the line has no gap there.
    beside_back = ~front | np.append(~front[1:], False) | np.append(False, ~front[:-1])
    flat = projected[:, :2]
    return np.where(front[:, None], flat, np.nan), np.where(beside_back[:, None], flat, np.nan)


@dataclasses.dataclass(frozen=True)
class SphereTraces:
    """What the sphere of one maneuver shows."""

    zones: list[Zone]
    circles_N: list[np.ndarray]  # edge of each zone, (points, 3)
    trace_N: np.ndarray  # (steps + 1, 3) flown
    shortest_N: np.ndarray  # (points, 3) along the eigen-axis rotation
    deviation: float  # [rad] of the attitude at the start
    view: View


def sphere_traces(history: History) -> SphereTraces:
    """Compute what is drawn.  The scenario alone decides the view: two agents on one case are seen alike."""
    found = zones(history)
    circles_N = [zone_circle(zone) for zone in found]
    shortest_N = shortest_path(history.state.body.q_BN[0], history.state.scenario.q_DN[0], boresight(history))
    return SphereTraces(
        zones=found,
        circles_N=circles_N,
        trace_N=boresight_trace(history),
        shortest_N=shortest_N,
        deviation=float(history.state.angle[0]),
        view=view_of(np.concatenate([shortest_N, *circles_N])),
    )
