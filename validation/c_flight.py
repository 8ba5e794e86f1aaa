"""Exported C in the loop: it decides, and a rigid body in NumPy, float64, flies.  Shares no dynamics with koz_jax.

With wheels, the body and they exchange momentum: each takes what it gives to the body.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from koz_jax.config.maneuvers.maneuver import ManeuverConfig
from koz_jax.export.library import CLibrary

_INSTANTS = 5  # of every step at which constraints are checked, as in koz fly
_ABSENT = (1.0, 0.0, 0.0), -np.pi  # axis and half angle of a zone that there is not, as koz_policy.h says


@dataclasses.dataclass(frozen=True)
class Flown:
    """What a flight came to, in JAX or in C."""

    settled: bool
    violated: bool
    settling_seconds: float  # nan where it is not settled
    margin_deg: float  # the smallest
    end_error_deg: float
    rate_deg: float  # the largest [deg/s]
    fill: float  # most that any wheel held, as a share of what it can; 0 without wheels


class Cones:
    """Axes of a maneuver's cones at the instants at which they are checked."""

    def __init__(self, maneuver: ManeuverConfig, seconds: np.ndarray) -> None:
        """seconds: (instants,) after the start."""
        cones = [one.keep_out_cone for one in maneuver.constraints]
        self.looks_B = np.array([maneuver.boresight(one.instrument) for one in maneuver.constraints])
        self.half_angles = np.deg2rad([cone.half_angle_deg for cone in cones])
        axes, rates = (np.array([getattr(cone, name) for cone in cones]) for name in ("direction", "rotation_deg"))
        speeds = np.deg2rad(np.linalg.norm(rates, axis=1, keepdims=True))
        about = np.deg2rad(rates) / np.where(speeds > 0.0, speeds, 1.0)
        angles = seconds[:, None, None] * speeds
        along = np.sum(about * axes, axis=1, keepdims=True) * about
        # (instants, cones, 3): what is square to the axis of rotation turns.
        self.axes_N = along + np.cos(angles) * (axes - along) + np.sin(angles) * np.cross(about, axes)

    def margins(self, q: np.ndarray) -> np.ndarray:
        """Margins (instants, cones) [rad] of attitudes (instants, 4)."""
        vector = q[:, None, 1:]
        twice = 2.0 * np.cross(vector, self.looks_B)
        looks_N = self.looks_B + q[:, :1, None] * twice + np.cross(vector, twice)
        across = np.linalg.norm(np.cross(looks_N, self.axes_N), axis=2)
        return np.arctan2(across, np.sum(looks_N * self.axes_N, axis=2)) - self.half_angles


