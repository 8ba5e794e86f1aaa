"""On the host, in NumPy and float64, without jax: checks of what people give, and margins of it."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from koz_jax.config import attitudes
from koz_jax.errors import SettingsError
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE, as_numbers

Floats = npt.NDArray[np.float64]

# A length that is off by more is an error of who gave it, not of rounding.
_LENGTH_TOLERANCE = 0.01
# Off by less is what float32 rounds; such vectors are left bit for bit as they are.
_ROUNDING = 1e-6


class Cones(NamedTuple):
    """A stack of keep-out zones, checked."""

    boresight_B: Floats  # (n, 3) unit vectors, in body axes
    axis_N: Floats  # (n, 3) unit vectors, in inertial axes
    half_angle: Floats  # (n,) [rad]


def numbers(name: str, given: npt.ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Take finite real numbers of a shape as float64.

    Raises:
        SettingsError: they are something else; the message calls them by their name.

    """
    found = as_numbers(name, given)
    if found.shape != shape:
        raise SettingsError(f"{name}: must have shape {shape}, got {found.shape}")
    return np.asarray(given, np.float64)


def unit(name: str, given: npt.ArrayLike, entries: int) -> Floats:
    """Normalise a direction (3 entries) or a quaternion (4).  Returns (entries,).

    Raises:
        SettingsError: it is not finite, has another shape, or its length is off 1 by more than 1 %.

    """
    found = numbers(name, given, (entries,))
    length = float(np.linalg.norm(found))
    if abs(length - 1.0) > _LENGTH_TOLERANCE:
        raise SettingsError(
            f"{name}: must have length 1 (what is off by up to 1 % is normalised), got {found.tolist()} of length"
            f" {length:.6g}"
        )
    return found if abs(length - 1.0) <= _ROUNDING else found / length


def half_angle(name: str, given: npt.ArrayLike) -> float:
    """Check the half angle [rad] of a zone, or ``ABSENT_HALF_ANGLE``, which stands for none.

    Raises:
        SettingsError: it is not finite, zero, negative, or pi and more.

    """
    radians = float(numbers(name, given, ()))
    if abs(radians - ABSENT_HALF_ANGLE) > _ROUNDING and not 0.0 < radians < np.pi:
        looks = " (which looks like degrees)" if radians >= np.pi else ""
        raise SettingsError(f"{name}: must be above 0 and below pi rad, got {radians:.6g}{looks}")
    return radians


def cones(zones: Sequence[Any], boresight: npt.ArrayLike, turning: bool = False) -> Cones:
    """Check zones as people give them: pairs (axis, half angle [deg]), or triples that end in a boresight.

    turning: a fourth part may be the rate of the axis, see ``axis_rates``.

    zones: axes in inertial axes; boresight: in body axes, of the pairs.  None at all is one stand-in for no zone.

    Raises:
        SettingsError: a direction is none, or a half angle is not above 0 and below 180 deg.

    """
    looks_B = unit("boresight", boresight, 3)
    rows: list[tuple[Floats, Floats, float]] = []
    for number, zone in enumerate(zones):
        name = f"zones[{number}]"
        parts: list[Any] = list(zone) if isinstance(zone, Sequence) else []
        if not 2 <= len(parts) <= (4 if turning else 3):
            further = " or (axis, half angle, boresight, rate of the axis [deg/s])" if turning else ""
            raise SettingsError(
                f"{name}: must be (axis, half angle [deg]) or (axis, half angle, boresight){further}, got {zone!r}"
            )
        degrees = float(numbers(f"{name}, half angle", parts[1], ()))
        if not 0.0 < degrees < 180.0:
            raise SettingsError(f"{name}, half angle: must be above 0 and below 180 deg, got {degrees:.6g}")
        own_B = unit(f"{name}, boresight", parts[2], 3) if len(parts) > 2 else looks_B
        rows.append((own_B, unit(f"{name}, axis", parts[0], 3), float(np.deg2rad(degrees))))
    if not rows:
        rows.append((looks_B, np.array([1.0, 0.0, 0.0]), ABSENT_HALF_ANGLE))
    boresights, axes, angles = zip(*rows, strict=True)
    return Cones(np.stack(boresights), np.stack(axes), np.array(angles))


def axis_rates(zones: Sequence[Any]) -> Floats | None:
    """Rates of the axes of zones that ``cones`` has checked.  Returns (n, 3) [rad/s]; None where no axis turns.

    Raises:
        SettingsError: a rate is not finite or has another shape.

    """
    rates = [
        numbers(f"zones[{number}], rate", zone[3], (3,)) if len(zone) > 3 else np.zeros(3)
        for number, zone in enumerate(zones)
    ]
    return np.deg2rad(np.stack(rates)) if np.any(rates) else None


def nearer(q: Floats, reference: Floats) -> Floats:
    """Of q and -q, which are one attitude, the one nearer to a reference; q itself where both are as near."""
    return -q if q @ reference < -_ROUNDING else q


def attitude_error(q_BN: Floats, q_DN: Floats) -> Floats:
    """q_e = q_DN* (x) q_BN.  q_BN, q_DN: (4,).  Returns (4,)."""
    return attitudes.multiply(conjugate(q_DN), q_BN)


def conjugate(q: Floats) -> Floats:
    """Conjugate q*, the inverse rotation of a unit quaternion.  q: (4,).  Returns (4,)."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def angles(q_BN: Floats, zones: Cones) -> Floats:
    """Angle between boresight and axis of each zone.  q_BN: (4,).  Returns (n,) [rad]."""
    return attitudes.angle_between(attitudes.rotate(q_BN, zones.boresight_B), zones.axis_N)


def margins(q_BN: Floats, zones: Cones) -> Floats:
    """Margin of each zone, negative inside.  q_BN: (4,).  Returns (n,) [rad]."""
    return angles(q_BN, zones) - zones.half_angle
