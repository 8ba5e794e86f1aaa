"""``koz evaluate --suite``: everybody over published maneuvers, in one table."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from pydantic import Field

from koz_jax.agents.record import DEFAULT_FOR_OTHERS
from koz_jax.cli import invocation
from koz_jax.cli.exit_status import exit_status
from koz_jax.cli.flags import parsing
from koz_jax.cli.flags.parsing import same_as
from koz_jax.config.base import NonNegativeInt, Seed, Settings
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.control.registry import CLASSICAL

if TYPE_CHECKING:
    from koz_jax.agents.suite import SuiteFlight
    from koz_jax.evaluation.rollout import History

FLAG = "--suite"

# Constraints of the random cases are checked at so many instants of every step, as those of maneuvers are.
_SUBSTEPS = 5


class SuiteFlags(Settings):
    """Fly everybody over maneuvers that others have published, and over random cases of the paper's task; print one
    table, with what they report beside it.
    """

    folder: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[FOLDER]")] = None
    """Folder of maneuver files of your own, in place of the published ones."""
    controllers: tuple[str, ...] = Field(
        default=(DEFAULT_FOR_OTHERS, *CLASSICAL),
        description="Who flies: agents and controllers by name, folders of agents, or path/to/file.py:CLASS.",
    )
    filters: tuple[Literal["none", "shield", "zoh_cbf"], ...] = ("none", "shield")
    """What each of them flies under, in turn."""
    cases: NonNegativeInt = 1000
    """Random cases of the paper's task that each flies besides; 0 leaves them out."""
    seed: Seed = same_as(MonteCarloConfig, "seed")
    json_file: Path | None = parsing.named("json", "Also write the rows as JSON into this file.")
    markdown: Path | None = None
    """Also write the table into this file, as Markdown."""
    figures: Path | None = None
    """Draw the boresight traces of the flights without a filter into this folder, suite.png and suite.pdf (needs the
    extra viz)."""


def main(argv: Sequence[str]) -> int:
    """Fly and print.  argv: without the flag ``FLAG``.  Returns the exit status."""
    return exit_status(lambda: _fly(parsing.parse(SuiteFlags, argv, invocation.command(f"evaluate {FLAG}"))))


def _fly(asked: SuiteFlags) -> int:
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
    filters: list[suite.Under] = [None if name == "none" else name for name in asked.filters]
    draw = MonteCarloConfig(cases=asked.cases, seed=asked.seed, substeps=_SUBSTEPS) if asked.cases else None
    lines = [_line(suite.COLUMNS), _line(["---"] * len(suite.COLUMNS))]
    print("\n".join(lines), flush=True)
    flights: list[SuiteFlight] = []
    for flight in suite.fly_suite(maneuvers, asked.controllers, filters, draw):
        flights.append(flight)
        lines.append(_line(flight.row.cells()))
        print(lines[-1], flush=True)
    if asked.json_file is not None:
        files.write_json(asked.json_file, {"rows": [dataclasses.asdict(flight.row) for flight in flights]})
    if asked.markdown is not None:
        files.write_text(asked.markdown, "\n".join(lines) + "\n")
    if asked.figures is not None:
        _draw(asked.figures, flights, asked.controllers)
    return 0


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _draw(folder: Path, flights: Sequence[SuiteFlight], names: Sequence[str]) -> None:
    from koz_jax.figures import style
    from koz_jax.figures import suite as drawn

    histories: dict[str, dict[str, History]] = {}
    for row, flown in flights:
        if flown is not None and row.by in names:  # without a filter
            histories.setdefault(row.case, {})[row.by] = flown.history
    for path in style.save(drawn.draw(histories, "Boresight traces, without a filter"), folder, "suite"):
        print(f"figure: {path}")
