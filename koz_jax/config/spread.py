"""Settings of what maneuvers of one task differ in besides their scenario.  Angles in degrees; imports no jax."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from koz_jax.config.base import Fraction, PositiveFloat, SettingsOfAgents, Share, ZoneCount
from koz_jax.config.uncertainty import CERTAIN, DelaySteps, UncertaintyConfig

Urgency = Share
InstrumentCount = Annotated[int, Field(ge=1, le=3)]


class SpreadConfig(SettingsOfAgents):
    """What is drawn anew for every maneuver, besides its scenario."""

    later: ClassVar = ("nominal",)

    spacecraft: bool = False
    """Fly another spacecraft in every maneuver: any shape, any instrument, torque limits that differ by up to a factor
    of 2; the trace of the inertia and the strength of the actuators are the task's."""
    slenderness: tuple[Fraction, Fraction] | None = None
    """Smallest over largest second moment of mass of these spacecraft; None draws all three from 0.05 to 1."""
    wheels: Literal["three", "pyramid"] | None = None
    """Turn these spacecraft by reaction wheels, three along the body axes or four in a pyramid, all of one size, with
    a bias of up to 30 % of their momentum at the start; None by a torque box."""
    wheel_momentum: tuple[PositiveFloat, PositiveFloat] = (1.0, 4.0)
    """Largest momentum of these wheels, in units of u T."""
    zones: tuple[ZoneCount, ZoneCount] | None = None
    """Zones of a case, every number of them as often; None leaves the scenario's."""
    instruments: InstrumentCount = 1
    """Instruments of these spacecraft, each somewhere; the zone in the way is for the first, each further one for one
    of them."""
    keep_in: Share = 0.0
    """Share of the other instruments' zones that are cones to keep them in, of half angles from 60 to 100 deg."""
    step_shares: tuple[PositiveFloat, PositiveFloat] = (0.009, 0.05)
    """Time steps of these spacecraft, in units of T = sqrt(J / u)."""
    max_rate_deg: tuple[PositiveFloat, PositiveFloat] | None = None
    """Limits of the body rate [deg/s], distributed evenly over their logarithm; None leaves the spacecraft's own."""
    urgency: tuple[Urgency, Urgency] | None = None
    """Urgencies that an agent is trained with, a seventh of the maneuvers at either end; None leaves 0.5."""

    errors: UncertaintyConfig = CERTAIN
    """Errors that every maneuver is flown with."""
    delay_steps: tuple[DelaySteps, DelaySteps] | None = None
    """Steps by which the torque comes late, distributed evenly; None leaves those of ``errors``."""
    nominal: Share = 0.0
    """Share of the maneuvers that are flown without errors and delay, with the least number of zones and the largest
    limit of the body rate."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.wheels is not None and not self.spacecraft:
            raise ValueError(f"wheels: are drawn with spacecraft = true, got {self.wheels!r} without it")
        if self.instruments > 1 and not self.spacecraft:
            raise ValueError(f"instruments: are drawn with spacecraft = true, got {self.instruments} without it")
        if self.keep_in and self.instruments == 1:
            raise ValueError(f"keep_in: is for other instruments than the first, got {self.keep_in} with one")
        for name in ("slenderness", "step_shares", "wheel_momentum", "zones", "max_rate_deg", "urgency", "delay_steps"):
            limits = getattr(self, name)
            if limits is not None and limits[0] > limits[1]:
                raise ValueError(f"{name} must be in order; got {limits}")
        return self

    @property
    def is_none(self) -> bool:
        """Whether nothing is drawn."""
        return not self.spacecraft and self.max_rate_deg is self.urgency is self.delay_steps is None
