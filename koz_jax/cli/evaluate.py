"""``koz evaluate``: judge a controller by Monte Carlo."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from koz_jax.agents.record import DEFAULT_FOR_OTHERS
from koz_jax.cli import invocation
from koz_jax.cli.exit_status import exit_status
from koz_jax.cli.flags import parsing
from koz_jax.cli.flags.flight import AgentFlags, FlightFlags
from koz_jax.cli.flags.process import ProcessFlags
from koz_jax.cli.flags.suite import SUITE, SuiteFlags
from koz_jax.config.maneuvers.maneuver_file import SpacecraftFile, load_spacecraft
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import TaskConfig
from koz_jax.errors import SettingsError

if TYPE_CHECKING:
    from koz_jax.agents.suite import SuiteFlight
    from koz_jax.control.base import TaskController
    from koz_jax.evaluation.monte_carlo import MonteCarlo
    from koz_jax.evaluation.rollout import History

_log = logging.getLogger(__name__)

# Another spacecraft in every case.
_ANY_SPACECRAFT = TaskConfig(spread=SpreadConfig(spacecraft=True))


class EvaluateFlags(ProcessFlags, FlightFlags, AgentFlags):
    """Fly a trained agent, or another controller, over many random cases; print the paper's table beside its own.

    With --suite [FOLDER], fly everybody over published maneuvers instead: see --suite --help.
    """

    spacecraft: str | None = None
    """Fly another spacecraft than the agent's in the paper's draw, times in its own units: a TOML file with a table
    [spacecraft] and step_seconds, such as a maneuver file; or "random", another one in every case."""
    json_file: Path | None = parsing.named("json", "Write the results as JSON.")
    csv: Path | None = None
    """Write a row per case."""
    partial: Path | None = None
    """Keep finished blocks of cases in this folder; the same command goes on from them when it was interrupted.
    Several processes need one, in which each puts its share of the blocks."""
    figures: Path | None = None
    """Draw the Monte Carlo figures into this folder, as PNG and PDF (needs the extra viz)."""
    replay_case: int | None = None
    """Fly only this case of the draw, and write its history."""
    history: Path | None = None
    """File for --replay-case; by default case-I.csv."""

    @property
    def name(self) -> str:
        """Name of the agent; for another spacecraft, the default is the one that is for any."""
        return DEFAULT_FOR_OTHERS if self.agent is None and self.spacecraft is not None else super().name

    def task(self, agent: TaskController) -> TaskConfig:
        """What is flown: the agent's task, or the paper's draw for another spacecraft, with the changes of the flags.

        Raises:
            SettingsError: the file cannot be read, or a change is not allowed.

        """
        if self.spacecraft is None:
            return super().task(agent)
        if self.spacecraft == "random":
            return super().changed(_ANY_SPACECRAFT)
        described = load_spacecraft(self.spacecraft)
        if self.process == 0:
            _tell_of_the_draw(self.spacecraft, described)
        return super().changed(described.task)


def _tell_of_the_draw(path: str, described: SpacecraftFile) -> None:
    """Log a warning of what a file has and a draw does not fly."""
    left_out = []
    if len(described.instruments) > 1:
        left_out.append("other instruments")
    if described.constraints:
        left_out.append(f"{len(described.constraints)} constraints")
    if left_out:
        drawn_for = f" for its first instrument, {described.instruments[0].name!r}" if described.instruments else ""
        _log.warning(
            "spacecraft: zones are drawn at random%s; %s of %s are not flown (%s does)",
            *(drawn_for, " and ".join(left_out), path, invocation.command("fly")),
        )


def main(argv: Sequence[str]) -> int:
    """Evaluate and print.  Returns the exit status."""
    if SUITE in argv:
        others = [argument for argument in argv if argument != SUITE]
        return exit_status(lambda: _suite(parsing.parse(SuiteFlags, others, invocation.command(f"evaluate {SUITE}"))))
    return exit_status(lambda: _evaluate(parsing.parse(EvaluateFlags, argv, invocation.command("evaluate"))))


def _evaluate(asked: EvaluateFlags) -> int:
    # jax is imported only now: --help and flags that do not exist are answered at once.
    from koz_jax.storage import processes, runtime

    if asked.replay_case is not None and asked.coordinator is not None:
        raise SettingsError(f"replay_case: is flown by one process, got {asked.replay_case} with --coordinator")
    runtime.configure()
    asked.join()
    agent, task = processes.all_or_none(lambda: _prepare(asked))
    if asked.replay_case is not None:
        _fly_case(agent, task, asked, asked.replay_case)
    else:
        _monte_carlo(agent, task, asked)
    return 0


def _prepare(asked: EvaluateFlags) -> tuple[TaskController, TaskConfig]:
    """Load who flies, and refuse what cannot be flown or written."""
    from koz_jax.config.task import check_feasible

    agent = asked.load()
    task = asked.task(agent)
    check_feasible(task, asked.max_angle_deg)
    _check_outputs(asked)  # last, since it makes a folder
    return agent, task


def _history_path(asked: EvaluateFlags) -> Path:
    return asked.history or Path(f"case-{asked.replay_case}.csv")


def _check_outputs(asked: EvaluateFlags) -> None:
    """Refuse files that cannot be written, or that the rest of the command line leaves empty."""
    from koz_jax.storage import files

    outputs = {"json": asked.json_file, "csv": asked.csv}
    if asked.replay_case is None:
        if asked.history is not None:
            raise SettingsError(f"history: is written by --replay-case only, got {asked.history} without it")
    else:
        _check_one_case(asked, asked.replay_case, {**outputs, "partial": asked.partial})
        outputs["history"] = _history_path(asked)
    for name, path in outputs.items():
        if path is not None:
            files.check_writable(name, path)
    if asked.figures is not None:
        from koz_jax.figures import style  # noqa: F401  without matplotlib, say so before the flight

        files.make_folder("figures", asked.figures)


def _check_one_case(asked: EvaluateFlags, case: int, outputs: dict[str, Path | None]) -> None:
    """Refuse, with a single case, what is of many."""
    for name, path in outputs.items():
        if path is not None:
            raise SettingsError(f"{name}: is not written with --replay-case, which writes --history; got {path}")
    if asked.figures is not None:
        raise SettingsError(
            f"figures: are of many cases, and not drawn with --replay-case; got {asked.figures}. One case is drawn by"
            f" {invocation.command('fly')} --case {case} --seed {asked.seed}"
        )
    if not 0 <= case < asked.cases:
        raise SettingsError(f"replay_case: must be from 0 to cases - 1 = {asked.cases - 1}, got {case}")


def _fly_case(agent: TaskController, task: TaskConfig, asked: EvaluateFlags, case: int) -> None:
    from koz_jax.evaluation import cases, tables
    from koz_jax.storage import files

    history, result = cases.fly_case(agent, case, asked.config(), task)
    path = _history_path(asked)
    files.write_text(path, tables.history_csv(history, task))
    print(tables.describe_case(case, result))
    print(f"history: {path}")


def _monte_carlo(agent: TaskController, task: TaskConfig, asked: EvaluateFlags) -> None:
    from koz_jax.evaluation import monte_carlo
    from koz_jax.storage import processes

    flown = monte_carlo.run_cases(agent, task, asked.config(), partial=asked.partial)
    # The others wait for the first, which reports.
    label = asked.label(agent)
    processes.all_or_none(lambda: None if asked.process > 0 else _report(flown, task, label, asked))


def _report(flown: MonteCarlo, task: TaskConfig, label: str, asked: EvaluateFlags) -> None:
    from koz_jax.evaluation import monte_carlo, tables
    from koz_jax.evaluation.summary import summarise, table
    from koz_jax.storage import files

    summary = summarise(flown.results)
    print(table(flown))
    print(f"compiled in {flown.compile_s:.1f} s, flown in {flown.wall_s:.1f} s")
    if asked.json_file:
        files.write_json(asked.json_file, monte_carlo.report(flown, summary))
    if asked.csv:
        files.write_text(asked.csv, tables.cases_csv(flown.results))
    if asked.figures:
        from koz_jax.figures import monte_carlo as drawn
        from koz_jax.figures import wording

        title = f"{wording.short_name(label)}: {asked.cases} random cases, seed {asked.seed}"
        for path in drawn.write(asked.figures, flown.results, task, title):
            print(f"figure: {path}")


def _suite(asked: SuiteFlags) -> int:
    from koz_jax.agents import suite
    from koz_jax.storage import files, runtime

    if asked.figures is not None:
        from koz_jax.figures import style  # noqa: F401  without matplotlib, say so before the flight

        files.make_folder("figures", asked.figures)
    for name, path in (("json", asked.json_file), ("markdown", asked.markdown)):
        if path is not None:
            files.check_writable(name, path)
    runtime.configure()
    maneuvers = suite.load_suite(asked.folder)
    lines = [_row(suite.COLUMNS), _row(["---"] * len(suite.COLUMNS))]
    print("\n".join(lines), flush=True)
    flights: list[SuiteFlight] = []
    for flight in suite.fly_suite(maneuvers, asked.controllers, asked.under, asked.draw):
        flights.append(flight)
        lines.append(_row(flight.row.cells()))
        print(lines[-1], flush=True)
    if asked.json_file is not None:
        files.write_json(asked.json_file, {"rows": [dataclasses.asdict(flight.row) for flight in flights]})
    if asked.markdown is not None:
        files.write_text(asked.markdown, "\n".join(lines) + "\n")
    if asked.figures is not None:
        _draw_suite(asked.figures, flights, asked.controllers)
    return 0


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _draw_suite(folder: Path, flights: Sequence[SuiteFlight], names: Sequence[str]) -> None:
    from koz_jax.figures import style
    from koz_jax.figures import suite as drawn

    histories: dict[str, dict[str, History]] = {}
    for row, flown in flights:
        if flown is not None and row.by in names:  # without a filter
            histories.setdefault(row.case, {})[row.by] = flown.history
    for path in style.save(drawn.draw(histories, "Boresight traces, without a filter"), folder, "suite"):
        print(f"figure: {path}")
