"""Settings as command line flags.

The flags are filled in unchecked, then the settings are validated as a whole: an error names the full field, such as
``task.scenario.max_half_angle_deg``, and all wrong values are reported at once.
"""

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Any, TypeVar

import tyro

from koz_jax.settings import Settings

SettingsType = TypeVar("SettingsType", bound=Settings)
Others = TypeVar("Others")


def parse(defaults: SettingsType, others: Others, argv: Sequence[str], prog: str) -> tuple[SettingsType, Others]:
    """Read ``argv``; prints and exits for ``--help`` and for what is no flag or no value of its type.

    Args:
        defaults: settings to begin from; every field is a flag, those of a section with its name in front.
        others: a dataclass instance with further flags; its documentation heads the help.
        argv: the arguments.
        prog: name of the command in the help.

    Raises:
        pydantic.ValidationError: the settings are not allowed.

    """
    parts = {"others": others, "settings": _unchecked(defaults)}
    fields = [(name, Annotated[type(part), tyro.conf.arg(name="")], part) for name, part in parts.items()]
    everything = dataclasses.make_dataclass("Arguments", fields, frozen=True)
    everything.__doc__ = type(others).__doc__
    found = tyro.cli(everything, args=argv, prog=prog)
    return type(defaults).model_validate(dataclasses.asdict(found.settings)), found.others


def _unchecked(settings: Settings) -> Any:
    """Copy settings into a dataclass without validation; sections become dataclasses too."""
    fields = []
    for name, field in type(settings).model_fields.items():
        value = getattr(settings, name)
        if isinstance(value, Settings):
            value = _unchecked(value)
            fields.append((name, type(value), value))
        else:
            fields.append((name, Annotated[field.annotation, tyro.conf.arg(help=field.description)], value))
    plain = dataclasses.make_dataclass(type(settings).__name__, fields, frozen=True)
    plain.__doc__ = type(settings).__doc__
    return plain()
