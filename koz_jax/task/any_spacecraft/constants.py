"""A spacecraft in the units and axes of a policy for any spacecraft, in NumPy and float64; imports no jax.

The same as ``units`` and ``nondimensional``, for those who fly such a policy outside of jax.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from koz_jax.config.actuators.agility import rate_at_start
from koz_jax.config.task import SpacecraftConfig
from koz_jax.errors import SettingsError
from koz_jax.task import host
from koz_jax.task.host import Floats
from koz_jax.task.observation_layout import FREE_RATE, FULL_ACTION, LEAST_RATE, LONGEST_TIME, SHORTEST_STEP


class Constants(NamedTuple):
    """What observations and torques need to know of a spacecraft and the instrument that is to be kept out."""

    time: float  # [s] T = sqrt(J / u)
    inertia: float  # [kg m^2] J, a third of the trace of the inertia
    torque: float  # [N m] u, the root mean square of the torque limits over the axes
    axes: Floats  # (3, 3) rows: the policy's axes in body components, x along the instrument
    seen: dict[str, Floats]  # parts of the observation that are of the spacecraft, by their names in the layout; of one
    # with wheels, reach and rate limit are those of the start, at rest
    times_per_rate: Floats  # (3, 3) [s^2] takes a rate in body axes to the times [s] in which the torque limits stop it
    torque_per_action: Floats  # (3, 3) [N m] takes an action to a torque in body axes
    torque_limits: Floats  # (3,) [N m] at which each component of that torque is clipped; of wheels, those at rest


def of(spacecraft: SpacecraftConfig, step_seconds: float, boresight: npt.ArrayLike | None = None) -> Constants:
    """The constants of a spacecraft.

    step_seconds: time step [s]; boresight: (3,) unit vector of an instrument in body axes, by default the spacecraft's.

    Raises:
        SettingsError: it has gyros.

    """
    if spacecraft.gyros:
        raise SettingsError("spacecraft.gyros: are flown by jax only so far; allowed here are torque_limit and wheels")
    axes = policy_axes(host.unit("boresight", spacecraft.boresight if boresight is None else boresight, 3))
    inertia_B, limits = np.array(spacecraft.inertia), np.array(spacecraft.torque_limits)
    time, torque = spacecraft.time_unit, spacecraft.strength
    inertia = float(np.trace(inertia_B)) / 3.0
    tensor = axes @ inertia_B @ axes.T / inertia
    seen = {
        "inertia": np.array([*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]]),
        "reach": np.min(limits / np.maximum(np.abs(axes), 1e-6), axis=1) / torque,
        "step": np.log([max(step_seconds / (time * SHORTEST_STEP), 1.0)]),
        "rate_limit": seen_rate(rate_at_start(spacecraft), time),
    }
    per_action = FULL_ACTION * torque / inertia * inertia_B @ axes.T
    return Constants(time, inertia, torque, axes, seen, inertia_B / limits[:, None], per_action, limits)


def seen_times(own: Constants, omega_BN_B: Floats, q_e: Floats, share: float = 1.0) -> dict[str, Floats]:
    """Parts of the observation that say how long the torque takes.

    omega_BN_B: (3,) [rad/s]; q_e: (4,) attitude error in body axes; share: of the torque limits, what is left.
    """
    stopping, turning = (np.max(np.abs(own.times_per_rate @ change)) / share for change in (omega_BN_B, 2.0 * q_e[1:]))
    stopping = min(stopping / own.time, LONGEST_TIME)
    turning = min(turning / own.time**2, LONGEST_TIME**2 / 2)
    return {"stopping": np.array([stopping, stopping**2 / 2]), "turning": np.array([turning])}


def seen_rate(largest: float, time: float) -> Floats:
    """Part of the observation that a largest rate [rad/s] is, with the unit of time [s].  Returns (1,)."""
    return np.log([np.clip(largest * time / FREE_RATE, LEAST_RATE, 1.0)])


def policy_axes(boresight_B: Floats) -> Floats:
    """As ``units.policy_axes``.  boresight_B: (3,) unit vector.  Returns (3, 3), rows in body components."""
    x, y, z = boresight_B
    if x < -1.0 + 1e-6:
        return np.diag([-1.0, -1.0, 1.0])
    share = 1.0 / (1.0 + x)
    across = -share * y * z
    # Plus zero, so that no entry is -0.
    return np.array([[x, y, z], [-y, 1.0 - share * y * y, across], [-z, across, 1.0 - share * z * z]]) + 0.0
