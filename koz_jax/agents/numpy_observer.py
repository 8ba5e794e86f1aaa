"""The observation of a measured state with NumPy alone, for those who close the loop themselves; imports no jax.

>>> policy = load_policy("phase2")
>>> observer = observer_of(policy)
>>> action = policy.predict(observer.observe(q_BN, omega_BN_B, q_DN, zones))  # once in every time step

A policy for any spacecraft sees one in its own units and axes, and its action is an angular acceleration:

>>> observer = scaled_observer_of(policy, spacecraft, step_seconds)
>>> torque_B = observer.torque(policy.predict(observer.observe(q_BN, omega_BN_B, q_DN, zones)))
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from koz_jax.agents.numpy_policy import NumpyPolicy
from koz_jax.config import attitudes
from koz_jax.config.task import SpacecraftConfig
from koz_jax.errors import SettingsError
from koz_jax.task import host
from koz_jax.task.any_spacecraft import constants
from koz_jax.task.any_spacecraft.host_wheels import HostWheels
from koz_jax.task.host import Cones
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE, ACTION_SIZE, layout, zone_part


class Observer:
    """What a policy sees of measured attitudes and rates, one call in every time step of a maneuver.

    q and -q are one attitude, and star trackers and ephemerides choose the sign anew at every measurement; a policy
    must not see it jump.  So of q_e and -q_e the one nearer to that of the step before is taken, at the start of a
    maneuver the one with q_e0 >= 0.
    """

    def __init__(self, boresight: npt.ArrayLike = (1.0, 0.0, 0.0), observed_zones: int = 1) -> None:
        """Begin a maneuver.

        boresight: of the instrument, in body axes (3,); observed_zones: how many zones the policy sees.
        """
        self._boresight_B = host.unit("boresight", boresight, 3)
        self._observed_zones = observed_zones
        self._last_q_e: host.Floats | None = None

    def reset(self) -> None:
        """Begin another maneuver."""
        self._last_q_e = None

    def observe(
        self, q_BN: npt.ArrayLike, omega_BN_B: npt.ArrayLike, q_DN: npt.ArrayLike, zones: Sequence[Any] = ()
    ) -> npt.NDArray[np.float32]:
        """See what is measured in this time step.

        Args:
            q_BN: attitude (4,), scalar first, of either sign; takes body components to inertial ones.
            omega_BN_B: (3,) [rad/s] rate of the body relative to inertial, in body axes.
            q_DN: target attitude (4,), of either sign.
            zones: all there are, each (axis (3,) in inertial axes, half angle [deg]), or with the boresight of another
                instrument as a third.

        Returns:
            The observation (16,), 5 entries more for each further zone that the policy sees; see ``layout``.

        Raises:
            SettingsError: something is not finite or has another shape, or is no unit vector or quaternion, or no half
                angle; what is off unit length by up to 1 % is normalised.

        """
        q_BN, q_DN = host.unit("q_BN", q_BN, 4), host.unit("q_DN", q_DN, 4)
        omega_BN_B = host.numbers("omega_BN_B", omega_BN_B, (3,))
        nearest = _nearest(q_BN, host.cones(zones, self._boresight_B), self._observed_zones)
        last = self._last_q_e
        q_e = host.attitude_error(q_BN, q_DN)
        q_e = host.nearer(q_e, np.array([1.0, 0.0, 0.0, 0.0]) if last is None else last)
        self._last_q_e = q_e
        q_e0_previous = q_e[0] if last is None else last[0]
        return self._pack(q_BN, omega_BN_B, q_e, q_e0_previous, nearest)

    def _pack(
        self, q_BN: host.Floats, omega_BN_B: host.Floats, q_e: host.Floats, q_e0_previous: float, nearest: Cones
    ) -> npt.NDArray[np.float32]:
        parts: dict[str, Any] = {
            "q_e": q_e,
            "omega_BN_B": omega_BN_B,
            "boresight_B": nearest.boresight_B[0],
            "q_e0_previous": [q_e0_previous],
        }
        for number in range(self._observed_zones):
            zone = Cones(*(leaf[number] for leaf in nearest))
            parts |= {zone_part(number, name): value for name, value in _zone_parts(q_BN, zone, number > 0).items()}
        return np.concatenate([parts[name] for name in layout(self._observed_zones)]).astype(np.float32)


class ScaledObserver(Observer):
    """What a policy for any spacecraft sees of one, in its units and axes, and the torque that its actions ask for.

    Where zones are of several instruments, the axes are those of the nearest zone's.  What reaction wheels leave of the
    torque depends on their momentum, which is told with every observation:

    >>> torque_B = observer.torque(policy.predict(observer.observe(q_BN, omega_BN_B, q_DN, zones, wheel_momentum)))
    >>> each = observer.wheel_torques(torque_B)
    """

    def __init__(
        self, spacecraft: SpacecraftConfig, step_seconds: float, urgency: float = 0.5, observed_zones: int = 1
    ) -> None:
        """Begin a maneuver.

        Args:
            spacecraft: what turns, its instrument, and its wheels where it has any.
            step_seconds: time step, over which the torque is held [s].
            urgency: from 0 (thrifty) to 1 (as fast as the torque allows); see ``set_urgency``.
            observed_zones: how many zones the policy sees.

        Raises:
            SettingsError: the time step is not above 0, the urgency not in [0, 1], or the spacecraft has gyros.

        """
        super().__init__(spacecraft.boresight, observed_zones)
        if not 0.0 < step_seconds < np.inf:
            raise SettingsError(f"step_seconds: must be above 0, got {step_seconds}")
        self.set_urgency(urgency)
        self._spacecraft, self._step_seconds = spacecraft, step_seconds
        self._own = constants.of(spacecraft, step_seconds)
        self._seen = self._own
        self._wheels = HostWheels(spacecraft) if spacecraft.wheels else None
        self._momentum = self._wheels.momentum_at_start if self._wheels else np.zeros(0)
        self._omega_BN_B = np.zeros(3)

    def observe(
        self,
        q_BN: npt.ArrayLike,
        omega_BN_B: npt.ArrayLike,
        q_DN: npt.ArrayLike,
        zones: Sequence[Any] = (),
        wheel_momentum: npt.ArrayLike | None = None,
    ) -> npt.NDArray[np.float32]:
        """See what is measured in this time step; as of ``Observer.observe``.

        wheel_momentum: of each wheel about its axis (wheels,) [N m s]; None is that at the start, as the spacecraft's
        settings say.  Returns (entries,), in the order of ``layout(zones, scaled=True)``.

        Raises:
            SettingsError: likewise, or momenta are told and there are no wheels.

        """
        if self._wheels:
            told = self._wheels.momentum_at_start if wheel_momentum is None else wheel_momentum
            self._momentum = host.numbers("wheel_momentum", told, self._wheels.momentum_at_start.shape)
        elif wheel_momentum is not None:
            raise SettingsError("wheel_momentum: must be None, for the spacecraft has no wheels")
        return super().observe(q_BN, omega_BN_B, q_DN, zones)

    def set_urgency(self, urgency: float) -> None:
        """Hurry more or less from the next step on.

        urgency: from 0 (thrifty) to 1 (as fast as the torque allows).

        Raises:
            SettingsError: it is not in [0, 1].

        """
        if not 0.0 <= urgency <= 1.0:
            raise SettingsError(f"urgency: must be in [0, 1], got {urgency}")
        self._urgency = urgency

    def torque(self, action: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Torque that an action asks for in the situation that was observed last.

        action: (3,) in [-1, 1].  Returns (3,) [N m] in body axes, within the limits, or what wheels leave of them.

        Raises:
            SettingsError: the action is not finite or has another shape.

        """
        asked_B = self._seen.torque_per_action @ host.numbers("action", action, (ACTION_SIZE,))
        limits_B = self._share() * self._seen.torque_limits
        return np.clip(asked_B, -limits_B, limits_B).astype(np.float32)

    def wheel_torques(self, torque_B: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """What each wheel has to do for a torque, in the situation that was observed last.

        torque_B: (3,) [N m] in body axes, clipped to what the wheels leave.  Returns the torque (wheels,) [N m] that
        each gives the body over the time step, by which its own momentum falls; less of all where one of them is at the
        end of its torque or of its momentum.

        Raises:
            SettingsError: the torque is not finite or has another shape, or the spacecraft has no wheels.

        """
        if self._wheels is None:
            raise SettingsError("wheel_torques: the spacecraft has no wheels")
        wanted_B = host.numbers("torque_B", torque_B, (3,))
        each = self._wheels.torques(wanted_B, self._momentum, self._omega_BN_B, self._step_seconds)
        return each.astype(np.float32)

    def _share(self) -> float:
        """Of the torque limits, what is left now."""
        return self._wheels.share(self._momentum, self._omega_BN_B) if self._wheels else 1.0

    def _pack(
        self, q_BN: host.Floats, omega_BN_B: host.Floats, q_e: host.Floats, q_e0_previous: float, nearest: Cones
    ) -> npt.NDArray[np.float32]:
        same = np.array_equal(nearest.boresight_B[0], self._boresight_B)
        self._seen = self._own if same else constants.of(self._spacecraft, self._step_seconds, nearest.boresight_B[0])
        axes, self._omega_BN_B = self._seen.axes, omega_BN_B
        parts: dict[str, Any] = {
            "q_e": [q_e[0], *(axes @ q_e[1:])],
            "omega_BN_P": self._seen.time * (axes @ omega_BN_B),
            **self._seen.seen,
            **constants.seen_times(self._seen, omega_BN_B, q_e, self._share()),
            "urgency": [2.0 * self._urgency - 1.0],
        }
        if self._wheels:
            largest = self._wheels.largest_rate(self._momentum, omega_BN_B)
            parts["reach"] = self._share() * self._seen.seen["reach"]
            parts["rate_limit"] = constants.seen_rate(largest, self._seen.time)
        for number in range(self._observed_zones):
            zone = Cones(*(leaf[number] for leaf in nearest))
            seen = _zone_parts(q_BN, zone, masked=True)
            seen["zone_direction_P"] = axes @ seen["zone_direction_B"]
            seen["boresight_P"] = axes @ zone.boresight_B if zone.half_angle > 0.0 else np.zeros(3)
            parts |= {zone_part(number, name): value for name, value in seen.items()}
        return np.concatenate([parts[name] for name in layout(self._observed_zones, scaled=True)]).astype(np.float32)


def observer_of(policy: NumpyPolicy) -> Observer:
    """The observer of a policy for one spacecraft: its number of zones, and the boresight that it was trained for.

    Raises:
        SettingsError: the policy is for any spacecraft.

    """
    record = policy.record
    if record.network.scaled:
        raise SettingsError(f"policy: {policy.name} is for any spacecraft; scaled_observer_of observes one for it")
    return Observer(record.task.spacecraft.boresight, record.network.observed_zones)


def scaled_observer_of(
    policy: NumpyPolicy,
    spacecraft: SpacecraftConfig | None = None,
    step_seconds: float | None = None,
    urgency: float = 0.5,
) -> ScaledObserver:
    """The observer of a policy for any spacecraft that flies one.

    Args:
        policy: who flies.
        spacecraft: what turns, such as ``load_spacecraft(path).task.spacecraft``; by default that of the policy's task.
        step_seconds: time step [s], such as ``load_spacecraft(path).task.step_seconds``; by default likewise.
        urgency: from 0 (thrifty) to 1 (as fast as the torque allows).

    Raises:
        SettingsError: the policy is for one spacecraft, a spacecraft is told without its time step, or something is out
            of range.

    """
    network, task = policy.record.network, policy.record.task
    if not network.scaled:
        raise SettingsError(f"policy: {policy.name} was trained for one spacecraft; observer_of observes for it")
    if spacecraft is not None and step_seconds is None:
        raise SettingsError("step_seconds: must be told with a spacecraft of one's own, got None")
    return ScaledObserver(
        spacecraft or task.spacecraft, step_seconds or task.step_seconds, urgency, network.observed_zones
    )


def _nearest(q_BN: host.Floats, zones: Cones, count: int) -> Cones:
    """The zones with the smallest margins, nearest first, filled up with absent ones.  Returns a stack of ``count``."""
    order = np.argsort(host.margins(q_BN, zones), kind="stable")[:count]
    missing = count - len(order)
    return Cones(
        np.concatenate([zones.boresight_B[order], np.tile(zones.boresight_B[0], (missing, 1))]),
        np.concatenate([zones.axis_N[order], np.tile([1.0, 0.0, 0.0], (missing, 1))]),
        np.concatenate([zones.half_angle[order], np.full(missing, ABSENT_HALF_ANGLE)]),
    )


def _zone_parts(q_BN: host.Floats, zone: Cones, masked: bool) -> dict[str, Any]:
    if masked and zone.half_angle <= 0.0:
        return {"zone_margin": [np.pi], "zone_angle": [np.pi], "zone_direction_B": np.zeros(3)}
    angle = host.angles(q_BN, zone)
    offset = attitudes.rotate(host.conjugate(q_BN), zone.axis_N) - zone.boresight_B
    distance = np.linalg.norm(offset)
    return {
        "zone_margin": [angle - zone.half_angle],
        "zone_angle": [angle],
        "zone_direction_B": offset / distance if distance > 0.0 else np.zeros(3),
    }
