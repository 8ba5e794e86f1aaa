"""Settings of one maneuver as a person writes it: spacecraft, instruments, constraints, start and target.

Angles in degrees, quaternions scalar first; imports no jax.  ``maneuver_file`` reads such settings from TOML.
"""

from __future__ import annotations

import dataclasses
import logging
from typing import Self

import numpy as np
from pydantic import model_validator

from koz_jax.config import attitudes
from koz_jax.config.actuators import agility
from koz_jax.config.base import PositiveFloat, check_steps, doubt_of_degrees
from koz_jax.config.maneuvers.maneuver_tables import (
    BodyConfig,
    ConstraintConfig,
    ErrorsConfig,
    InstrumentConfig,
    PublishedConfig,
    StartConfig,
    Table,
    TargetConfig,
)
from koz_jax.config.task import RewardConfig, TaskConfig

_log = logging.getLogger(__name__)

# A maneuver lasts so many half turns by full torque unless it says otherwise, and at least so many at the largest rate;
# in whole tens of seconds.  An hour for one at the largest rate is the most that is waited for.
_HALF_TURNS, _HALF_TURNS_AT_RATE, _WHOLE_SECONDS, _LONGEST_SECONDS = 5, 2, 10.0, 3600.0

# Where the roll is free and the smallest rotation ends inside a constraint: rolls that are tried, and how far from
# every constraint they must end.  The shield keeps less.
_ROLL_STEP_DEG, _ROLL_CLEARANCE_DEG = 0.1, 0.25

# A turn whose half angle has a sine below it is none.
_NO_TURN = 1e-9


@dataclasses.dataclass(frozen=True)
class Aim:
    """The target attitude as it is flown to."""

    attitude: tuple[float, ...]  # (4,) q_DN, of its two signs the one nearer to the start
    roll_deg: float  # [deg] about the direction, away from the smallest rotation; 0 for a target by attitude


