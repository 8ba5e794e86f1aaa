"""Flags of commands that fly one maneuver: from a file, the paper's, or a case of the draw.  Imports no jax."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

import tyro
from pydantic import model_validator

from koz_jax.cli.flags.flight import FlightFlags
from koz_jax.config.maneuvers.maneuver import ManeuverConfig
from koz_jax.config.maneuvers.maneuver_file import load_maneuver
from koz_jax.config.monte_carlo import CaseConfig, MonteCarloConfig
from koz_jax.config.uncertainty import CERTAIN, UncertaintyConfig

if TYPE_CHECKING:
    from koz_jax.config.task import TaskConfig
    from koz_jax.control.base import TaskController
    from koz_jax.task.scenario import Scenario

# Settings that only a case of the draw depends on.
_DRAW = ({*CaseConfig.model_fields} - {"substeps"}) | {"infeasible_zone", "zones", "max_rate_deg"}


class OneCaseFlags(FlightFlags):
    """Which maneuver is flown."""

    file: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[FILE]")] = None
    """A maneuver file (TOML) to fly; by default the paper's test scenario is flown."""
    maneuver: Path | None = None
    """The maneuver file, as a flag."""
    case: int | None = None
    """A case of the draw, by its index: the same as in an evaluation; by default the paper's test scenario."""

    @model_validator(mode="after")
    def _of_the_draw(self) -> Self:
        if self.file is not None and self.maneuver is not None:
            raise ValueError(f"maneuver: give one file, got {self.file} and --maneuver {self.maneuver}")
        if self.own_maneuver is not None and self.task_changes:
            raise ValueError("task: a maneuver of one's own says what flies, and has no --task settings beside it")
        if self.case is None and "scenario" in self.task_changes:
            raise ValueError("task.scenario: is of the draw, and needs --case; a given maneuver has no draw")
        if self.case is None:
            what = "the paper's scenario" if self.own_maneuver is None else "a maneuver of one's own"
            # A seed is also of the errors that are met in flight.
            of_the_draw = _DRAW - (set() if self.own_maneuver is None else {"seed"})
            for name, field in type(self).model_fields.items():
                if name in of_the_draw and getattr(self, name) != field.default:
                    raise ValueError(f"{name}: is of the draw, and needs --case; {what} has no draw")
        elif self.own_maneuver is not None:
            raise ValueError(f"case: is of the draw; give either --case or a maneuver, got {self.case} and one")
        elif not 0 <= self.case < self.cases:
            raise ValueError(f"case: must be from 0 to cases - 1 = {self.cases - 1}, got {self.case}")
        return self

    @functools.cached_property
    def own_maneuver(self) -> ManeuverConfig | None:
        """The maneuver of one's own that is flown, if one is given.

        Raises:
            SettingsError: it cannot be read or flown.

        """
        path = self.file or self.maneuver
        return None if path is None else load_maneuver(path)

    @property
    def uncertainty(self) -> UncertaintyConfig:
        """Errors to fly with: those of the flags, or of the maneuver."""
        own = super().uncertainty
        if self.own_maneuver is None or not self.own_maneuver.has_errors:
            return own
        if own != CERTAIN:
            raise ValueError("errors: the maneuver file has its own, which flags do not change")
        return self.own_maneuver.errors.uncertainty

    def config(self) -> MonteCarloConfig:
        """Which cases are flown, and how; constraints of a maneuver of one's own are checked more closely."""
        from koz_jax.evaluation.maneuver import config_of

        asked = super().config()
        return asked if self.own_maneuver is None else config_of(self.own_maneuver, asked)

    def task(self, agent: TaskController) -> TaskConfig:
        """What is flown: as of all flights, or what the maneuver of one's own says.

        Raises:
            SettingsError: the shield has no torque for what it is to withstand.

        """
        if self.own_maneuver is None:
            return super().task(agent)
        task = self.own_maneuver.task.with_rules(self.angle_convention)
        if self.filter_config is not None:
            self.filter_config.check(task.spacecraft.brake_limits)
        return task

    @property
    def what(self) -> str:
        """What is flown, for titles."""
        if self.own_maneuver is not None:
            return self.own_maneuver.name
        return "the paper's test scenario" if self.case is None else f"case {self.case} of seed {self.seed}"

    def scenario(self, task: TaskConfig) -> Scenario:
        """Draw what is flown.

        Raises:
            SettingsError: no zone fits between start and target.

        """
        from koz_jax.evaluation import cases
        from koz_jax.evaluation import maneuver as maneuvers
        from koz_jax.task import scenario

        if self.own_maneuver is not None:
            return maneuvers.scenario(self.own_maneuver)
        return scenario.paper_test() if self.case is None else cases.draw_case(task, self.config(), self.case)
