"""Reaction wheels in NumPy and float64, as ``actuators.ReactionWheels``; imports no jax."""

import numpy as np

from koz_jax.config.actuators import wheels
from koz_jax.config.actuators.agility import rate_of_wheels
from koz_jax.config.actuators.wheels import LEAST_SHARE
from koz_jax.config.task import SpacecraftConfig
from koz_jax.task.host import Floats


class HostWheels:
    """What the wheels of a spacecraft can do.  momentum: of each wheel (wheels,) [N m s]; omega_BN_B: (3,) [rad/s]."""

    def __init__(self, spacecraft: SpacecraftConfig) -> None:
        """Take the wheels of a spacecraft, which has at least three."""
        self._spacecraft, own = spacecraft, spacecraft.wheels
        self._axes_B = np.array([wheel.axis for wheel in own])
        self._allocation = wheels.allocation(own)
        self._max_torque = np.array([wheel.max_torque for wheel in own])
        self._max_momentum = np.array([wheel.max_momentum for wheel in own])
        self._box_B, self._inertia_B = np.array(spacecraft.torque_limits), np.array(spacecraft.inertia)
        self._max_rate = np.inf if spacecraft.max_rate_deg is None else float(np.deg2rad(spacecraft.max_rate_deg))
        self.momentum_at_start: Floats = np.array([wheel.momentum for wheel in own])

    def share(self, momentum: Floats, omega_BN_B: Floats) -> float:
        """Share of the torque limits that is left beside what the wheels' own momentum takes."""
        taken = np.abs(self._allocation @ np.cross(omega_BN_B, momentum @ self._axes_B))
        room = (self._max_torque - taken) / (np.abs(self._allocation) @ self._box_B)
        return float(np.clip(np.min(room), LEAST_SHARE, 1.0))

    def largest_rate(self, momentum: Floats, omega_BN_B: Floats) -> float:
        """Largest rate [rad/s] that the body may have and the wheels can stop."""
        return max(min(rate_of_wheels(self._spacecraft, momentum, omega_BN_B), self._max_rate), 0.0)

    def torques(self, torque_B: Floats, momentum: Floats, omega_BN_B: Floats, seconds: float) -> Floats:
        """Torque that each wheel gives the body for a time step [N m], by which its own momentum falls.

        torque_B: (3,) [N m] that is to turn the body, clipped to what is left; seconds: time step [s].  Returns
        (wheels,).
        """
        limit_B = self.share(momentum, omega_BN_B) * self._box_B
        wanted_B, held_B = np.clip(torque_B, -limit_B, limit_B), momentum @ self._axes_B
        # What the momentum takes in the middle of the step.
        net_B = wanted_B - np.cross(omega_BN_B, self._inertia_B @ omega_BN_B)
        omega_middle_B = omega_BN_B + 0.5 * seconds * np.linalg.solve(self._inertia_B, net_B)
        held_middle_B = held_B - 0.5 * seconds * (wanted_B + np.cross(omega_BN_B, held_B))
        each = self._allocation @ (wanted_B + np.cross(omega_middle_B, held_middle_B))
        room = np.minimum(self._max_torque, (self._max_momentum + np.sign(each) * momentum) / seconds)
        size = np.maximum(np.abs(each), 1e-12 * self._max_torque)
        return np.clip(np.min(room / size), 0.0, 1.0) * each
