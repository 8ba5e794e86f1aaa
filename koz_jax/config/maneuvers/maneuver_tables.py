"""The tables of a maneuver file.  Angles in degrees, quaternions scalar first; imports no jax."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import AfterValidator, ValidationError, field_validator, model_validator

from koz_jax.config import attitudes
from koz_jax.config.actuators import agility
from koz_jax.config.actuators.gyros import PyramidConfig
from koz_jax.config.actuators.wheels import WheelConfig
from koz_jax.config.base import (
    HalfAngleDeg,
    NonNegativeFloat,
    PositiveFloat,
    Settings,
    ShareBelowOne,
    Vector,
)
from koz_jax.config.task import SpacecraftConfig, TorqueLimit
from koz_jax.config.uncertainty import DelaySteps, UncertaintyConfig
from koz_jax.errors import explain

# By so much a direction or a quaternion may be longer or shorter than 1; more is a slip of the pen.
_LENGTH_TOLERANCE = 0.01

# A half turn that takes longer is a mistake of units, such as moments in g cm2 or kg mm2.
_LONGEST_HALF_TURN_SECONDS = 3600.0


def _of_unit_length(values: tuple[float, ...]) -> tuple[float, ...]:
    length = float(np.linalg.norm(values))
    if abs(length - 1.0) > _LENGTH_TOLERANCE:
        kind = "a unit quaternion, scalar first" if len(values) == 4 else "a unit vector"
        raise ValueError(f"must be {kind}, of length 1 to within {_LENGTH_TOLERANCE:.0%}; its length is {length:.6g}")
    return tuple(attitudes.normalized(values).tolist())


Direction = Annotated[Vector, AfterValidator(_of_unit_length)]
Attitude = Annotated[tuple[float, float, float, float], AfterValidator(_of_unit_length)]


class Table(Settings):
    """A table of a maneuver file; says which keys there are where one is unknown."""

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, given: Any) -> Any:
        unknown = [key for key in given if key not in cls.model_fields] if isinstance(given, dict) else []
        if unknown:
            values = ", ".join(f"{key!r} (got {given[key]!r})" for key in unknown)
            raise ValueError(f"unknown key {values}; allowed are {', '.join(cls.model_fields)}")
        return given


class WheelTable(Table, WheelConfig):
    """A reaction wheel."""

    axis: Direction
    """Its axis, in body axes; normalised on reading."""


class GyrosTable(Table, PyramidConfig):
    """Four control moment gyros in a pyramid about z."""


class BodyConfig(Table):
    """The spacecraft's body and actuators."""

    inertia: tuple[Vector, Vector, Vector]
    """Inertia tensor in body axes, row by row [kg m^2]."""
    torque_limit: TorqueLimit | None = None
    """Largest torque about each body axis [N m]: one number for all, or one for each; either this, wheels or gyros."""
    wheels: tuple[WheelTable, ...] = ()
    """Reaction wheels, at least three, with axes that do not lie in a plane."""
    gyros: GyrosTable | None = None
    """Control moment gyros."""
    max_rate_deg: PositiveFloat | None = None
    """Largest norm of the body rate [deg/s]; kept by agents for any spacecraft."""

    @field_validator("inertia", mode="before")
    @classmethod
    def _three_rows(cls, given: Any) -> Any:
        rows = given if isinstance(given, list | tuple) else ()
        if len(rows) == 3 and all(isinstance(row, list | tuple) and len(row) == 3 for row in rows):
            return given
        moments = len(rows) == 3 and all(isinstance(row, int | float) for row in rows)
        example = np.diag(rows if moments else (0.05, 0.06, 0.02)).tolist()
        raise ValueError(f"must be three rows of three numbers, such as {example}")

    @model_validator(mode="after")
    def _physical(self) -> Self:
        given = [name for name in ("torque_limit", "wheels", "gyros") if getattr(self, name)]
        if len(given) != 1:
            raise ValueError(f"must have one of torque_limit, wheels and gyros; got {' and '.join(given) or 'none'}")
        try:
            self.spacecraft((1.0, 0.0, 0.0))
        except ValidationError as error:
            raise ValueError(explain(error)) from None
        slowest = self.half_turns[0]
        if slowest > _LONGEST_HALF_TURN_SECONDS:
            raise ValueError(
                f"inertia: moments of up to {np.max(np.diag(self.inertia)):.6g} kg m2 on a torque of"
                f" {min(self.spacecraft((1.0, 0.0, 0.0)).torque_limits):.6g} N m make a half turn take"
                f" {slowest / 3600.0:.3g} h; allowed is at most 1 h. Are the moments in g cm2 or kg mm2?"
            )
        return self

    @classmethod
    def of(cls, spacecraft: SpacecraftConfig) -> BodyConfig:
        """The same of a spacecraft, whose instrument is left out.

        Raises:
            ValueError: it has gyros, of which a file knows a pyramid only.

        """
        if spacecraft.gyros:
            raise ValueError(
                f"spacecraft.gyros: must be none, got {len(spacecraft.gyros)}; a file with a table [spacecraft.gyros]"
                " can describe a pyramid of them"
            )
        wheels = tuple(WheelTable(**wheel.model_dump()) for wheel in spacecraft.wheels)
        return cls(
            inertia=spacecraft.inertia,
            torque_limit=None if wheels else spacecraft.torque_limit,
            wheels=wheels,
            max_rate_deg=spacecraft.max_rate_deg,
        )

    def spacecraft(self, boresight: Vector) -> SpacecraftConfig:
        """The same with an instrument.  boresight: unit vector in body axes."""
        limit = {} if self.torque_limit is None else {"torque_limit": self.torque_limit}
        return SpacecraftConfig(
            inertia=self.inertia,
            boresight=boresight,
            wheels=tuple(WheelConfig(**wheel.model_dump()) for wheel in self.wheels),
            gyros=() if self.gyros is None else self.gyros.gyros,
            max_rate_deg=self.max_rate_deg,
            **limit,
        )

    @property
    def half_turns(self) -> tuple[float, float]:
        """The fastest half turn, 2 sqrt(pi J / u) [s], about the slowest body axis and about the quickest."""
        limits = np.array(self.spacecraft((1.0, 0.0, 0.0)).torque_limits)
        seconds = 2.0 * np.sqrt(np.pi * np.diag(self.inertia) / limits)
        return float(seconds.max()), float(seconds.min())

    @property
    def largest_rate(self) -> float:
        """Largest rate that is allowed and can be stopped, at the start [rad/s]; infinite where there is no limit."""
        return agility.rate_at_start(self.spacecraft((1.0, 0.0, 0.0)))


