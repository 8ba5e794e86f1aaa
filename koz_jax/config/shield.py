"""Settings of the shield and of what it has to withstand.  Angles in degrees; imports no jax."""

from __future__ import annotations

from pydantic import AliasChoices, Field

from koz_jax.config.base import MarginDeg, NonNegativeFloat, PositiveFloat, PositiveInt, Settings, ShareBelowOne, Vector
from koz_jax.errors import SettingsError


class UncertaintyConfig(Settings):
    """How far the truth may be from the model."""

    inertia_error: ShareBelowOne = 0.0
    """Largest relative error of the inertia about any axis."""
    disturbance_torque: NonNegativeFloat = 0.0
    """Norm of a constant torque from outside [N m]."""
    attitude_noise_deg: NonNegativeFloat = 0.0
    """Standard deviation per axis of the measured attitude [deg], cut at 3 times that."""
    rate_noise_deg: NonNegativeFloat = 0.0
    """Standard deviation per axis of the measured rate [deg/s], cut at 3 times that."""


CERTAIN = UncertaintyConfig()


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
