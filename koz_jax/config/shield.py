"""Settings of the shield.  Angles in degrees; imports no jax."""

from __future__ import annotations

from typing import ClassVar, Self

from pydantic import AliasChoices, Field, model_validator

from koz_jax.config.base import MarginDeg, NonNegativeFloat, PositiveFloat, PositiveInt, Settings, Vector
from koz_jax.config.uncertainty import CERTAIN, UncertaintyConfig
from koz_jax.errors import SettingsError

# Of the torque that is there to brake with, what a disturbance may be: below it nothing was found to be pushed into a
# zone, see tests/control/test_shield_errors.py.
DISTURBED_SHARE = 0.5


def check_disturbance(disturbance: float, torque_limits: Vector, what_for: str, share: float = 1.0) -> None:
    """Refuse a disturbance [N m] that a spacecraft has no torque for.

    torque_limits: [N m] about each body axis, that can be braked with; share: of them that it may be.

    Raises:
        SettingsError: the disturbance is as strong.

    """
    weakest = min(torque_limits)
    if disturbance >= share * weakest:
        of_it = "" if share == 1.0 else f"{share:g} times "
        raise SettingsError(
            f"disturbance_torque: must be below {of_it}the torque limit of {weakest} N m for {what_for} it, got"
            f" {disturbance}"
        )


def check_cones(filter_name: str, allowed_deg: float, rate_deg: float) -> None:
    """Refuse a maneuver whose fastest cone [deg/s] turns faster than a filter allows for [deg/s].

    Raises:
        SettingsError: it does.

    """
    # With room for what float32 rounds.
    if rate_deg > allowed_deg * (1.0 + 1e-5):
        raise SettingsError(
            f"{filter_name}.cone_rate_deg: must be at least {rate_deg:.6g}, the rate of the maneuver's fastest cone,"
            f" got {allowed_deg:g}"
        )


class ShieldConfig(Settings):
    """The shield."""

    name: ClassVar[str] = "shield"

    margin_deg: MarginDeg = 0.1
    """Angle kept from every zone [deg]; more is kept where attitude noise is withstood."""
    error_bounds: UncertaintyConfig = Field(
        default=CERTAIN, validation_alias=AliasChoices("error_bounds", "withstands")
    )
    """Errors for which the guarantee holds."""
    cone_rate_deg: NonNegativeFloat = 0.0
    """Largest rate of a cone's axis that it is kept against [deg/s]; a maneuver file or a draw says its own."""
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

        torque_limits: [N m] about each body axis, that can be braked with.

        Raises:
            SettingsError: the disturbance is not weaker than half of the weakest axis.

        """
        disturbance = self.error_bounds.disturbance_torque
        check_disturbance(disturbance, torque_limits, "the shield to withstand", DISTURBED_SHARE)

    def check_cones(self, rate_deg: float) -> None:
        """Refuse a maneuver whose cones turn faster than is withstood.  rate_deg: [deg/s] of the fastest axis.

        Raises:
            SettingsError: they do.

        """
        check_cones(self.name, self.cone_rate_deg, rate_deg)
