"""The observation's definition (Eq. 6 of the paper), declared once and without jax: order, sizes, frames, units.

The paper has one zone, whose entries are the first 16.  Where there are several, the nearest comes first, and a
policy that was trained for n zones sees the n nearest: the paper's 16 entries, then five for each zone after the first.
"""

import functools
import itertools
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from koz_jax.config.task import TaskConfig
from koz_jax.errors import SettingsError

ACTION_SIZE = 3  # torque about the body axes, as a share of its limit

# [rad] A cone of this half angle holds no direction: its margin is at least pi everywhere.  It stands for no cone.
ABSENT_HALF_ANGLE = -np.pi

_ZONE = {
    "zone_margin": 1,  # [rad] theta_margin
    "zone_angle": 1,  # [rad] theta
    "zone_direction_B": 3,  # unit vector from the boresight towards the zone's axis
}

_SCALED_ZONE = {"zone_margin": 1, "zone_angle": 1, "zone_direction_P": 3}

# That of the first one is the x axis.
_FURTHER_SCALED_ZONE = {"boresight_P": 3, **_SCALED_ZONE}

# What a policy for any spacecraft also sees, after attitude, rate and zones; see ``any_spacecraft.nondimensional``.
_SPACECRAFT = {
    "inertia": 6,  # [J] xx, yy, zz, xy, xz, yz of the tensor
    "reach": 3,  # [u] largest torque along each axis
    "step": 1,  # log of the time step [T] over ``SHORTEST_STEP``
    "rate_limit": 1,  # log of the largest rate [1/T] over ``FREE_RATE``
    "stopping": 2,  # time t in which the torque stops the rate [T], and t^2 / 2 [T^2]
    "turning": 1,  # t^2 / 2 of the time in which it turns the attitude error from rest [T^2]
    "urgency": 1,  # from -1 (thrifty) to 1 (fast)
}

# [T] A policy tells no shorter time steps apart.
SHORTEST_STEP = 0.01

# [1/T] A limit of the rate above this is none.
FREE_RATE = 3.0

# Of that rate, what a policy tells apart from no rate at all.
LEAST_RATE = 1e-3

# [T] What takes the torque longer is not told apart.
LONGEST_TIME = 5.0

# [u / J] An action of one of a policy for any spacecraft asks for this acceleration; the torque box then limits it.
FULL_ACTION = 2.0

# For those who only get an exported controller.
_MEANING = {
    "q_e": "attitude error q_DN* (x) q_BN, scalar first; of it and its negative, which are one attitude, the one nearer"
    " to that of the step before, at the start the one with q_e0 >= 0: the sign of a measured q_BN may jump",
    "omega_BN_B": "[rad/s] rate of the body relative to inertial, in body axes",
    "boresight_B": "unit vector of the telescope, in body axes",
    "zone_margin": "[rad] zone_angle minus the zone's half angle; <= 0 inside the zone",
    "zone_angle": "[rad] angle between the telescope and the zone's axis",
    "zone_direction_B": "unit vector along (zone's axis - boresight), in body axes; zero where the two coincide",
    "q_e0_previous": "q_e0 one time step ago, with the sign that it had then; at the start, q_e0 itself",
    "omega_BN_P": "[1/T] rate of the body relative to inertial, in the policy's axes",
    "zone_direction_P": "unit vector along (zone's axis - boresight), in the policy's axes; zero where they coincide",
    "inertia": "[J] entries xx, yy, zz, xy, xz, yz of the inertia in the policy's axes",
    "reach": "[u] largest torque along each of the policy's axes",
    "step": f"natural logarithm of the time step over {SHORTEST_STEP} T, at least 0",
    "rate_limit": f"natural logarithm of the largest rate over {FREE_RATE} / T, at most 0: there is no limit",
    "stopping": "time t [T] in which the torque stops the rate: momentum over torque limit, of the body axis where that"
    f" is largest, at most {LONGEST_TIME:g}; and t^2 / 2",
    "turning": "t^2 / 2 of the time t [T] in which the torque turns a body at rest by the attitude error: inertia times"
    " twice the vector part of q_e over torque limit, of the body axis where that is largest, at most"
    f" {LONGEST_TIME**2 / 2:g}; where that of stopping is as much, it is time to brake",
    "urgency": "from -1 (thrifty) to 1 (as fast as the torque allows)",
}

# What differs for a policy for any spacecraft.
_SCALED_MEANING = {
    "q_e": f"{_MEANING['q_e']}; its vector part in the policy's axes",
    "zone_margin": f"{_MEANING['zone_margin']}; pi where there is no zone",
    "zone_angle": f"{_MEANING['zone_angle']}; pi where there is no zone",
    "zone_direction_P": f"{_MEANING['zone_direction_P']}, or there is no zone",
}


