"""``koz fly``: fly one maneuver and draw it."""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

from pydantic import Field, model_validator

from koz_jax.agents.record import DEFAULT_AGENT, DEFAULT_FOR_OTHERS, find_agent, read_agent_record
from koz_jax.cli import invocation
from koz_jax.cli.exit_status import exit_status
from koz_jax.cli.flags import parsing
from koz_jax.cli.flags.flight import AGENT, CONTROLLERS, URGENCY
from koz_jax.cli.flags.one_case import OneCaseFlags
from koz_jax.cli.flags.turn import TurnFlags
from koz_jax.config.maneuvers.maneuver import ManeuverConfig
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.spread import Urgency

if TYPE_CHECKING:
    from koz_jax.config.task import TaskConfig
    from koz_jax.control.base import TaskController


class FlyFlags(TurnFlags, OneCaseFlags):
    """Fly one maneuver with a trained agent or another controller; draw the boresight's trace on the sphere and the
    time histories.
    """

    agent: str | None = Field(
        default=None,
        description=f"Who flies: {AGENT}. By default {DEFAULT_AGENT}; for another spacecraft, the one for any.",
    )
    urgency: Urgency | None = Field(default=None, description=URGENCY)
    controller: str | None = Field(
        default=None, description=f"Fly this on the agent's task, or the maneuver's, in its place: {CONTROLLERS}."
    )
    scenario_name: Literal["paper"] | None = parsing.named("scenario", "The paper's test scenario, as without --case.")
    out: Path = Path("figures")
    """Folder for sphere.png, histories.png (and .pdf of both) and history.csv; files of these names are replaced."""
    gif: bool = False
    """Also write the maneuver as a short moving picture, maneuver.gif."""
    json_file: Path | None = parsing.named("json", "Also write the result as JSON into this file.")

    @model_validator(mode="after")
    def _one_scenario(self) -> Self:
        if self.scenario_name is not None and self.case is not None:
            raise ValueError(f"scenario: give either --scenario {self.scenario_name} or --case, got both")
        if self.start is not None and (self.file or self.maneuver) is not None:
            raise ValueError(
                f"from: give either a maneuver file or --from, got {self.file or self.maneuver} and --from"
            )
        if self.scenario_name is not None and self.own_maneuver is not None:
            raise ValueError(f"scenario: give either --scenario {self.scenario_name} or a maneuver, got both")
        return self

    @functools.cached_property
    def own_maneuver(self) -> ManeuverConfig | None:
        """The maneuver of one's own that is flown: of a file, or of the flags.

        Raises:
            SettingsError: it cannot be read or flown.

        """
        described = self.start is not None and self.target is not None
        return self.turn(self._agents_task) if described else super().own_maneuver

    @property
    def _agents_task(self) -> TaskConfig:
        """What the agent was made for."""
        from koz_jax.agents.sb3 import is_sb3

        name = self.agent or DEFAULT_AGENT
        if is_sb3(name):
            from koz_jax.agents.agent import load_agent

            return load_agent(name).task
        return read_agent_record(find_agent(name)).task

    def config(self) -> MonteCarloConfig:
        """How it is flown; what is reported as JSON is checked as closely as maneuvers of one's own are."""
        from koz_jax.evaluation.maneuver import SUBSTEPS

        asked = super().config()
        return asked.model_copy(update={"substeps": max(SUBSTEPS, asked.substeps)}) if self.json_file else asked

    def load(self) -> TaskController:
        """Load who flies.

        Raises:
            SettingsError: there is no such agent or controller, or nobody is named who can fly the spacecraft.

        """
        from koz_jax.agents.agent import load_agent
        from koz_jax.agents.flight import in_a_hurry, load_for
        from koz_jax.control.registry import load_controller

        own = self.own_maneuver
        if self.controller is not None:
            task = load_agent(self.agent or DEFAULT_AGENT).task if own is None else own.task
            flying = load_controller(self.controller, task)
        elif own is not None:
            return load_for(own, self.agent and load_agent(self.agent), self.urgency)
        else:
            default = DEFAULT_AGENT if self.urgency is None else DEFAULT_FOR_OTHERS
            flying = load_agent(self.agent or default)
        return flying if self.urgency is None else in_a_hurry(flying, self.urgency)


def main(argv: Sequence[str]) -> int:
    """Fly and draw.  Returns the exit status."""
    return exit_status(lambda: _fly(parsing.parse(FlyFlags, argv, invocation.command("fly"))))


def _fly(asked: FlyFlags) -> int:
    # jax and matplotlib are imported only now: --help and flags that do not exist are answered at once.
    from koz_jax.evaluation import maneuver as maneuvers
    from koz_jax.evaluation import tables
    from koz_jax.figures import animation, histories, sphere, style, wording
    from koz_jax.storage import files, runtime

    runtime.configure()
    agent = asked.load()
    task = asked.task(agent)
    drawn = asked.scenario(task)
    files.make_folder("out", asked.out)
    if asked.json_file is not None:
        files.check_writable("json", asked.json_file)
    flown = maneuvers.fly_closely(agent, drawn, task, asked.config(), asked.case or 0)
    history, result = flown.history, flown.result
    print(f"{asked.what}: {tables.describe_result(result)}")
    if asked.own_maneuver is not None:
        print(maneuvers.describe(asked.own_maneuver, flown))
    title = f"{wording.short_name(asked.label(agent))}: {asked.what}"
    written = [asked.out / "history.csv"]
    files.write_text(written[0], tables.history_csv(history, task))
    if asked.json_file is not None:
        files.write_text(asked.json_file, json.dumps(flown.report(), indent=2) + "\n")
        written.append(asked.json_file)
    written += style.save(sphere.draw(history, task, title), asked.out, "sphere")
    written += style.save(histories.draw(history, result, task, title), asked.out, "histories")
    if asked.gif:
        written.append(animation.write(asked.out / "maneuver.gif", history, result, task, title))
    for path in written:
        print(f"written: {path}")
    return 0
