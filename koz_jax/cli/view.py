"""``koz view``: a maneuver in 3-D."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field, PositiveFloat

from koz_jax.agents.record import DEFAULT_FOR_OTHERS
from koz_jax.cli import invocation
from koz_jax.cli.exit_status import exit_status
from koz_jax.cli.flags import parsing
from koz_jax.cli.flags.flight import AGENTS, CONTROLLERS
from koz_jax.cli.flags.one_case import OneCaseFlags
from koz_jax.config.base import Settings
from koz_jax.config.spread import Urgency

if TYPE_CHECKING:
    from koz_jax.control.base import TaskController


# Who flies where nobody is named.
DEFAULT_AGENTS = ("phase1", "phase2")


class _AgentsFlags(Settings):
    """Who flies."""

    agent: tuple[str, ...] = Field(
        default=(),
        description=f"Who flies: {AGENTS}. By default those of {' and '.join(DEFAULT_AGENTS)} whose spacecraft it is.",
    )
    urgency: tuple[Urgency, ...] = Field(
        default=(),
        description="How much agents for any spacecraft hurry, from 0 (thrifty) to 1 (as fast as the torque allows):"
        f" each is shown at each of these; by default {DEFAULT_FOR_OTHERS}. Without it they fly at 0.5.",
    )
    controller: str | None = Field(
        default=None, description=f"Show this one too, on the first agent's task or the maneuver's: {CONTROLLERS}."
    )


class ViewFlags(OneCaseFlags, _AgentsFlags):
    """Show one maneuver as several agents fly it, side by side, in an HTML file that opens offline."""

    seconds: PositiveFloat | None = None
    """How much of the maneuver to show [s]; by default until soon after the last agent has settled."""
    out: Path = Path("maneuver.html")
    """The file to write."""

    @property
    def names(self) -> tuple[str, ...]:
        """Agents that fly."""
        return self.agent or ((DEFAULT_FOR_OTHERS,) if self.urgency else DEFAULT_AGENTS)

    @property
    def count(self) -> int:
        """How many fly at most."""
        return len(self.names) * max(len(self.urgency), 1) + (self.controller is not None)

    def load(self) -> list[TaskController]:
        """Load all who fly.

        Raises:
            SettingsError: there is no such agent or controller, or nobody is named who can fly the spacecraft.

        """
        from koz_jax.agents.agent import load_agent
        from koz_jax.agents.flight import in_a_hurry, load_for
        from koz_jax.control.registry import load_controller
        from koz_jax.evaluation.maneuver import unfamiliar

        flying: list[TaskController] = [load_agent(name) for name in self.names]
        own = self.own_maneuver
        if own is not None and not self.agent:
            flying = [agent for agent in flying if not unfamiliar(agent, own)]
        task = own.task if own is not None else flying[0].task
        if self.urgency:
            flying = [
                dataclasses.replace(in_a_hurry(agent, urgency), name=f"{agent.name}, urgency {urgency:g}")
                for agent in flying
                for urgency in self.urgency
            ]
        if self.controller is not None:
            flying.append(load_controller(self.controller, task))
        # Where nobody is left, the default agent is refused with a reason.
        return flying if flying or own is None else [load_for(own)]


def main(argv: Sequence[str]) -> int:
    """Fly and write.  Returns the exit status."""
    return exit_status(lambda: _view(parsing.parse(ViewFlags, argv, invocation.command("view"))))


def _view(asked: ViewFlags) -> int:
    # jax is imported only now: --help and flags that do not exist are answered at once.
    from koz_jax.evaluation.tables import describe_result
    from koz_jax.storage import files, runtime
    from koz_jax.viewer import maneuver as viewed
    from koz_jax.viewer import page

    page.check_count("agent", asked.count)
    files.check_writable("out", asked.out)
    page.plotly_library()
    runtime.configure()
    flying = asked.load()
    tasks = [asked.task(agent) for agent in flying]
    drawn = asked.scenario(tasks[0])
    maneuvers = [
        viewed.fly(agent, drawn, asked.label(agent), task=task, config=asked.config(), case=asked.case or 0)
        for agent, task in zip(flying, tasks, strict=True)
    ]
    page.write_page(asked.out, maneuvers, f"Maneuver: {asked.what}", asked.seconds)
    for maneuver in maneuvers:
        print(f"{maneuver.label}: {describe_result(maneuver.result)}")
    print(f"page: {asked.out} ({asked.out.stat().st_size / 1e6:.1f} MB; open it in a browser, no network needed)")
    return 0
