"""Read maneuver files, and files of a spacecraft alone.  TOML; imports no jax."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from koz_jax.config.base import PositiveFloat
from koz_jax.config.maneuvers.maneuver import ManeuverConfig
from koz_jax.config.maneuvers.maneuver_tables import BodyConfig, ConstraintConfig, InstrumentConfig, Table
from koz_jax.config.task import TaskConfig
from koz_jax.errors import SettingsError, explain

TableType = TypeVar("TableType", bound=Table)


class SpacecraftFile(Table):
    """A spacecraft with its instruments and their constraints, without a maneuver."""

    name: str = ""
    """What to call it."""
    step_seconds: PositiveFloat
    """Time step; the torque is held over it [s]."""
    settled_angle_deg: PositiveFloat = ManeuverConfig.model_fields["settled_angle_deg"].default
    """Settled is what stays within this angle of the target [deg]."""
    source: str = ""
    """Where the numbers come from."""
    spacecraft: BodyConfig
    """What turns."""
    instruments: tuple[InstrumentConfig, ...] = ()
    """What looks."""
    constraints: tuple[ConstraintConfig, ...] = ()
    """What must not be looked at.  Draws have zones of their own; an exported shield is made for these."""

    @property
    def task(self) -> TaskConfig:
        """The paper's draw of maneuvers for the first instrument, its times and rates in units of this spacecraft."""
        paper = TaskConfig()
        boresight = self.instruments[0].boresight if self.instruments else paper.spacecraft.boresight
        body = self.spacecraft.spacecraft(boresight)
        stretch = body.time_unit / paper.spacecraft.time_unit
        return TaskConfig(
            spacecraft=body,
            reward=paper.reward.model_copy(update={"settled_angle_deg": self.settled_angle_deg}),
            scenario=paper.scenario.model_copy(update={"max_rate_deg": paper.scenario.max_rate_deg / stretch}),
            step_seconds=self.step_seconds,
            episode_seconds=paper.episode_seconds * stretch,
        )


def load_maneuver(path: Path | str) -> ManeuverConfig:
    """Read a maneuver file.  What is allowed and looks wrong is logged as a warning.

    Raises:
        SettingsError: the file cannot be read or is no maneuver; a line for each key that is wrong, with its value and
            what is allowed.

    """
    given = _read("maneuver", Path(path))
    return _validated(ManeuverConfig, {"name": Path(path).stem} | given, Path(path))


def load_spacecraft(path: Path | str) -> SpacecraftFile:
    """Read a file with a table [spacecraft]; of a maneuver file only the spacecraft with its step, its instruments and
    their constraints.

    Raises:
        SettingsError: see ``load_maneuver``.

    """
    given = _read("spacecraft", Path(path))
    of_the_maneuver = {*ManeuverConfig.model_fields} - {*SpacecraftFile.model_fields}
    kept = {key: value for key, value in given.items() if key not in of_the_maneuver}
    return _validated(SpacecraftFile, {"name": Path(path).stem} | kept, Path(path))


def _read(what: str, path: Path) -> dict[str, Any]:
    try:
        with open(path, "rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise SettingsError(f"{what}: {path} cannot be read: {error.strerror or error}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{what}: {path} is not TOML: {error}") from None


def _validated(settings: type[TableType], given: dict[str, Any], path: Path) -> TableType:
    """Check what was read; numbers must be written as numbers."""
    try:
        return settings.model_validate(_tuples(given), strict=True)
    except ValidationError as error:
        raise SettingsError("\n".join(f"{path}: {line}" for line in explain(error).splitlines())) from None


def _tuples(value: Any) -> Any:
    """Lists as tuples, at every depth."""
    if isinstance(value, list):
        return tuple(_tuples(one) for one in value)
    return {key: _tuples(one) for key, one in value.items()} if isinstance(value, dict) else value