class ManeuverConfig(Table):
    """One maneuver: what flies, from where, to where, and what must not be looked at."""

    name: str = "maneuver"
    """What to call it."""
    step_seconds: PositiveFloat
    """Time step; the torque is held over it [s]."""
    duration_seconds: PositiveFloat | None = None
    """How long it is flown [s]; by default five times the fastest half turn about the slowest axis, or two half turns
    at the largest rate where that is longer, in whole tens."""
    settled_angle_deg: PositiveFloat = RewardConfig().settled_angle_deg
    """Settled is what stays within this angle of the target [deg]."""
    source: str = ""
    """Where the numbers come from."""
    published: PublishedConfig | None = None
    """What others report."""
    spacecraft: BodyConfig
    """What turns."""
    instruments: tuple[InstrumentConfig, ...] = ()
    """What looks."""
    constraints: tuple[ConstraintConfig, ...] = ()
    """What must not be looked at."""
    start: StartConfig
    """Where it starts."""
    target: TargetConfig
    """Where it must end."""
    errors: ErrorsConfig = ErrorsConfig()
    """What the controller does not know."""

    @model_validator(mode="after")
    def _instruments_known(self) -> Self:
        names = [instrument.name for instrument in self.instruments]
        if len(set(names)) < len(names):
            raise ValueError(f"instruments: must have different names, got {', '.join(names)}")
        asked = [(f"constraints.{i}", constraint.instrument) for i, constraint in enumerate(self.constraints)]
        for where, name in [*asked, ("target", self.target.instrument)]:
            if name is not None and name not in names:
                known = ", ".join(names) or "none: there is no [[instruments]]"
                raise ValueError(f"{where}.instrument: must be one of the instruments ({known}), got {name!r}")
        return self

    @model_validator(mode="after")
    def _step_of_the_spacecraft(self) -> Self:
        quickest = self.spacecraft.half_turns[1]
        if self.step_seconds > 0.5 * quickest:
            raise ValueError(
                f"step_seconds: must be at most {0.5 * quickest:.3g}, half of the {quickest:.3g} s in which this"
                f" spacecraft can make a half turn; got {self.step_seconds:g}. Are inertia and torque_limit in kg m2"
                " and N m?"
            )
        check_steps("duration_seconds", self.seconds, self.step_seconds)
        return self

    @model_validator(mode="after")
    def _clear_at_both_ends(self) -> Self:
        self._check_clear("start.attitude", self.start.attitude, 0.0)
        where = "target.attitude" if self.target.attitude else "target.direction"
        self._check_clear(where, self.aim.attitude, self.seconds)
        return self

    @model_validator(mode="after")
    def _told(self) -> Self:
        """Log the cautions of a maneuver that can be flown, wherever it comes from."""
        for caution in self.cautions:
            _log.warning("%s: %s", self.name, caution)
        return self

    def _check_clear(self, where: str, attitude: tuple[float, ...], seconds: float) -> None:
        """Refuse an attitude that breaks a constraint at a time after the start."""
        margins = self.margins_deg(np.array(attitude), seconds)
        if len(margins) and margins.min() <= 0.0:
            number = int(margins.argmin())
            constraint = self.constraints[number]
            written = ", ".join(f"{value:.6g}" for value in attitude)
            when = f" after {seconds:g} s" if any(constraint.rotation_deg) and seconds else ""
            raise ValueError(
                f"{where}: must keep every constraint; ({written}) has {constraint.instrument!r}"
                f" {-margins.min():.3g} deg {constraint.forbidden_side} {self._named(number, when)}"
            )

    def _named(self, number: int, when: str = "") -> str:
        """A constraint, for messages."""
        constraint = self.constraints[number]
        return (
            f"constraints.{number}{when}, a {constraint.kind} cone of half angle {constraint.half_angle_deg:g} deg for"
            f" {constraint.instrument!r}"
        )

    def boresight(self, instrument: str) -> np.ndarray:
        """Where an instrument looks.  Returns (3,) unit vector in body axes."""
        return np.array(next(found.boresight for found in self.instruments if found.name == instrument))

    def margins_deg(self, attitude: np.ndarray, seconds: float = 0.0) -> np.ndarray:
        """Margin to each constraint, a time [s] after the start.

        attitude: (..., 4).  Returns (..., constraints) [deg].
        """
        if not self.constraints:
            return np.zeros((*attitude.shape[:-1], 0))
        cones = [one.keep_out_cone for one in self.constraints]
        looks = [attitudes.rotate(attitude, self.boresight(one.instrument)) for one in self.constraints]
        angles = [
            attitudes.angle_between(look, cone.axis_after(seconds)) for look, cone in zip(looks, cones, strict=True)
        ]
        return np.rad2deg(np.stack(angles, axis=-1)) - [cone.half_angle_deg for cone in cones]

    @property
    def aim(self) -> Aim:
        """The target attitude, which must keep every constraint when the maneuver ends.

        For a target by direction the one that the smallest rotation from the start leads to; if that ends inside a
        constraint, the nearest roll about the direction that does not.
        """
        start = np.array(self.start.attitude)
        if self.target.attitude is not None:
            return _nearer(np.array(self.target.attitude), start, 0.0)
        assert self.target.instrument is not None and self.target.direction is not None
        direction = np.array(self.target.direction)
        looks = attitudes.rotate(start, self.boresight(self.target.instrument))
        straight = attitudes.multiply(attitudes.shortest_arc(looks, direction), start)
        if np.all(self.margins_deg(straight, self.seconds) > 0.0):
            return _nearer(straight, start, 0.0)
        count = round(180.0 / _ROLL_STEP_DEG)
        rolls_deg = _ROLL_STEP_DEG * np.arange(1, count + 1)
        rolls_deg = np.stack([rolls_deg, -rolls_deg], axis=1).ravel()
        rolled = attitudes.multiply(attitudes.turn_about(direction, np.deg2rad(rolls_deg)), straight)
        margins = self.margins_deg(rolled, self.seconds)
        clear = margins.min(axis=1)
        found = int(np.argmax(clear >= _ROLL_CLEARANCE_DEG)) if clear.max() >= _ROLL_CLEARANCE_DEG else None
        if found is None:
            nearest = self._named(int(margins[clear.argmax()].argmin()))
            raise ValueError(
                f"target.direction: no roll about it keeps every constraint by {_ROLL_CLEARANCE_DEG:g} deg;"
                f" the best leaves {clear.max():.3g} deg to {nearest}, got {self.target.direction}"
            )
        return _nearer(rolled[found], start, float(rolls_deg[found]))

    @property
    def has_errors(self) -> bool:
        """Whether there is anything that the controller does not know."""
        return self.errors != ErrorsConfig()

    @property
    def seconds(self) -> float:
        """How long it is flown [s]."""
        return self.default_duration[0] if self.duration_seconds is None else self.duration_seconds

    @property
    def default_duration(self) -> tuple[float, str]:
        """How long it is flown where nothing is said [s], and why."""
        half_turn, rate = self.spacecraft.half_turns[0], self.spacecraft.largest_rate
        by_rate = min(np.pi / rate, _LONGEST_SECONDS) if rate > 0.0 else _LONGEST_SECONDS
        seconds, why = _HALF_TURNS * half_turn, f"{_HALF_TURNS} times the fastest half turn, {half_turn:.3g} s"
        if _HALF_TURNS_AT_RATE * by_rate > seconds:
            seconds = _HALF_TURNS_AT_RATE * by_rate
            why = f"{_HALF_TURNS_AT_RATE} half turns at the largest rate, {np.rad2deg(rate):.3g} deg/s"
        return float(_WHOLE_SECONDS * np.ceil(seconds / _WHOLE_SECONDS)), f"{why}, in whole {_WHOLE_SECONDS:g} s"

    @property
    def task(self) -> TaskConfig:
        """What is flown, as settings of a task; its instrument is the first, as of ``SpacecraftFile``."""
        boresight = self.instruments[0].boresight if self.instruments else (1.0, 0.0, 0.0)
        return TaskConfig(
            spacecraft=self.spacecraft.spacecraft(boresight),
            reward=RewardConfig(settled_angle_deg=self.settled_angle_deg),
            step_seconds=self.step_seconds,
            episode_seconds=self.seconds,
        )

    @property
    def cautions(self) -> list[str]:
        """What is allowed and looks wrong, each in a line."""
        cones = [doubt_of_degrees(one.half_angle_deg) for one in self.constraints]
        small = [f"constraints.{i}.half_angle_deg: {doubt}" for i, doubt in enumerate(cones) if doubt]
        momenta = agility.senseless_momenta(self.task.spacecraft)
        return [*small, *(f"spacecraft.{momentum}" for momentum in momenta), *self._short_of_time]

    @property
    def _short_of_time(self) -> list[str]:
        """Whether the turn takes longer than it is flown, at full torque and the largest rate."""
        turn = attitudes.multiply(np.array([1.0, -1.0, -1.0, -1.0]) * self.start.attitude, np.array(self.aim.attitude))
        sine, rate = float(np.linalg.norm(turn[1:])), self.spacecraft.largest_rate
        if sine < _NO_TURN:
            return []
        angle_deg = float(np.rad2deg(2.0 * np.arctan2(sine, abs(turn[0]))))
        turning = agility.about(self.task.spacecraft, turn[1:] / sine)
        least = turning.turn_seconds(angle_deg, rate)
        if least <= self.seconds:
            return []
        limited = f", at up to {np.rad2deg(rate):.3g} deg/s" if np.isfinite(rate) else ""
        return [
            f"duration_seconds: is {self.seconds:g}, and the turn by {angle_deg:.3g} deg takes {least:.3g} s or more"
            f" ({turning}{limited})"
        ]


def _nearer(attitude: np.ndarray, start: np.ndarray, roll_deg: float) -> Aim:
    """Of the two signs of an attitude, the one that is nearer to the start."""
    return Aim(tuple((attitude if attitude @ start >= 0.0 else -attitude).tolist()), roll_deg)
