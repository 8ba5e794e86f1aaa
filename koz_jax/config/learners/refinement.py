"""Settings of refinement.  Imports no jax."""

from typing import Literal, Self

from pydantic import model_validator

from koz_jax.config.base import DeviationDeg, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, Settings


class RefineConfig(Settings):
    """Last stage: polish the policy by first-order gradients through the dynamics, over whole maneuvers."""

    iterations: NonNegativeInt = 0
    """Gradient steps; 0 leaves the stage out."""
    keep: Literal["best", "last"] = "best"
    """best: the agent with the highest reward in evaluation, which may be the one that was given; last: that of the
    last evaluation, for another trade of effort against time than the reward asks for."""
    scenarios: PositiveInt = 128
    """Maneuvers per gradient step."""
    horizon_seconds: PositiveFloat = 30.0
    """Length of each maneuver [s]."""
    optimizer: Literal["adam", "muon"] = "adam"
    """adam: every weight by itself; muon: the matrices by orthogonalised steps, of which a wide network needs fewer."""
    learning_rate: PositiveFloat = 1e-3
    """Learning rate at the start; it falls to zero along a cosine."""
    max_gradient_norm: PositiveFloat = 0.03
    """Larger gradients are scaled down to this norm.  Nearly all are: a maneuver that hesitates in front of the zone
    has a huge gradient, which must not outvote the others."""
    max_maneuver_gradient: NonNegativeFloat = 0.0
    """The same for each maneuver by itself, so that all have a say; one that is not finite is left out.  0 does not."""
    violator_weight: PositiveFloat = 1.0
    """Factor on that bound for a maneuver that enters a zone: how much more say it has than another."""
    state_gradient: tuple[PositiveFloat, PositiveFloat] | None = None
    """Bound on the gradient that passes back from step to step, at the first iteration and from a quarter of them on: a
    policy that chatters has useful gradients over few steps only.  None sets no bound."""
    min_angle_deg: DeviationDeg = 30.0
    """Smallest initial deviation [deg]."""
    max_angle_deg: DeviationDeg = 180.0
    """Largest initial deviation [deg]."""
    pointing_scales_deg: tuple[PositiveFloat, ...] = (0.1, 3.0, 50.0)
    """Scales of the pointing cost, sum of weight tanh(phi / scale) [deg]."""
    pointing_weights: tuple[NonNegativeFloat, ...] = (4.0, 6.0, 1.0)
    """Weight of each scale of the pointing cost, per step."""
    effort_weight: NonNegativeFloat = 5.0
    """Cost per step of the squared action: trades effort against time."""
    urgency_factor: PositiveFloat = 1.0
    """Factor on that weight at urgency 0, and its inverse at urgency 1; 1 trains one trade only."""
    change_weight: NonNegativeFloat = 0.0
    """Cost per step of the squared change of the action: makes torques smooth."""
    rate_weight: NonNegativeFloat = 0.0
    """Cost per step of a rate at its limit."""
    zone_weight: NonNegativeFloat = 2.0
    """Weight of the zone penalty."""
    zone_tightening_deg: NonNegativeFloat = 1.0
    """How much wider than it is the penalty sees the zone [deg]."""
    zone_steepness: PositiveFloat = 2.0
    """Factor on alpha, the decay of the zone penalty."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.min_angle_deg > self.max_angle_deg:
            raise ValueError(
                f"min_angle_deg must be at most max_angle_deg; got {self.min_angle_deg} and {self.max_angle_deg}"
            )
        if self.violator_weight != 1.0 and not self.max_maneuver_gradient:
            raise ValueError(
                f"violator_weight: needs max_maneuver_gradient above 0; got {self.violator_weight} without"
            )
        if len(self.pointing_scales_deg) != len(self.pointing_weights):
            raise ValueError(
                "pointing_scales_deg and pointing_weights must have the same length; got"
                f" {self.pointing_scales_deg} and {self.pointing_weights}"
            )
        return self