class InstrumentConfig(Table):
    """Something that looks in a direction."""

    name: str
    """What constraints and targets call it."""
    boresight: Direction
    """Where it looks, in body axes; normalised on reading."""


class Cone(NamedTuple):
    """Directions that an instrument is kept out of."""

    direction: Vector  # axis at the start, in inertial axes
    half_angle_deg: float
    rotation_deg: Vector  # [deg/s] angular velocity of the axis, in inertial axes

    def axis_after(self, seconds: float) -> np.ndarray:
        """Where the axis is a time [s] after the start.  Returns (3,) unit vector."""
        rate = np.deg2rad(self.rotation_deg)
        speed = float(np.linalg.norm(rate))
        if speed == 0.0:
            return np.array(self.direction)
        return attitudes.rotate(attitudes.turn_about(rate / speed, speed * seconds), np.array(self.direction))


class ConstraintConfig(Table):
    """A cone of directions that an instrument must not look into, or must not leave."""

    instrument: str
    """Its name."""
    kind: Literal["keep_out", "keep_in"] = "keep_out"
    """The instrument is kept out of the cone, or in it."""
    direction: Direction
    """Axis of the cone at the start, in inertial axes; normalised on reading."""
    half_angle_deg: HalfAngleDeg
    """Half angle of the cone [deg]."""
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    """Angular velocity of the direction [deg/s], in inertial axes; of the Earth seen from a low orbit it is 0.064."""

    @property
    def keep_out_cone(self) -> Cone:
        """What the instrument is kept out of: to be kept in a cone is to be kept out of the rest of the sphere."""
        if self.kind == "keep_out":
            return Cone(self.direction, self.half_angle_deg, self.rotation_deg)
        x, y, z = self.direction
        return Cone((-x, -y, -z), 180.0 - self.half_angle_deg, self.rotation_deg)

    @property
    def allowed_side(self) -> str:
        """Where the instrument may look, seen from the cone."""
        return "outside" if self.kind == "keep_out" else "inside"

    @property
    def forbidden_side(self) -> str:
        """Where it may not look."""
        return "inside" if self.kind == "keep_out" else "outside"


