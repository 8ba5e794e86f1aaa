"""How fast a spacecraft can turn: its accelerations, largest rate, and the least time of a turn.  Imports no jax."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from koz_jax.config.actuators import wheels
from koz_jax.config.task import SpacecraftConfig

# A wheel that could turn the body so many times as fast as its torque makes use of is of other units.
_SENSELESS = 10.0


class Agility(NamedTuple):
    """How fast a body can turn about an axis."""

    moment: float  # [kg m^2]
    torque: float  # [N m]

    @property
    def acceleration(self) -> float:
        """Largest angular acceleration [rad/s^2]."""
        return self.torque / self.moment

    def turn_seconds(self, angle_deg: float, largest_rate: float = math.inf) -> float:
        """Least time [s] of a turn by an angle from rest to rest: 2 sqrt(pi J / u) for 180 deg.

        largest_rate: [rad/s] that is kept on the way.
        """
        angle = math.radians(angle_deg)
        if largest_rate**2 >= angle * self.acceleration:
            return 2.0 * math.sqrt(angle / self.acceleration)
        return angle / largest_rate + largest_rate / self.acceleration if largest_rate > 0.0 else math.inf

    def __str__(self) -> str:
        return f"{self.moment:.3g} kg m^2, {self.torque:.3g} N m"


def agilities(spacecraft: SpacecraftConfig) -> list[Agility]:
    """Agility about each principal axis, the slowest first."""
    moments, axes_B = np.linalg.eigh(np.array(spacecraft.inertia))
    shares = np.maximum(np.abs(axes_B), 1e-12) / np.array(spacecraft.torque_limits)[:, None]
    torques = 1.0 / shares.max(axis=0)  # the longest torque along the axis that is in the box
    found = [Agility(float(moment), float(torque)) for moment, torque in zip(moments, torques, strict=True)]
    return sorted(found, key=lambda agility: agility.acceleration)


def about(spacecraft: SpacecraftConfig, axis_B: npt.ArrayLike) -> Agility:
    """Agility about an axis that is kept on the way.  axis_B: (3,) unit vector in body axes."""
    axis_B, limits = np.asarray(axis_B, np.float64), np.array(spacecraft.torque_limits)
    needed = np.array(spacecraft.inertia) @ axis_B  # torque of an acceleration of 1 rad/s^2
    acceleration = float(np.min(limits / np.maximum(np.abs(needed), 1e-12 * np.linalg.norm(needed))))
    moment = float(axis_B @ needed)
    return Agility(moment, acceleration * moment)


def rate_at_start(spacecraft: SpacecraftConfig) -> float:
    """Largest rate [rad/s] that is allowed, and that wheels or gyros can stop, at the start and at rest.

    Infinite where there is no limit.  In a maneuver it changes with the total momentum, see ``task.actuators``.
    """
    allowed = math.inf if spacecraft.max_rate_deg is None else math.radians(spacecraft.max_rate_deg)
    largest_moment = float(np.linalg.eigvalsh(np.array(spacecraft.inertia))[2])
    if spacecraft.gyros:
        allowed = min(allowed, _left_of_gyros(spacecraft) / largest_moment)
    if spacecraft.wheels:
        momentum = np.array([wheel.momentum for wheel in spacecraft.wheels])
        allowed = min(allowed, rate_of_wheels(spacecraft, momentum, np.zeros(3)))
    return max(allowed, 0.0)


def senseless_momenta(spacecraft: SpacecraftConfig) -> list[str]:
    """Wheels that hold far more than the body can make use of, each in a line.  Their units may be others."""
    inertia = float(np.trace(np.array(spacecraft.inertia))) / 3.0
    quickest = math.sqrt(math.pi) / spacecraft.time_unit  # [rad/s] in the middle of the fastest half turn
    return [
        f"wheels.{i}.max_momentum: {wheel.max_momentum:g} N m s would turn the body at"
        f" {math.degrees(wheel.max_momentum / inertia):.3g} deg/s,"
        f" {wheel.max_momentum / inertia / quickest:.3g} times what its fastest half turn comes to"
        f" ({math.degrees(quickest):.3g} deg/s); is it in N m s?"
        for i, wheel in enumerate(spacecraft.wheels)
        if wheel.max_momentum / inertia > _SENSELESS * quickest
    ]


def _left_of_gyros(spacecraft: SpacecraftConfig) -> float:
    """What the gyros hold before one rotor's momentum is used up [N m s]."""
    held_B = np.zeros(3)
    for gyro in spacecraft.gyros:
        angle, rotor = math.radians(gyro.angle_deg), np.array(gyro.rotor_axis)
        held_B += gyro.momentum * (math.cos(angle) * rotor + math.sin(angle) * np.cross(gyro.gimbal_axis, rotor))
    return float(np.mean([gyro.momentum for gyro in spacecraft.gyros]) - np.linalg.norm(held_B))


def rate_of_wheels(
    spacecraft: SpacecraftConfig, momentum: npt.NDArray[np.float64], omega_BN_B: npt.NDArray[np.float64]
) -> float:
    """Largest rate [rad/s] that no wheel is full at, and at which half of the torque is left; below 0 where none is.

    As of ``task.actuators.ReactionWheels``.  momentum: of each wheel (wheels,) [N m s]; omega_BN_B: (3,) [rad/s].
    """
    own, inertia_B = spacecraft.wheels, np.array(spacecraft.inertia)
    held_B = momentum @ np.array([wheel.axis for wheel in own])
    allocation, total = wheels.allocation(own), float(np.linalg.norm(inertia_B @ omega_BN_B + held_B))
    smallest, _, largest = np.linalg.eigvalsh(inertia_B)
    idle = np.abs(momentum - allocation @ held_B)
    most = np.array([wheel.max_momentum for wheel in own])
    room = float(np.min((most - idle) / np.linalg.norm(allocation, axis=1))) - total
    # The rate w at which the gyroscopic torque, (c - a) w^2 / 2 + w |H|, is what braking leaves of the torque.
    reserve = (1.0 - wheels.BRAKE_SHARE) * min(spacecraft.torque_limits)
    divisor = total + math.sqrt(total**2 + 2.0 * float(largest - smallest) * reserve)
    by_torque = 2.0 * reserve / divisor if divisor > 0.0 else math.inf
    return min(room / float(largest), by_torque)
