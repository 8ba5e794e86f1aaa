"""Flags that commands share which fly cases: who flies, which cases, under what conditions.  Imports no jax."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Literal

from koz_jax.errors import UserError
from koz_jax.shield_config import CERTAIN, ShieldConfig, UncertaintyConfig

if TYPE_CHECKING:
    from koz_jax.controllers.base import Pilot
    from koz_jax.evaluation import MonteCarloConfig
    from koz_jax.task_config import TaskConfig


@dataclasses.dataclass(frozen=True)
class FlightArgs:
    """Fly random cases."""

    agent: str = "phase2"
    """A shipped agent by name (phase1, phase2, phase2-sac, zones3), the folder of a run or of an agent, or a
    Stable-Baselines3 SAC zip."""
    controller: str | None = None
    """Fly this on the agent's task in place of the agent: pd, potential, sliding, planner; or one that does its worst:
    random, bang_bang, adversary, spin_up."""
    cases: int = 10_000
    """Number of cases of the draw."""
    seed: int = 0
    """Seed of the draw; case i of a seed is always the same."""
    min_angle_deg: float = 80.0
    """Smallest initial deviation of the draw [deg]."""
    max_angle_deg: float = 180.0
    """Largest initial deviation of the draw [deg]."""
    infeasible_zone: Literal["resample", "shrink"] | None = None
    """Where a zone of the draw would hold start or target: draw again, or make it smaller; by default the agent's."""
    zones: int | None = None
    """Number of zones of every case; by default the agent's."""
    max_rate_deg: float | None = None
    """Initial rates are uniform in plus or minus this, per axis [deg/s]; by default the agent's."""
    angle_convention: Literal["full", "half"] | None = None
    """phi is the full rotation angle or half of it (the paper's literal equation); by default the agent's."""
    shield: bool = False
    """Fly under the shield, which keeps the boresight out of every zone whatever the controller asks for."""
    shield_margin_deg: float = 0.1
    """Angle that the shield keeps from every zone [deg]."""
    robust: bool = False
    """Make the shield withstand the errors that the next four flags set."""
    inertia_error: float = 0.0
    """The true inertia is off by this share."""
    disturbance_torque: float = 0.0
    """A constant torque from outside, of this size and random direction [N m]."""
    attitude_noise_deg: float = 0.0
    """Standard deviation per axis of the measured attitude [deg]."""
    rate_noise_deg: float = 0.0
    """Standard deviation per axis of the measured rate [deg/s]."""

    @property
    def uncertainty(self) -> UncertaintyConfig | None:
        """Errors to fly with, if any are asked for."""
        names = UncertaintyConfig.model_fields
        if not any(getattr(self, name) for name in names):
            return None
        return UncertaintyConfig(**{name: getattr(self, name) for name in names})

    @property
    def shield_config(self) -> ShieldConfig | None:
        """The shield to fly under, if one is asked for."""
        if not self.shield:
            return None
        withstands = (self.uncertainty if self.robust else None) or CERTAIN
        return ShieldConfig(margin_deg=self.shield_margin_deg, withstands=withstands)

    def config(self, substeps: int = 1) -> MonteCarloConfig:
        """Which cases are flown, and how.

        Raises:
            UserError, pydantic.ValidationError: a flag is not allowed, or does nothing without another.

        """
        from koz_jax.evaluation import MonteCarloConfig

        if not self.shield:
            if self.robust:
                raise UserError("robust: is of the shield, and needs --shield")
            if self.shield_margin_deg != FlightArgs.shield_margin_deg:
                raise UserError(f"shield_margin_deg: needs --shield, got {self.shield_margin_deg} without it")
        if self.robust and self.uncertainty is None:
            raise UserError("robust: needs an error to withstand, such as --inertia-error 0.1")
        return MonteCarloConfig(
            cases=self.cases,
            seed=self.seed,
            min_angle_deg=self.min_angle_deg,
            max_angle_deg=self.max_angle_deg,
            substeps=substeps,
            shield=self.shield_config,
            uncertainty=self.uncertainty,
        )

    def pilot(self) -> Pilot:
        """Load who flies."""
        from koz_jax.agent import load_agent
        from koz_jax.controllers.registry import load_controller

        agent = load_agent(self.agent)
        return load_controller(self.controller, agent.task) if self.controller is not None else agent

    def task(self, pilot: Pilot) -> TaskConfig:
        """What is flown: the task that the pilot was made for, with the changes that the flags ask for."""
        task = pilot.task.with_rules(self.angle_convention, self.infeasible_zone, self.zones, self.max_rate_deg)
        if self.shield_config is not None:
            self.shield_config.check(task.spacecraft.torque_limit)
        return task

    @property
    def name(self) -> str:
        """Who flies, for tables and titles."""
        flown = self.controller or self.agent
        return f"{flown} + shield" if self.shield else flown
