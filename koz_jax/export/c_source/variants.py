"""What differs in the C source between spacecraft: one instrument or several, of which every zone then names its own,
and reaction wheels or none.

In templates, lines that begin with a name such as ``@WHEELS@`` are for some of them only, see ``Variant.names``.
"""

from typing import NamedTuple

from koz_jax.export.metadata import Metadata

_SEVERAL = {
    "OF_INSTRUMENTS": "[KOZ_INSTRUMENTS]",
    "OF_ZONE": "[now->zone_instrument[zone]]",
    "OF_UNIT_ZONE": "[unit->zone_instrument[zone]]",
    "OF_NEAREST": "[unit.zone_instrument[nearest]]",
    "OF_MEMORY": "[memory->instrument]",
    "OF_GIVEN_MEMORY": "[koz_instrument(memory->instrument)]",
    "NO_INSTRUMENT": ", 0",
}

_LIMITS_FIELD = "    float torque_limit[3]; /* [N m] about each body axis, what koz_observe found to be left */\n"


class Variant(NamedTuple):
    """For which spacecraft the source is."""

    instruments: int
    wheels: int

    @property
    def names(self) -> dict[str, bool]:
        """Whether lines of templates that begin with a name are for it."""
        several, wheels = self.instruments > 1, self.wheels > 0
        return {
            "ONE": not several,
            "SEVERAL": several,
            "WHEELS": wheels,
            "NO_WHEELS": not wheels,
            # Whether koz_torque takes the memory.
            "REMEMBERS": several or wheels,
            "FORGETS": not (several or wheels),
        }


def of(metadata: Metadata) -> Variant:
    """The one that an export is for."""
    return Variant(len(metadata.boresights_B), len(metadata.task.spacecraft.wheels))


def replacements(variant: Variant) -> dict[str, str]:
    """Text by placeholder."""
    several = _SEVERAL if variant.instruments > 1 else dict.fromkeys(_SEVERAL, "")
    return {
        **several,
        "INSTRUMENTS": str(variant.instruments),
        "WHEEL_COUNT": str(variant.wheels),
        "MEMORY_ARGUMENT": "&memory, " if variant.names["REMEMBERS"] else "",
        "LIMITS_FIELD": _LIMITS_FIELD if variant.wheels else "",
        "NO_LIMITS": ", {0.0f, 0.0f, 0.0f}" if variant.wheels else "",
        "LEFT_OF_I": "memory->torque_limit[i]" if variant.wheels else "@LIMIT_OF_I@",
        "NOW_LIMIT_OF_I": "limit_B[i]" if variant.wheels else "@LIMIT_OF_I@",
        "LIMIT_ARGUMENT": "limit_B, " if variant.wheels else "",
        "RATE_ARGUMENT": "at.squared_rate, " if variant.wheels else "",
        "HELD": "wheel_torque" if variant.wheels else "torque_B",
        "HELD_TORQUE": "wheel_torque[KOZ_WHEELS]" if variant.wheels else "torque_B[3]",
    }


def lines_for(text: str, variant: Variant) -> str:
    """A template without the lines that are for others."""
    dropped = tuple(f"@{name}@" for name, is_meant in variant.names.items() if not is_meant)
    kept = [f"@{name}@" for name, is_meant in variant.names.items() if is_meant]
    lines = [line for line in text.split("\n") if not line.startswith(dropped)]
    for name in kept:
        lines = [line.removeprefix(name) for line in lines]
    return "\n".join(lines)
