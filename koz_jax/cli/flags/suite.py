"""Flags of ``koz evaluate --suite``: who flies which maneuvers.  Imports no jax."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro
from pydantic import Field

from koz_jax.agents.record import DEFAULT_FOR_OTHERS
from koz_jax.cli.flags import parsing
from koz_jax.cli.flags.parsing import same_as
from koz_jax.config.base import NonNegativeInt, Seed, Settings
from koz_jax.config.filters import FilterName
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.control.registry import CLASSICAL

SUITE = "--suite"


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

    @property
    def under(self) -> list[FilterName | None]:
        """The filters; None where there is none."""
        return [None if name == "none" else name for name in self.filters]

    @property
    def draw(self) -> MonteCarloConfig | None:
        """The random cases, their zones checked as closely as the constraints of maneuvers are."""
        return MonteCarloConfig(cases=self.cases, seed=self.seed, substeps=5) if self.cases else None