@functools.cache
def layout(zones: int = 1, scaled: bool = False) -> Mapping[str, int]:
    """Names and sizes of the parts, in order, for a policy that sees so many zones.

    scaled: for a policy for any spacecraft, see ``any_spacecraft.nondimensional``.
    """
    if scaled:
        further = {zone_part(n, name): size for n in range(1, zones) for name, size in _FURTHER_SCALED_ZONE.items()}
        return MappingProxyType({"q_e": 4, "omega_BN_P": 3} | _SCALED_ZONE | further | _SPACECRAFT)
    first = {
        "q_e": 4,  # attitude relative to the target
        "omega_BN_B": 3,  # [rad/s]
        "boresight_B": 3,  # unit vector
        **_ZONE,
        "q_e0_previous": 1,  # scalar part of q_e one step ago
    }
    further = {zone_part(number, name): size for number in range(1, zones) for name, size in _ZONE.items()}
    return MappingProxyType(first | further)


def zone_part(number: int, name: str) -> str:
    """Name of a part of the zone with a number, from 0 for the nearest."""
    return f"{number + 1}_{name}" if number else name


def meaning(part: str, scaled: bool = False) -> str:
    """What a part of ``layout(zones, scaled)`` holds: frame, unit, definition."""
    number, _, name = part.partition("_")
    if not number.isdigit():
        return (_SCALED_MEANING if scaled else _MEANING).get(part, _MEANING[part])
    if name == "boresight_P":
        return f"unit vector of the instrument that zone {number} is for, in the policy's axes; 0 where there is none"
    absent = "0" if name.startswith("zone_direction") else "pi"
    return f"the same of zone {number} in the order of the margins; {absent} where there is none"


def size(zones: int = 1, scaled: bool = False) -> int:
    """Entries of the observation."""
    return sum(layout(zones, scaled).values())


@functools.cache
def slices(zones: int = 1, scaled: bool = False) -> Mapping[str, slice]:
    """Where each part is."""
    parts = layout(zones, scaled)
    ends = itertools.accumulate(parts.values())
    return MappingProxyType({name: slice(end - parts[name], end) for name, end in zip(parts, ends, strict=True)})


# The paper's observation.
LAYOUT = layout()
SIZE = size()
SLICES = slices()


def as_observations(observations: npt.ArrayLike, zones: int = 1, scaled: bool = False) -> np.ndarray:
    """Check what a controller is asked, see ``layout``.  Returns float32 (size,) or (batch, size).

    Raises:
        SettingsError: they are no finite numbers, or have another shape.

    """
    observed = as_numbers("observations", observations)
    allowed = size(zones, scaled)
    if observed.ndim not in (1, 2) or observed.shape[-1] != allowed:
        raise SettingsError(f"observations: must have shape ({allowed},) or (batch, {allowed}), got {observed.shape}")
    return observed


def as_numbers(name: str, given: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Take what should be finite real numbers as float32.

    Raises:
        SettingsError: it is something else; the message calls it by its name.

    """
    try:
        numbers = np.asarray(given)
        if not np.can_cast(numbers.dtype, np.float64, "same_kind"):
            raise TypeError(f"type {numbers.dtype}")
        with np.errstate(over="ignore"):
            numbers = numbers.astype(np.float32)
    except (TypeError, ValueError) as error:
        raise SettingsError(f"{name}: must be an array of real numbers, got {error}") from None
    wrong = np.argwhere(~np.isfinite(numbers))
    if len(wrong):
        place = tuple(int(index) for index in wrong[0])
        raise SettingsError(f"{name}: must be finite in float32, got {np.asarray(given)[place]} at {list(place)}")
    return numbers


def observation_bounds(task: TaskConfig) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Bounds that no observation of a maneuver leaves, for code that wants a finite space.  Returns (low, high).

    Momentum grows by at most the torque's impulse; the rest are unit vectors, and angles of at most a half turn.
    """
    spacecraft = task.spacecraft
    moments = np.linalg.eigvalsh(np.array(spacecraft.inertia))
    start = np.sqrt(3.0) * np.deg2rad(task.scenario.max_rate_deg) * moments[-1]
    impulse = np.linalg.norm(spacecraft.torque_limits) * task.episode_seconds
    limits = {
        "omega_BN_B": (start + impulse) / moments[0],
        "zone_angle": np.pi,
        "zone_margin": np.pi - ABSENT_HALF_ANGLE,
    }
    zones = task.zones[1]
    high = np.ones(size(zones))
    for name, part in slices(zones).items():
        # Further zones have a number in front of the name.
        high[part] = next((limit for ending, limit in limits.items() if name.endswith(ending)), 1.0)
    # A little more, for what float32 rounds.
    high = (1.001 * high).astype(np.float32)
    return -high, high
