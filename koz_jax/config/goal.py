"""What an agent must reach for a run to end early.  Imports no jax."""

from typing import Literal, Self

from pydantic import model_validator

from koz_jax.config.base import PositiveFloat, Settings


class GoalConfig(Settings):
    """A bound on the outcome of an evaluation: a share to reach, or a mean over the settled cases to stay within."""

    quantity: Literal["success", "settling", "effort"]
    """success: share of the cases that settle and keep the zone [%]; settling: time [s]; effort: [N2 m2 s]."""
    bound: PositiveFloat
    """Least success, or largest settling time or effort."""

    @model_validator(mode="after")
    def _can_be_reached(self) -> Self:
        if self.quantity == "success" and self.bound > 100.0:
            raise ValueError(f"success must be at most 100; got {self.bound}")
        return self

    def __str__(self) -> str:
        """As it is typed."""
        return f"{self.quantity}={self.bound:g}"

    def is_met(self, success_rate: float, settling_time: float, control_effort: float) -> bool:
        """Whether an evaluation reaches it; what is not a number does not.

        success_rate: share in [0, 1]; settling_time: mean [s]; control_effort: mean [N2 m2 s].
        """
        if self.quantity == "success":
            return 100.0 * success_rate >= self.bound
        return (settling_time if self.quantity == "settling" else control_effort) <= self.bound
