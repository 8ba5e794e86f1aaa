"""Settings of the curriculum: how training changes with time.  Angles in degrees; imports no jax."""

from __future__ import annotations

from typing import Self

from pydantic import model_validator

from koz_jax.config.base import NonNegativeInt, Ramp, Settings, constant, ramp_value


class PhaseConfig(Settings):
    """One phase of the curriculum.  Ramps are lists of (fraction of the phase, value)."""

    updates: NonNegativeInt
    """Length of the phase in gradient updates."""
    min_angle_deg: Ramp = constant(0.0)
    """Smallest initial deviation [deg]."""
    max_angle_deg: Ramp = constant(180.0)
    """Largest initial deviation [deg]."""
    angle_bias: Ramp = constant(1.0)
    """Exponent p of angle = min + (max - min) u^p; 1 is uniform, above it small angles are drawn more often."""
    zone_weight: Ramp = constant(0.0)
    """Weight of the zone penalty."""
    zone_tightening_deg: Ramp = constant(0.0)
    """How much wider than it is the penalty sees the zone [deg]."""
    zone_steepness: Ramp = constant(1.0)
    """Factor on alpha, the decay of the zone penalty; larger keeps the penalty closer to the zone's edge."""
    effort_weight: Ramp = constant(0.0)
    """Cost per step of the squared action, beyond the paper's reward."""
    discount: Ramp = constant(0.99)
    """gamma, per environment step."""
    learning_rate: Ramp = constant(1e-4)
    """Learning rate of all networks."""

    @model_validator(mode="after")
    def _in_range(self) -> Self:
        for name, (low, high) in _RAMP_BOUNDS.items():
            for _, value in getattr(self, name):
                if not low <= value <= high:
                    raise ValueError(f"{name} must stay in [{low}, {high}]; got {value}")
        fractions = {fraction for ramp in (self.min_angle_deg, self.max_angle_deg) for fraction, _ in ramp}
        for fraction in sorted(fractions):
            low, high = (ramp_value(ramp, fraction) for ramp in (self.min_angle_deg, self.max_angle_deg))
            if low > high:
                raise ValueError(
                    f"min_angle_deg must not exceed max_angle_deg; at {fraction} of the phase they are {low} and {high}"
                )
        return self


_RAMP_BOUNDS = {
    "min_angle_deg": (0.0, 180.0),
    "max_angle_deg": (0.0, 180.0),
    "angle_bias": (1e-3, 1e3),
    "zone_weight": (0.0, 1e6),
    "zone_tightening_deg": (0.0, 90.0),
    "zone_steepness": (1e-3, 1e3),
    "effort_weight": (0.0, 1e6),
    "discount": (0.0, 0.99999),
    "learning_rate": (0.0, 1.0),
}


class CurriculumConfig(Settings):
    """The two phases of training: without and with the zone penalty."""

    phase1: PhaseConfig
    """Turning fast and precisely, without a zone."""
    phase2: PhaseConfig
    """Turning around the zone; begins with the best agent of phase 1."""

    @property
    def updates(self) -> int:
        """Length of the whole training."""
        return self.phase1.updates + self.phase2.updates
