"""Pictures of a maneuver under way on the sphere of directions, in NumPy alone.

Zones are red, the boresight's trace is black, its start a blue cross, the target a green ring and where the boresight
looks now a black dot.  What lies on the far side is faint.
"""

import numpy as np
import numpy.typing as npt

from koz_jax.config import attitudes
from koz_jax.task import host
from koz_jax.task.scenario import Scenario

_PIXELS = 480
_RADIUS = 0.92  # of the sphere, in halves of the picture
_FAINT = 0.35  # opacity of what lies on the far side

_WHITE, _BLACK = np.array([1.0, 1.0, 1.0]), np.array([0.0, 0.0, 0.0])
_ZONE, _START, _TARGET = np.array([0.835, 0.369, 0.0]), np.array([0.0, 0.447, 0.698]), np.array([0.0, 0.62, 0.451])

Picture = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]


class SphereDrawing:
    """A maneuver on the sphere, seen from far away (orthographic), drawn on as it goes on."""

    def __init__(self, drawn: Scenario) -> None:
        """Draw what does not move.  drawn: with NumPy leaves; the instrument of its first constraint is shown."""
        zones = host.Cones(*(np.asarray(leaf, np.float64) for leaf in (_leaves(drawn))))
        self._zones = host.Cones(*(leaf[zones.half_angle > 0.0] for leaf in zones))
        self._boresight_B = zones.boresight_B[0]
        self._q_DN = np.asarray(drawn.q_DN, np.float64)
        start_N = self._look(np.asarray(drawn.initial.q_BN, np.float64))
        target_N = self._look(self._q_DN)
        self._view_N = _view(np.stack([start_N, target_N, *self._zones.axis_N]))
        self._canvas = self._sphere()
        self._mark(self._canvas, start_N, _START, _cross(7.0, 1.6))
        self._mark(self._canvas, target_N, _TARGET, _ring(8.0, 1.6))
        self._last_N = start_N
        self.add(np.asarray(drawn.initial.q_BN, np.float64))

    def add(self, q_BN: Floats) -> None:
        """Go on to an attitude (4,)."""
        look_N = self._look(q_BN)
        # So many dots that the line has no gaps.
        apart = float(attitudes.angle_between(look_N, self._last_N))
        for share in np.linspace(0.0, 1.0, 2 + int(apart * _PIXELS / 2)):
            between_N = attitudes.normalized((1.0 - share) * self._last_N + share * look_N + 1e-12)
            self._mark(self._canvas, between_N, _BLACK, _disc(1.4))
        self._last_N = look_N

    def add_error(self, q_e: npt.NDArray[np.float32]) -> None:
        """Go on to where the attitude error is q_e (4,), q_DN* (x) q_BN."""
        self.add(attitudes.normalized(attitudes.multiply(self._q_DN, np.asarray(q_e, np.float64))))

    def picture(self) -> Picture:
        """Draw where the boresight looks now.  Returns (480, 480, 3) uint8."""
        shown = self._canvas.copy()
        self._mark(shown, self._last_N, _BLACK, _disc(5.0))
        return np.round(255.0 * shown).astype(np.uint8)

    def _look(self, q_BN: Floats) -> Floats:
        return attitudes.rotate(q_BN, self._boresight_B)

    def _sphere(self) -> Floats:
        """Draw a lit sphere with its zones tinted.  Returns (pixels, pixels, 3) in [0, 1]."""
        across = np.linspace(-1.0, 1.0, _PIXELS) / _RADIUS
        right, up = np.meshgrid(across, -across)
        squared = 1.0 - right**2 - up**2
        depth = np.sqrt(np.maximum(squared, 0.0))
        colour = (0.8 + 0.19 * (-0.35 * right + 0.45 * up + 0.82 * depth))[..., None] * np.ones(3)
        for opacity, side in ((_FAINT * 0.35, -depth), (0.35, depth)):
            directions_N = np.stack([right, up, side], axis=-1) @ self._view_N
            for axis_N, half_angle in zip(self._zones.axis_N, self._zones.half_angle, strict=True):
                tint = opacity * (directions_N @ axis_N >= np.cos(half_angle))[..., None]
                colour = (1.0 - tint) * colour + tint * _ZONE
        return np.where((squared >= 0.0)[..., None], np.clip(colour, 0.0, 1.0), _WHITE)

    def _mark(self, canvas: Floats, direction_N: Floats, colour: Floats, stamp: Floats) -> None:
        """Blend a stamp (n, n) of opacities over a direction (3,), faint where it is on the far side."""
        right, up, depth = self._view_N @ direction_N
        column, row = (round(0.5 * (_PIXELS - 1) * (1.0 + _RADIUS * at)) for at in (right, -up))
        half = len(stamp) // 2
        place = (slice(row - half, row + half + 1), slice(column - half, column + half + 1))
        opacity = (stamp if depth >= 0.0 else _FAINT * stamp)[..., None]
        canvas[place] = (1.0 - opacity) * canvas[place] + opacity * colour


def _leaves(drawn: Scenario) -> tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]:
    zones = drawn.constraints
    return zones.boresight_B, zones.axis_N, zones.half_angle


def _view(points_N: Floats) -> Floats:
    """Axes of a viewer in front of points (n, 3).  Returns (3, 3), rows to the right, up and towards the viewer."""
    middle_N = points_N.sum(axis=0)
    towards_N = attitudes.normalized(middle_N) if np.linalg.norm(middle_N) > 1e-3 else np.array([0.6, -0.64, 0.48])
    up_N = np.array([0.0, 1.0, 0.0]) if abs(towards_N[2]) > 0.97 else np.array([0.0, 0.0, 1.0])
    right_N = attitudes.normalized(np.cross(up_N, towards_N))
    return np.stack([right_N, np.cross(towards_N, right_N), towards_N])


def _grid(reach: float) -> tuple[Floats, Floats]:
    half = int(np.ceil(reach)) + 1
    across = np.arange(-half, half + 1, dtype=np.float64)
    x, y = np.meshgrid(across, across)
    return x, y


def _soft(distance: Floats) -> Floats:
    """Opacities of what lies nearer than 0, with a soft edge of a pixel."""
    return np.clip(0.5 - distance, 0.0, 1.0)


def _disc(radius: float) -> Floats:
    return _soft(np.hypot(*_grid(radius)) - radius)


def _ring(radius: float, width: float) -> Floats:
    return _soft(np.abs(np.hypot(*_grid(radius + width)) - radius) - width)


def _cross(reach: float, width: float) -> Floats:
    x, y = _grid(reach + width)
    arms = np.minimum(np.abs(x - y), np.abs(x + y)) / np.sqrt(2.0)
    return _soft(np.maximum(arms - width, np.maximum(np.abs(x), np.abs(y)) - reach))
