"""Flags that commands share which fly cases: who flies, which cases, under what conditions.  Imports no jax.

Names, units, defaults and help come from the settings that the flags fill in.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from koz_jax.agents.record import DEFAULT_AGENT, DEFAULT_FOR_OTHERS, shipped_agents
from koz_jax.cli.flags import parsing
from koz_jax.cli.flags.parsing import ChangesOf, agents_own, same_as
from koz_jax.config.base import MarginDeg, NonNegativeFloat, Settings, ZoneCount
from koz_jax.config.filters import FilterConfig, FilterName, ZohCbfConfig
from koz_jax.config.monte_carlo import CaseConfig, MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.spread import Urgency
from koz_jax.config.task import ScenarioConfig, TaskConfig
from koz_jax.config.uncertainty import CERTAIN, UncertaintyConfig
from koz_jax.control.registry import ADVERSARIAL, CLASSICAL, LEARNED

if TYPE_CHECKING:
    from koz_jax.control.base import TaskController

AGENTS = f"shipped agents by name ({', '.join(shipped_agents())}), folders of runs or of agents, or SAC zips of SB3"
AGENT = (
    f"a shipped agent by name ({', '.join(shipped_agents())}), the folder of a run or of an agent, or a SAC zip of"
    " Stable-Baselines3"
)
URGENCY = (
    "How much an agent for any spacecraft hurries, from 0 (thrifty) to 1 (as fast as the torque allows); by default"
    " 0.5."
)
CONTROLLERS = (
    f"{', '.join((*CLASSICAL, *LEARNED))}; one that does its worst: {', '.join(ADVERSARIAL)}; or"
    " path/to/file.py:CLASS, a class of your own"
)


class AgentFlags(Settings):
    """Who flies."""

    agent: str | None = Field(
        default=None,
        description=f"Who flies: {AGENT}. By default {DEFAULT_AGENT}; for another spacecraft or an urgency,"
        f" {DEFAULT_FOR_OTHERS}.",
    )
    controller: str | None = Field(
        default=None, description=f"Fly this on the agent's task in place of the agent: {CONTROLLERS}."
    )
    urgency: Urgency | None = Field(default=None, description=URGENCY)

    @property
    def name(self) -> str:
        """Name of the agent: the one that is asked for, whatever it is to fly; else the default."""
        if self.agent is not None:
            return self.agent
        return DEFAULT_AGENT if self.urgency is None else DEFAULT_FOR_OTHERS

    def load(self) -> TaskController:
        """Load who flies.

        Raises:
            SettingsError: there is no such agent or controller, or it does not listen to the urgency.

        """
        from koz_jax.agents.agent import load_agent
        from koz_jax.agents.flight import in_a_hurry
        from koz_jax.control.registry import load_controller

        flying = load_agent(self.name)
        if self.controller is not None:
            flying = load_controller(self.controller, flying.task)
        return flying if self.urgency is None else in_a_hurry(flying, self.urgency)


class _RuleFlags(Settings):
    """How the task is drawn and judged, and whether it is shielded."""

    task_changes: Annotated[dict[str, Any], ChangesOf(TaskConfig)] = Field(
        default={},
        alias="task",
        description="Fly another task: what is given here takes the place of what the agent was made for.",
    )
    infeasible_zone: Literal["resample", "shrink"] | None = agents_own(ScenarioConfig, "infeasible_zone")
    zones: ZoneCount | None = None
    """Number of zones of every case; by default the agent's."""
    max_rate_deg: NonNegativeFloat | None = agents_own(ScenarioConfig, "max_rate_deg")
    angle_convention: Literal["full", "half"] | None = agents_own(TaskConfig, "angle_convention")
    shield: bool = False
    """Fly under the shield, which keeps the boresight out of every zone whatever the controller asks for."""
    filter: FilterName | None = None
    """Fly under a safety filter by its name: shield, the same as --shield, or zoh_cbf, the control-barrier-function
    filter of Breeden & Panagou."""
    shield_margin_deg: MarginDeg = same_as(ShieldConfig, "margin_deg")
    robust: bool = False
    """Make the shield withstand the errors that are flown with, which the flags of errors set."""


class FlightFlags(UncertaintyConfig, _RuleFlags, CaseConfig):
    """Which cases are flown, and how."""

    @model_validator(mode="after")
    def _of_the_shield(self) -> Self:
        if self.shield and self.filter is not None:
            raise ValueError(f"filter: give either --shield or --filter, got --filter {self.filter} and --shield")
        if self._filter_name != "shield":
            if self.robust:
                raise ValueError("robust: is of the shield, and needs --shield")
            if self.shield_margin_deg != ShieldConfig().margin_deg:
                raise ValueError(f"shield_margin_deg: needs --shield, got {self.shield_margin_deg} without it")
        if self.robust and self.uncertainty == CERTAIN:
            raise ValueError("robust: needs an error to withstand, such as --inertia-error 0.1")
        return self

    @property
    def uncertainty(self) -> UncertaintyConfig:
        """Errors to fly with."""
        return UncertaintyConfig(**self.model_dump(include={*UncertaintyConfig.model_fields}))

    @property
    def _filter_name(self) -> FilterName | None:
        """What to fly under, by either flag."""
        return "shield" if self.shield else self.filter

    @property
    def filter_config(self) -> FilterConfig | None:
        """The shield or other filter to fly under, if one is asked for."""
        if self._filter_name is None:
            return None
        if self._filter_name == "zoh_cbf":
            return ZohCbfConfig()
        return ShieldConfig(
            margin_deg=self.shield_margin_deg, error_bounds=self.uncertainty if self.robust else CERTAIN
        )

    def config(self) -> MonteCarloConfig:
        """Which cases are flown, and how."""
        return MonteCarloConfig(
            **self.model_dump(include={*CaseConfig.model_fields}),
            shield=self.filter_config,
            uncertainty=None if self.uncertainty == CERTAIN else self.uncertainty,
        )

    def task(self, agent: TaskController) -> TaskConfig:
        """What is flown: the task that a controller was made for, with the changes that the flags ask for.

        Raises:
            SettingsError: a change is not allowed, or the shield has no torque for what it is to withstand.

        """
        return self.changed(agent.task)

    def changed(self, task: TaskConfig) -> TaskConfig:
        """A task with the changes that the flags ask for.

        Raises:
            SettingsError: as of ``task``.

        """
        changed = parsing.applied("task", task, self.task_changes)
        task = changed.with_rules(self.angle_convention, self.infeasible_zone, self.zones, self.max_rate_deg)
        if self.filter_config is not None:
            self.filter_config.check(task.spacecraft.brake_limits)
        return task

    def label(self, agent: TaskController) -> str:
        """Who flies, for tables and titles."""
        return agent.name if self._filter_name is None else f"{agent.name} + {self._filter_name}"
