"""Maneuvers as people give them: made of plain numbers, and checked, on the host before anything is traced."""

import logging
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax.core import Tracer

from koz_jax.config import attitudes
from koz_jax.config.base import doubt_of_degrees
from koz_jax.errors import SettingsError
from koz_jax.task import host
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.host import Cones
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.scenario import Scenario

_log = logging.getLogger(__name__)


def maneuver(
    start: npt.ArrayLike,
    target: npt.ArrayLike = (1.0, 0.0, 0.0, 0.0),
    zones: Sequence[Any] = (),
    *,
    boresight: npt.ArrayLike = (1.0, 0.0, 0.0),
    rate_deg: npt.ArrayLike = (0.0, 0.0, 0.0),
) -> Scenario:
    """Make a maneuver to fly.  A half angle that looks like one in radians is logged as a warning.

    Args:
        start: attitude at the start, (4,) scalar first; takes body components to inertial ones.
        target: attitude at the end, in the same way; of it and its negative, which are one attitude, the nearer is
            flown to.
        zones: keep-out zones, each a pair (axis (3,) in inertial axes, half angle [deg]), or a triple with the
            boresight (3,) of another instrument, or four with the angular velocity of the axis (3,) [deg/s], inertial.
        boresight: of the instrument of the pairs, in body axes (3,); that of the spacecraft that flies.
        rate_deg: rate at the start, relative to inertial in body axes (3,) [deg/s].

    Raises:
        SettingsError: something is not finite, is zero or has another shape; a direction's or a quaternion's length is
            off 1 by more than 1 % (what is off by less is normalised); a half angle is not above 0 and below 180 deg.

    """
    made = of_numbers(start, target, zones, boresight=boresight, rate_deg=rate_deg)
    for number, zone in enumerate(zones):
        doubt = doubt_of_degrees(float(zone[1]))
        if doubt:
            _log.warning("zones[%d], half angle: %s", number, doubt)
    return made


def of_numbers(
    start: npt.ArrayLike,
    target: npt.ArrayLike,
    zones: Sequence[Any],
    *,
    boresight: npt.ArrayLike,
    rate_deg: npt.ArrayLike,
) -> Scenario:
    """``maneuver`` without a word, for what somebody has been told of before.

    Raises:
        SettingsError: as of ``maneuver``.

    """
    stack = host.cones(zones, boresight, turning=True)
    omega_BN_B = np.deg2rad(host.numbers("rate_deg", rate_deg, (3,)))
    right = _scenario(
        host.unit("start", start, 4), omega_BN_B, host.unit("target", target, 4), stack, host.axis_rates(zones)
    )
    return jax.tree.map(jnp.asarray, right)


def checked(drawn: Scenario) -> Scenario:
    """Check a scenario that somebody gives: normalised, with the nearer sign of the target, or refused by name.

    What is already right stays bit for bit as it is.  A start or a target inside a zone is logged as a warning.  A
    scenario that is being traced is returned as it is.

    Raises:
        SettingsError: as of ``maneuver``, for half angles in radians.

    """
    if not isinstance(drawn, Scenario):
        raise SettingsError(f"scenario: must be a Scenario, which koz_jax.maneuver makes, got {drawn!r}")
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(drawn)):
        return drawn
    q_BN = host.unit("initial.q_BN", drawn.initial.q_BN, 4)
    omega_BN_B = host.numbers("initial.omega_BN_B", drawn.initial.omega_BN_B, (3,))
    q_DN = host.nearer(host.unit("q_DN", drawn.q_DN, 4), q_BN)
    stack = _checked_stack(drawn.constraints)
    _tell_of_zones_around("start", q_BN, stack)
    _tell_of_zones_around("target", q_DN, stack)
    rates = drawn.constraints.axis_rate_N
    if rates is not None:
        rates = host.numbers("constraints.axis_rate_N", rates, stack.axis_N.shape)
    right = _scenario(q_BN, omega_BN_B, q_DN, stack, rates)
    chosen = [_choose(new, given) for new, given in zip(_leaves(right), _leaves(drawn), strict=True)]
    return jax.tree.unflatten(jax.tree.structure(right), chosen)


def tell_of_another_boresight(drawn: Scenario, boresight: Sequence[float]) -> None:
    """Log a warning where no zone is for the spacecraft's own instrument.  boresight: (3,) of it, in body axes."""
    present = np.asarray(drawn.constraints.half_angle) > 0.0
    looks_B = np.asarray(drawn.constraints.boresight_B, np.float64)[present]
    if present.any() and attitudes.angle_between(looks_B, np.asarray(boresight, np.float64)).min() > np.deg2rad(0.1):
        _log.warning(
            "boresight: no zone is for that of the spacecraft, %s; they are for %s",
            np.round(boresight, 6).tolist(),
            np.round(looks_B, 6).tolist(),
        )


def _checked_stack(given: PointingConstraint) -> Cones:
    angles, looks, axes = (np.asarray(leaf) for leaf in (given.half_angle, given.boresight_B, given.axis_N))
    if angles.ndim != 1 or not len(angles) or looks.shape != (len(angles), 3) or axes.shape != (len(angles), 3):
        raise SettingsError(
            "constraints: must be a stack, boresight_B and axis_N of shape (n, 3) and half_angle (n,), got"
            f" {looks.shape}, {axes.shape} and {angles.shape}"
        )
    rows = range(len(angles))
    return Cones(
        np.stack([host.unit(f"constraints.boresight_B[{i}]", looks[i], 3) for i in rows]),
        np.stack([host.unit(f"constraints.axis_N[{i}]", axes[i], 3) for i in rows]),
        np.array([host.half_angle(f"constraints.half_angle[{i}]", angles[i]) for i in rows]),
    )


def _tell_of_zones_around(what: str, q_BN: host.Floats, zones: Cones) -> None:
    for number, margin in enumerate(host.margins(q_BN, zones)):
        if margin <= 0.0:
            _log.warning(
                "%s: looks %.3g deg into zone %d, of half angle %.3g deg",
                *(what, -np.rad2deg(margin), number + 1, np.rad2deg(zones.half_angle[number])),
            )


def _scenario(
    q_BN: host.Floats, omega_BN_B: host.Floats, q_DN: host.Floats, zones: Cones, axis_rate_N: host.Floats | None
) -> Scenario:
    """Put a scenario together.  Returns NumPy leaves, float32."""
    leaves = (q_BN, omega_BN_B, host.nearer(q_DN, q_BN), *zones, *(() if axis_rate_N is None else (axis_rate_N,)))
    start, rate, target, *stack = (np.asarray(leaf, np.float32) for leaf in leaves)
    return Scenario(RigidBodyState(start, rate), target, PointingConstraint(*stack))  # pyright: ignore


def _choose(right: np.ndarray, given: Any) -> jax.Array:
    """What is right as an array of jax; the given one itself where it is right, also if it is more precise."""
    is_array = isinstance(given, jax.Array) and jnp.issubdtype(given.dtype, jnp.floating)
    return given if is_array and np.array_equal(right, np.asarray(given, right.dtype)) else jnp.asarray(right)


def _leaves(drawn: Scenario) -> list[Any]:
    zones, body = drawn.constraints, drawn.initial
    fixed = [body.q_BN, body.omega_BN_B, drawn.q_DN, zones.boresight_B, zones.axis_N, zones.half_angle]
    return fixed if zones.axis_rate_N is None else [*fixed, zones.axis_rate_N]
