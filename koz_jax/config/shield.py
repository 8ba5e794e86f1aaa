"""Settings of the shield.  Angles in degrees; imports no jax."""

from __future__ import annotations

from typing import Self

from pydantic import AliasChoices, Field, model_validator

from koz_jax.config.base import MarginDeg, PositiveFloat, PositiveInt, Settings, Vector
from koz_jax.config.uncertainty import CERTAIN, UncertaintyConfig
from koz_jax.errors import SettingsError


class ShieldConfig(Settings):
    """The shield."""

    margin_deg: MarginDeg = 0.1
    """Angle kept from every zone [deg]; more is kept where attitude noise is withstood."""
    error_bounds: UncertaintyConfig = Field(
        default=CERTAIN, validation_alias=AliasChoices("error_bounds", "withstands")
    )
    """Errors for which the guarantee holds."""
    guide_rate_deg: PositiveFloat | None = None
    """Rate with which the boresight is led around a zone [deg/s]; by default what suits the spacecraft."""
    samples: PositiveInt = 12
    """Samples of a brake path: more are less cautious and slower."""

    @model_validator(mode="after")
    def _withstands(self) -> Self:
        if self.error_bounds.delay_steps:
            raise ValueError(
                f"delay_steps: the shield does not withstand a delay; allowed is 0, got {self.error_bounds.delay_steps}"
            )
        return self

    def check(self, torque_limits: Vector) -> None:
        """Refuse to withstand what a spacecraft has no torque for.

        torque_limits: [N m] about each body axis.

        Raises:
            SettingsError: the disturbance is as strong.

        """
        disturbance, weakest = self.error_bounds.disturbance_torque, min(torque_limits)
        if disturbance >= weakest:
            raise SettingsError(
                f"disturbance_torque: must be below the torque limit of {weakest} N m for the shield to withstand"
                f" it, got {disturbance}"
            )