class Body:
    """A rigid body under a held torque, with momentum in its wheels."""

    def __init__(self, inertia: np.ndarray, seconds: np.ndarray) -> None:
        """inertia: (3, 3) [kg m^2]; seconds: (instants,) after the start of a step that ``advance`` gives."""
        self._inertia, self._inverse, self._seconds = inertia, np.linalg.inv(inertia), seconds

    def advance(self, state: np.ndarray, torque_B: np.ndarray, held_B: np.ndarray, spent_B: np.ndarray) -> np.ndarray:
        """One Runge-Kutta step of order 4 to each instant.

        state: (7,) attitude and rate; torque_B: (3,) [N m]; held_B: (3,) [N m s] in the wheels, of which spent_B (3,)
        [N m] goes to the body.  Returns (instants, 7).
        """
        h, torque_B, held_B, spent_B = self._seconds, torque_B[:, None], held_B[:, None], spent_B[:, None]

        def slope(at: np.ndarray, after: np.ndarray) -> np.ndarray:
            q0, q1, q2, q3, x, y, z = at
            momentum_B = self._inertia @ at[4:] + held_B - after * spent_B
            rates_B = self._inverse @ (torque_B - _cross(at[4:], momentum_B))
            attitude = (
                -(q1 * x + q2 * y + q3 * z),
                q0 * x + q2 * z - q3 * y,
                q0 * y + q3 * x - q1 * z,
                q0 * z + q1 * y - q2 * x,
            )
            return np.concatenate([0.5 * np.array(attitude), rates_B])

        begin = np.repeat(state[:, None], len(h), axis=1)
        k1 = slope(begin, 0.0 * h)
        k2 = slope(begin + h / 2 * k1, h / 2)
        k3 = slope(begin + h / 2 * k2, h / 2)
        k4 = slope(begin + h * k3, h)
        end = begin + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        end[:4] /= np.sqrt(np.sum(end[:4] ** 2, axis=0))
        return end.T


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of columns (3, n)."""
    (a0, a1, a2), (b0, b1, b2) = a, b
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def fly(maneuver: ManeuverConfig, library: CLibrary, instruments: Sequence[str]) -> Flown:
    """Fly a maneuver by exported C, under its shield where it has one.

    instruments: names of those that it was exported for, in their order.
    """
    dt, steps, wheels = maneuver.step_seconds, maneuver.task.episode_steps, maneuver.spacecraft.wheels
    cones = Cones(maneuver, dt / _INSTANTS * np.arange(_INSTANTS * steps + 1))
    absent = library.zones - len(maneuver.constraints)
    half_angles = [*cones.half_angles, *(absent * [_ABSENT[1]])]
    numbers = [instruments.index(one.instrument) for one in maneuver.constraints] + absent * [0]
    fixed = np.array(maneuver.aim.attitude), np.array(absent * [_ABSENT[0]]).ravel()
    axes_B = np.array([wheel.axis for wheel in wheels]).reshape(-1, 3)
    held = np.array([wheel.momentum for wheel in wheels])
    body = Body(np.array(maneuver.spacecraft.inertia), dt / _INSTANTS * np.arange(1, _INSTANTS + 1))
    states, held_by = [np.array([*maneuver.start.attitude, *np.deg2rad(maneuver.start.rate_deg)])], [held]
    memory = None
    for step in range(steps):
        state, axes_N = states[-1], cones.axes_N[_INSTANTS * step].ravel()
        parts = [state, fixed[0], axes_N, fixed[1], half_angles, held, numbers if len(instruments) > 1 else []]
        told = np.concatenate(parts)[None].astype(np.float32)
        observed, memory = library.observe(told, library.start(told) if memory is None else memory)
        torque_B = library.torque(observed, memory)
        torque_B = library.shield(told, torque_B) if library.has_shield else torque_B
        spent_B, held_B = np.zeros(3), held @ axes_B
        if wheels:
            each = library.wheel_torques(told, torque_B)[0].astype(np.float64)
            held = held - dt * each
            torque_B = spent_B = each @ axes_B
        states.extend(body.advance(state, np.ravel(torque_B).astype(np.float64), held_B, spent_B))
        held_by.append(held)
    return _judged(maneuver, np.array(states), np.array(held_by), cones)


def _judged(maneuver: ManeuverConfig, states: np.ndarray, held: np.ndarray, cones: Cones) -> Flown:
    """states: (instants, 7); held: (steps + 1, wheels) [N m s]."""
    margin = float(np.min(cones.margins(states[:, :4])))
    q, target = states[::_INSTANTS, :4], np.array(maneuver.aim.attitude)
    # Of q_e = q_d* (x) q, whose sign is continuous in time; its vector part in target axes.
    scalar = q @ target
    vector = target[0] * q[:, 1:] - q[:, :1] * target[1:] - np.cross(target[1:], q[:, 1:])
    error_deg = np.rad2deg(2.0 * np.arctan2(np.linalg.norm(vector, axis=1), scalar))
    outside = np.flatnonzero(error_deg > maneuver.settled_angle_deg)
    first = 0 if not len(outside) else int(outside[-1]) + 1
    settled = first < len(q)
    limits = np.array([wheel.max_momentum for wheel in maneuver.spacecraft.wheels])
    return Flown(
        settled=settled,
        violated=margin <= 0.0,
        settling_seconds=first * maneuver.step_seconds if settled else float("nan"),
        margin_deg=float(np.rad2deg(margin)),
        end_error_deg=float(error_deg[-1]),
        rate_deg=float(np.rad2deg(np.max(np.linalg.norm(states[::_INSTANTS, 4:], axis=1)))),
        fill=float(np.max(np.abs(held) / limits, initial=0.0)),
    )
