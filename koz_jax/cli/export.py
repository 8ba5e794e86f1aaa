"""``koz export``: write a trained agent for other programs."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator
from tyro.conf import Positional

from koz_jax.cli import invocation
from koz_jax.cli.exit_status import exit_status
from koz_jax.cli.flags import parsing
from koz_jax.cli.flags.flight import AGENT, URGENCY
from koz_jax.config.base import MarginDeg, NonNegativeFloat, Settings
from koz_jax.config.maneuvers.maneuver_file import load_spacecraft
from koz_jax.config.maneuvers.maneuver_tables import ConstraintConfig, fastest_cone_deg
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.spread import Urgency
from koz_jax.config.uncertainty import CERTAIN, UncertaintyConfig
from koz_jax.errors import SettingsError

_log = logging.getLogger(__name__)


class _FormatFlags(Settings):
    """Who is exported to what."""

    agent: Positional[str] = Field(description=f"Who is exported: {AGENT}.")
    to: Literal["c", "onnx", "stablehlo"]
    """c: C99 with a self-test and an example; onnx: a graph for onnxruntime; stablehlo: a program for XLA."""
    out: Path
    """Folder to write into; the files of an earlier export to the same format are replaced."""
    spacecraft: Path | None = None
    """Of an agent for any spacecraft, the one that it is exported for, and the shield with it: a TOML file with a table
    [spacecraft] and step_seconds, such as a maneuver file; by default that of the agent's task.  C knows all of its
    [[instruments]], and is told of as many zones as it has [[constraints]]; the other formats take a file with one
    instrument.  The shield is for cones as fast as the fastest of the constraints."""
    urgency: Urgency | None = Field(default=None, description=URGENCY)
    shield: bool = False
    """Also write the shield, which keeps the boresight out of every zone; for --to c."""
    shield_margin_deg: MarginDeg = parsing.same_as(ShieldConfig, "margin_deg")
    cone_rate_deg: NonNegativeFloat | None = None
    """Largest rate of a cone's axis that the shield is kept against [deg/s]; by default the largest rotation_deg of the
    constraints in the file of --spacecraft, without one 0."""
    robust: bool = False
    """Make the shield withstand errors, which the flags of errors set."""


class ExportFlags(UncertaintyConfig, _FormatFlags):
    """Write a trained agent as C99 source, ONNX, or StableHLO."""

    @model_validator(mode="after")
    def _of_the_shield(self) -> Self:
        if self.shield and self.to != "c":
            raise ValueError(f"shield: is exported as C only, got --to {self.to}")
        if not self.shield:
            if self.robust:
                raise ValueError("robust: is of the shield, and needs --shield")
            if self.shield_margin_deg != ShieldConfig().margin_deg:
                raise ValueError(f"shield_margin_deg: needs --shield, got {self.shield_margin_deg} without it")
            if self.cone_rate_deg:
                raise ValueError(f"cone_rate_deg: is of the shield and needs --shield, got {self.cone_rate_deg:g}")
        if self.robust and self._errors == CERTAIN:
            raise ValueError("robust: needs an error to withstand, such as --inertia-error 0.1")
        for name, error in self._errors.model_dump().items():
            if error and not self.robust:
                raise ValueError(f"{name}: is for the shield to withstand and needs --robust, got {error} without it")
        return self

    @property
    def _errors(self) -> UncertaintyConfig:
        return UncertaintyConfig(**self.model_dump(include={*UncertaintyConfig.model_fields}))

    def shield_config(self, constraints: Sequence[ConstraintConfig]) -> ShieldConfig | None:
        """The shield to export, if one is asked for.

        constraints: of the file of ``spacecraft``, which it must withstand.

        Raises:
            SettingsError: they turn faster than the cones that are told of.

        """
        if not self.shield:
            return None
        fastest = fastest_cone_deg(constraints)
        rate = fastest if self.cone_rate_deg is None else self.cone_rate_deg
        if rate < fastest * (1.0 - 1e-5):  # as it is printed, it will do
            raise SettingsError(
                f"cone_rate_deg: must be at least {fastest:.6g}, the rate of the fastest of the constraints in"
                f" {self.spacecraft}, got {rate:g}; by default it is that"
            )
        return ShieldConfig(margin_deg=self.shield_margin_deg, cone_rate_deg=rate, error_bounds=self._errors)


def main(argv: Sequence[str]) -> int:
    """Export.  Returns the exit status."""
    return exit_status(lambda: _export(parsing.parse(ExportFlags, argv, invocation.command("export"))))


def _export(asked: ExportFlags) -> int:
    # jax is imported only now: --help and flags that do not exist are answered at once.
    from koz_jax.agents.agent import load_agent
    from koz_jax.export.files import export, write_files
    from koz_jax.storage.files import make_folder

    agent = load_agent(asked.agent)
    task, further, constraints = None, (), ()
    if asked.spacecraft is not None:
        described = load_spacecraft(asked.spacecraft)
        task, constraints = described.task, described.constraints
        if agent.controller.network.scaled:
            further = tuple(instrument.boresight for instrument in described.instruments[1:])
        if further and asked.to != "c":
            raise SettingsError(
                f"spacecraft: {asked.spacecraft} has {1 + len(further)} instruments, of which only --to c knows all;"
                f" leave one in the file, got --to {asked.to}"
            )
    if asked.urgency is not None:
        agent = agent.with_urgency(asked.urgency)
    shield = asked.shield_config(constraints)
    _tell_of_unseen(agent.controller.network.observed_zones, asked, len(constraints))
    make_folder("out", asked.out)
    for path in write_files(asked.out, export(agent, asked.to, shield, task, further, len(constraints))):
        print(path)
    return 0


def _tell_of_unseen(seen: int, asked: ExportFlags, constraints: int) -> None:
    """Log a warning where the file has more constraints than a policy sees."""
    if seen < constraints:
        shielded = "; the shield keeps all" if asked.shield else ""
        _log.warning(
            "spacecraft: %s has %d constraints, of which %s sees the nearest %d in every step%s",
            *(asked.spacecraft, constraints, asked.agent, seen, shielded),
        )