def fastest_cone_deg(constraints: Iterable[ConstraintConfig]) -> float:
    """Rate of the axis that turns fastest [deg/s]; 0 where none turns."""
    return max((float(np.linalg.norm(one.rotation_deg)) for one in constraints), default=0.0)


class StartConfig(Table):
    """Where the maneuver starts."""

    attitude: Attitude
    """Body relative to inertial axes, scalar first."""
    rate_deg: Vector = (0.0, 0.0, 0.0)
    """Body rate in body axes [deg/s]."""


class TargetConfig(Table):
    """Where it must end: an attitude, or where an instrument looks while the roll about that is free."""

    attitude: Attitude | None = None
    """Body relative to inertial axes, scalar first; of the two signs the nearer one is taken."""
    instrument: str | None = None
    """Name of the instrument that must look in a direction."""
    direction: Direction | None = None
    """That direction, in inertial axes; normalised on reading."""

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        pointed = (self.instrument is not None, self.direction is not None)
        if pointed[0] != pointed[1] or (self.attitude is not None) == pointed[0]:
            given = ", ".join(name for name, value in self if value is not None) or "neither"
            raise ValueError(f"must have either attitude, or instrument and direction; got {given}")
        return self


class ErrorsConfig(Table):
    """What the truth has and the controller does not know."""

    inertia: ShareBelowOne = 0.0
    """Largest relative error of the inertia about any axis."""
    disturbance_torque: NonNegativeFloat = 0.0
    """Norm of a constant torque from outside [N m]."""
    attitude_noise_deg: NonNegativeFloat = 0.0
    """Standard deviation per axis of the measured attitude [deg]."""
    rate_noise_deg: NonNegativeFloat = 0.0
    """Standard deviation per axis of the measured rate [deg/s]."""
    attitude_bias_deg: NonNegativeFloat = 0.0
    """Constant error of the measured attitude [deg], about a random axis."""
    rate_bias_deg: NonNegativeFloat = 0.0
    """Norm of a constant error of the measured rate [deg/s], its direction random."""
    delay_steps: DelaySteps = 0
    """Steps by which the torque comes late."""

    @property
    def uncertainty(self) -> UncertaintyConfig:
        """The same as settings of a flight."""
        values = self.model_dump(exclude={"inertia"})
        return UncertaintyConfig(inertia_error=self.inertia, **values)


class PublishedConfig(Table):
    """What others report of the same maneuver, to stand beside one's own result."""

    by: str = ""
    """Who, and how."""
    slew_deg: PositiveFloat | None = None
    """Rotation from start to target [deg]."""
    settling_seconds: PositiveFloat | None = None
    """Settling time, or length of the maneuver [s]."""
    control_effort: NonNegativeFloat | None = None
    """Integral of the squared torque [N^2 m^2 s]."""
    end_error_deg: NonNegativeFloat | None = None
    """Rotation left at the end [deg]."""
    min_margin_deg: float | None = None
    """Smallest margin to any constraint [deg]."""
    peak_rate_deg: NonNegativeFloat | None = None
    """Largest norm of the body rate [deg/s]."""
