"""Settings of safety filters: what can stand between a controller and the actuators.  Imports no jax."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Discriminator, Tag, model_validator

from koz_jax.config.base import NonNegativeFloat, PositiveFloat, PositiveInt, Seed, Settings, Vector
from koz_jax.config.shield import ShieldConfig, check_cones, check_disturbance

FilterName = Literal["shield", "zoh_cbf"]


class ZohCbfConfig(Settings):
    """The control-barrier-function filter for held torques of Breeden & Panagou 2023, as of Yang & Ben-Larbi 2026."""

    name: ClassVar[str] = "zoh_cbf"
    margin_deg: ClassVar[float] = 0.0

    max_rate: PositiveFloat = 0.956
    """Largest rate that it lets a spacecraft reach [1/T], T = sqrt(J / u); 10 deg/s for the paper's."""
    disturbance_torque: NonNegativeFloat = 0.0
    """Norm of the torque from outside that it allows for [N m]."""
    cone_rate_deg: NonNegativeFloat = 0.0
    """Largest rate of a cone's axis that it allows for [deg/s]; a maneuver file or a draw says its own."""
    samples: PositiveInt = 2000
    """States in which its bounds are looked for."""
    seed: Seed = 0
    """Seed of these states."""

    @model_validator(mode="after")
    def _enough(self) -> Self:
        if self.samples < 100:
            raise ValueError(f"samples: must be at least 100, got {self.samples}")
        return self

    def check(self, torque_limits: Vector) -> None:
        """Refuse a disturbance that a spacecraft has no torque for.  torque_limits: [N m] about each body axis.

        Raises:
            SettingsError: the disturbance is as strong.

        """
        check_disturbance(self.disturbance_torque, torque_limits, "the filter to allow for")

    def check_cones(self, rate_deg: float) -> None:
        """Refuse a maneuver whose cones turn faster than is allowed for.  rate_deg: [deg/s] of the fastest axis.

        Raises:
            SettingsError: they do.

        """
        check_cones(self.name, self.cone_rate_deg, rate_deg)


def _kind(given: Any) -> FilterName:
    """Which filter settings are of; what could be of either is of the shield."""
    names = given if isinstance(given, dict) else ()
    of_other = any(name in ZohCbfConfig.model_fields and name not in ShieldConfig.model_fields for name in names)
    return "zoh_cbf" if of_other or isinstance(given, ZohCbfConfig) else "shield"


FilterConfig = ShieldConfig | ZohCbfConfig

# Told apart by their fields, so that a refusal is about the one that was meant.
AnyFilter = Annotated[
    Annotated[ShieldConfig, Tag("shield")] | Annotated[ZohCbfConfig, Tag("zoh_cbf")], Discriminator(_kind)
]


def for_cones(config: FilterConfig, rate_deg: float) -> FilterConfig:
    """A filter that allows for cones that turn, if it does not already.  rate_deg: [deg/s] of the fastest axis."""
    return config.model_copy(update={"cone_rate_deg": max(rate_deg, config.cone_rate_deg)})


def filter_named(name: FilterName) -> FilterConfig:
    """A filter by its name, with its default settings."""
    return ZohCbfConfig() if name == "zoh_cbf" else ShieldConfig()
