"""Settings of a Monte Carlo evaluation.  Angles in degrees; imports no jax."""

from __future__ import annotations

from typing import Self

from pydantic import model_validator

from koz_jax.config.base import CaseCount, CheckCount, DeviationDeg, NonNegativeInt, Seed, Settings
from koz_jax.config.filters import AnyFilter
from koz_jax.config.uncertainty import UncertaintyConfig


class CaseConfig(Settings):
    """Which cases are drawn, and how closely they are checked."""

    cases: CaseCount = 10_000
    """Number of cases of the draw."""
    seed: Seed = 0
    """Seed of the draw; case i of a seed is always the same."""
    min_angle_deg: DeviationDeg = 80.0
    """Smallest initial deviation of the draw [deg]."""
    max_angle_deg: DeviationDeg = 180.0
    """Largest initial deviation of the draw [deg]."""
    substeps: CheckCount = 1
    """Check the zone at so many instants per time step; 1 checks at the steps only."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min_angle_deg > self.max_angle_deg:
            raise ValueError(
                f"max_angle_deg must be in [min_angle_deg = {self.min_angle_deg}, 180]; got {self.max_angle_deg}"
            )
        return self

    @property
    def is_papers_draw(self) -> bool:
        """Whether the initial deviations are those of the paper."""
        return (self.min_angle_deg, self.max_angle_deg) == (80.0, 180.0)


class MonteCarloConfig(CaseConfig):
    """Which cases are flown, under what conditions, and how they are checked."""

    shield: AnyFilter | None = None
    """Fly under this shield, or under another safety filter such as ``ZohCbfConfig``; None flies without."""
    uncertainty: UncertaintyConfig | None = None
    """Errors to fly with; None flies the model itself."""
    first: NonNegativeInt = 0
    """Index of the first case."""

    @model_validator(mode="after")
    def _countable(self) -> Self:
        if self.first > 2**31 - self.cases:
            raise ValueError(f"first must be from 0 to 2^31 - cases = {2**31 - self.cases}; got {self.first}")
        return self
