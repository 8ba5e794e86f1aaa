"""What differs in the C source between one instrument and several, of which every zone then names its own.

In templates, lines that begin with ``@ONE@`` or ``@SEVERAL@`` are for one of the two only.
"""

_SEVERAL = {
    "OF_INSTRUMENTS": "[KOZ_INSTRUMENTS]",
    "OF_ZONE": "[now->zone_instrument[zone]]",
    "OF_UNIT_ZONE": "[unit->zone_instrument[zone]]",
    "OF_NEAREST": "[unit.zone_instrument[nearest]]",
    "OF_MEMORY": "[memory->instrument]",
    "OF_GIVEN_MEMORY": "[koz_instrument(memory->instrument)]",
    "MEMORY_ARGUMENT": "&memory, ",
    "NO_INSTRUMENT": ", 0",
}


def replacements(count: int) -> dict[str, str]:
    """Text by placeholder, for so many instruments."""
    return {"INSTRUMENTS": str(count), **(_SEVERAL if count > 1 else dict.fromkeys(_SEVERAL, ""))}


def lines_for(text: str, count: int) -> str:
    """A template without the lines that are not for so many instruments."""
    kept, dropped = ("@SEVERAL@", "@ONE@") if count > 1 else ("@ONE@", "@SEVERAL@")
    return "\n".join(line.removeprefix(kept) for line in text.split("\n") if not line.startswith(dropped))
