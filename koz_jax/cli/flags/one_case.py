"""Flags of commands that fly a single maneuver: the paper's scenario, or a case of the draw.  Imports no jax."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

from pydantic import model_validator

from koz_jax.cli.flags.flight import FlightFlags
from koz_jax.config.monte_carlo import CaseConfig

if TYPE_CHECKING:
    from koz_jax.config.task import TaskConfig
    from koz_jax.task.scenario import Scenario

# Settings that only a case of the draw depends on.
_DRAW = ({*CaseConfig.model_fields} - {"substeps"}) | {"infeasible_zone", "zones", "max_rate_deg"}


class OneCaseFlags(FlightFlags):
    """Which maneuver is flown."""

    case: int | None = None
    """A case of the draw, by its index: the same as in an evaluation; by default the paper's test scenario."""

    @model_validator(mode="after")
    def _of_the_draw(self) -> Self:
        if self.case is None:
            for name, field in type(self).model_fields.items():
                if name in _DRAW and getattr(self, name) != field.default:
                    raise ValueError(f"{name}: is of the draw, and needs --case; the paper's scenario has no draw")
        elif not 0 <= self.case < self.cases:
            raise ValueError(f"case: must be from 0 to cases - 1 = {self.cases - 1}, got {self.case}")
        return self

    @property
    def what(self) -> str:
        """What is flown, for titles."""
        return "the paper's test scenario" if self.case is None else f"case {self.case} of seed {self.seed}"

    def scenario(self, task: TaskConfig) -> Scenario:
        """Draw what is flown.

        Raises:
            SettingsError: no zone fits between start and target.

        """
        from koz_jax.evaluation import cases
        from koz_jax.task import scenario

        return scenario.paper_test() if self.case is None else cases.draw_case(task, self.config(), self.case)
