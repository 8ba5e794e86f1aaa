"""What settings are made of: checked numbers, ramps, and the base class of all of them."""

from typing import Annotated, Any, ClassVar, TypeVar

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
)

from koz_jax.errors import SettingsError, explain

# More cones of 15 to 30 deg, with gaps, hardly find room on half a sphere.
MAX_ZONES = 8

# Half angles [deg] below it are rather radians: pi / 2 and less.
_RADIANS_BELOW = 1.6

PositiveFloat = Annotated[float, Field(gt=0)]
NonNegativeFloat = Annotated[float, Field(ge=0)]
# Counts are int32 on the device, and so are the bits of a seed.
PositiveInt = Annotated[int, Field(gt=0, lt=2**31)]
NonNegativeInt = Annotated[int, Field(ge=0, lt=2**31)]
Seed = Annotated[int, Field(ge=0, lt=2**32)]
CaseCount = Annotated[int, Field(gt=0, lt=2**31)]
CheckCount = Annotated[int, Field(gt=0, le=100)]
Fraction = Annotated[float, Field(gt=0, le=1)]
Share = Annotated[float, Field(ge=0, le=1)]
ShareBelowOne = Annotated[float, Field(ge=0, lt=1)]
HalfAngleDeg = Annotated[float, Field(gt=0, lt=180)]
MarginDeg = Annotated[float, Field(gt=0, lt=180)]
DeviationDeg = Annotated[float, Field(ge=0, le=180)]
ZoneCount = Annotated[int, Field(gt=0, le=MAX_ZONES)]
Vector = tuple[float, float, float]
PositiveVector = tuple[PositiveFloat, PositiveFloat, PositiveFloat]


def _check_ramp(ramp: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    fractions = [fraction for fraction, _ in ramp]
    if not ramp or fractions != sorted(set(fractions)) or fractions[0] < 0 or fractions[-1] > 1:
        raise ValueError("a ramp needs one or more (fraction, value) pairs with fractions rising strictly in [0, 1]")
    return ramp


def check_unit(name: str, vector: Vector) -> None:
    """Refuse a vector that is not of unit length."""
    length = float(np.linalg.norm(vector))
    if abs(length - 1.0) > 1e-6:
        raise ValueError(f"{name} must be a unit vector; {vector} has length {length:.6g}")


def doubt_of_degrees(half_angle_deg: float) -> str:
    """Say of a half angle [deg] that it is rather one in radians; empty where it is not."""
    if half_angle_deg >= _RADIANS_BELOW:
        return ""
    return f"{half_angle_deg:g} deg is small; is it {half_angle_deg:g} rad = {np.rad2deg(half_angle_deg):.1f} deg?"


def check_steps(name: str, seconds: float, step_seconds: float) -> None:
    """Refuse a time [s] that holds no step, or more than can be counted."""
    if not 0.5 < seconds / step_seconds < 2**31 - 1:
        raise ValueError(f"{name} must hold 1 to 2^31 - 1 steps of step_seconds = {step_seconds}; got {seconds}")


# Piecewise linear in the fraction of the phase that is done, constant before the first and after the last pair.
Ramp = Annotated[tuple[tuple[float, float], ...], AfterValidator(_check_ramp)]


def constant(value: float) -> Ramp:
    """Make a ramp that stays at one value."""
    return ((0.0, value),)


def ramp_value(ramp: Ramp, fraction: float) -> float:
    """Value of a ramp at a fraction of its phase."""
    fractions, values = zip(*ramp, strict=True)
    return float(np.interp(fraction, fractions, values))


class Settings(BaseModel):
    """Base of all settings: immutable, no unknown fields, no infinities."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


class SettingsOfAgents(Settings):
    """Settings that shipped agents are hashed with.

    ``later``: fields that came after them.  They are not written where they have their default, so that hashes stay.
    """

    later: ClassVar[tuple[str, ...]] = ()

    @model_serializer(mode="wrap")
    def _without_later_defaults(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        unset = {name for name in self.later if getattr(self, name) == type(self).model_fields[name].default}
        return {name: value for name, value in serialize(self).items() if name not in unset}


SettingsType = TypeVar("SettingsType", bound=Settings)


def checked(settings: type[SettingsType], **values: Any) -> SettingsType:
    """Make settings.

    Raises:
        SettingsError: a value is not allowed; the message names it, and what is allowed.

    """
    try:
        return settings(**values)
    except ValidationError as error:
        raise SettingsError(explain(error)) from None
