"""Flags that describe a maneuver without a file.  Imports no jax."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

import tyro
from pydantic import ValidationError, model_validator

from koz_jax.config.base import Settings
from koz_jax.config.maneuvers.maneuver import ManeuverConfig
from koz_jax.config.maneuvers.maneuver_file import load_spacecraft
from koz_jax.config.maneuvers.maneuver_tables import BodyConfig
from koz_jax.config.task import TaskConfig
from koz_jax.errors import explain

FourNumbers = tuple[float, float, float, float]

Cones = Annotated[tuple[FourNumbers, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="X Y Z HALF_ANGLE")]

# Kinds of cones, as flags and in a maneuver.
_KINDS = ("keep_out", "keep_in")

# What the spacecraft's own instrument is called where nobody has named it.
_INSTRUMENT = "boresight"


class TurnFlags(Settings):
    """A maneuver without a file."""

    start: Annotated[FourNumbers | None, tyro.conf.arg(name="from", metavar="W X Y Z")] = None
    """Fly from this attitude (scalar first, body relative to inertial), at rest."""
    target: Annotated[FourNumbers | None, tyro.conf.arg(name="to", metavar="W X Y Z")] = None
    """Fly to this attitude."""
    keep_out: Cones = ()
    """With --from and --to: a cone to stay out of, its axis in inertial axes and its half angle [deg]."""
    keep_in: Cones = ()
    """With --from and --to: a cone to stay in, its axis in inertial axes and its half angle [deg]."""
    spacecraft: Path | None = None
    """With --from and --to: a TOML file with a table [spacecraft] and step_seconds, such as a maneuver file, whose
    first instrument is taken; by default the agent's spacecraft, with its actuators and rate limit."""

    @model_validator(mode="after")
    def _from_and_to(self) -> Self:
        if (self.start is None) != (self.target is None):
            here, missing = ("from", "to") if self.target is None else ("to", "from")
            raise ValueError(f"{here}: needs --{missing} too")
        alone = [name for name in ("keep_out", "keep_in", "spacecraft") if getattr(self, name)]
        if self.start is None and alone:
            raise ValueError(f"{alone[0]}: needs --from and --to")
        return self

    def turn(self, own: TaskConfig) -> ManeuverConfig:
        """The maneuver that the flags describe.

        own: what the agent was made for, flown where no other spacecraft is given.

        Raises:
            SettingsError: the file cannot be read.
            ValueError: the flags make no maneuver, a line for each that is wrong; or the agent's spacecraft has gyros.

        """
        if self.spacecraft is None:
            given = {
                "step_seconds": own.step_seconds,
                "duration_seconds": own.episode_seconds,
                "settled_angle_deg": own.reward.settled_angle_deg,
                "spacecraft": BodyConfig.of(own.spacecraft),
                "instruments": [{"name": _INSTRUMENT, "boresight": own.spacecraft.boresight}],
            }
        else:
            found = load_spacecraft(self.spacecraft)
            given = found.model_dump(exclude={"name", "constraints"})
            if not found.instruments:
                given["instruments"] = [{"name": _INSTRUMENT, "boresight": own.spacecraft.boresight}]
        instrument = given["instruments"][0]["name"]
        of_flags = {
            f"{kind}.{number}": (kind, cone) for kind in _KINDS for number, cone in enumerate(getattr(self, kind))
        }
        cones = [
            {"instrument": instrument, "kind": kind, "direction": (x, y, z), "half_angle_deg": angle}
            for kind, (x, y, z, angle) in of_flags.values()
        ]
        ends = {"start": {"attitude": self.start}, "target": {"attitude": self.target}}
        try:
            return ManeuverConfig.model_validate(
                {"name": "a turn of one's own"} | given | ends | {"constraints": cones}
            )
        except ValidationError as error:
            flags = {"start.attitude": "from", "target.attitude": "to"}
            flags |= {f"constraints.{number}.": f"{flag}." for number, flag in enumerate(of_flags)}
            message = explain(error)
            for place, flag in flags.items():
                message = message.replace(place, flag)
            raise ValueError(message) from None
