"""``koz fly``: fly one maneuver and draw it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Self

from pydantic import model_validator

from koz_jax.cli import invocation
from koz_jax.cli.exit_status import exit_status
from koz_jax.cli.flags import parsing
from koz_jax.cli.flags.flight import AgentFlags
from koz_jax.cli.flags.one_case import OneCaseFlags


class FlyFlags(OneCaseFlags, AgentFlags):
    """Fly one maneuver with a trained agent or another controller; draw the boresight's trace on the sphere and the
    time histories.
    """

    scenario_name: Literal["paper"] | None = parsing.named("scenario", "The paper's test scenario, as without --case.")
    out: Path = Path("figures")
    """Folder for sphere.png, histories.png (and .pdf of both) and history.csv; files of these names are replaced."""
    gif: bool = False
    """Also write the maneuver as a short moving picture, maneuver.gif."""

    @model_validator(mode="after")
    def _one_scenario(self) -> Self:
        if self.scenario_name is not None and self.case is not None:
            raise ValueError(f"scenario: give either --scenario {self.scenario_name} or --case, got both")
        return self


def main(argv: Sequence[str]) -> int:
    """Fly and draw.  Returns the exit status."""
    return exit_status(lambda: _fly(parsing.parse(FlyFlags, argv, invocation.command("fly"))))


def _fly(asked: FlyFlags) -> int:
    # jax and matplotlib are imported only now: --help and flags that do not exist are answered at once.
    from koz_jax.evaluation import cases, tables
    from koz_jax.figures import animation, histories, sphere, style
    from koz_jax.storage import files, runtime

    runtime.configure()
    agent = asked.load()
    task = asked.task(agent)
    drawn = asked.scenario(task)
    files.make_folder("out", asked.out)
    history, result = cases.fly_scenario(agent, drawn, task, asked.config(), asked.case or 0)
    print(f"{asked.what}: {tables.describe_result(result)}")
    title = f"{style.short_name(asked.label(agent))}: {asked.what}"
    files.write_text(asked.out / "history.csv", tables.history_csv(history, task))
    written = [
        asked.out / "history.csv",
        *style.save(sphere.draw(history, task, title), asked.out, "sphere"),
        *style.save(histories.draw(history, result, task, title), asked.out, "histories"),
    ]
    if asked.gif:
        written.append(animation.write(asked.out / "maneuver.gif", history, result, task, title))
    for path in written:
        print(f"written: {path}")
    return 0
