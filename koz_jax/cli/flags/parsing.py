"""Settings as command line flags.

The flags are filled in unchecked, then the settings are validated as a whole: an error names the full field, such as
``task.scenario.max_half_angle_deg``, and all wrong values are reported at once, each in a line.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, TypeVar

import tyro
from pydantic import Field, ValidationError
from pydantic.fields import FieldInfo
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from koz_jax.config.actuators.gyros import GyroConfig
from koz_jax.config.actuators.wheels import WheelConfig
from koz_jax.config.base import Settings
from koz_jax.config.goal import GoalConfig
from koz_jax.errors import SettingsError, explain

Flags = TypeVar("Flags", bound=Settings)
SettingsType = TypeVar("SettingsType", bound=Settings)

_REGISTRY = ConstructorRegistry()


@dataclasses.dataclass(frozen=True)
class ChangesOf:
    """Marks a field of type ``dict`` that holds what the command line changes of other settings.

    Only what was typed is in it, section by section and unchecked: what it changes is known later (see ``applied``).
    Its flags begin with the field's alias.
    """

    settings: type[Settings]  # with a default for every field


def parse(flags: type[Flags], argv: Sequence[str], prog: str) -> Flags:
    """Read ``argv`` into settings whose fields are flags; prints and exits for ``--help`` and for what is no flag.

    Args:
        flags: the settings; their documentation heads the help.  Fields of sections have the section's name in front,
            and those of type ``tyro.conf.Positional`` are given by their place.
        argv: the arguments.
        prog: name of the command in the help.

    Raises:
        SettingsError: a value is not allowed.

    """
    found = tyro.cli(_plain(flags, {}), args=argv, prog=prog, registry=_REGISTRY)
    return _validated(argv, (flags, found))[0]


def parse_with(
    flags: type[Flags], settings: SettingsType, argv: Sequence[str], prog: str, helps: Mapping[str, str]
) -> tuple[Flags, SettingsType]:
    """``parse`` flags together with other settings.

    settings: to begin from; helps: texts in place of the descriptions of some of their fields.
    """
    plain = _plain(settings, helps)
    parts = [("flags", _plain(flags, {})), ("settings", plain)]
    fields = [(name, Annotated[part, tyro.conf.arg(name="")], part()) for name, part in parts]
    everything = dataclasses.make_dataclass("Arguments", fields, frozen=True)
    everything.__doc__ = flags.__doc__
    found = tyro.cli(everything, args=argv, prog=prog, registry=_REGISTRY)
    read, changed = _validated(argv, (flags, found.flags), (type(settings), found.settings))
    return read, changed


def same_as(settings: type[Settings], name: str) -> Any:
    """A field with the default and the description of another one."""
    field = settings.model_fields[name]
    return Field(field.default, description=field.description)


def named(flag: str, description: str) -> Any:
    """An optional field whose flag has a name that the settings cannot have themselves."""
    return Field(None, alias=flag, description=description)


def agents_own(settings: type[Settings], name: str) -> Any:
    """A field with the description of another one; None, the default, leaves it as the agent has it."""
    description = settings.model_fields[name].description or ""
    return Field(default=None, description=f"{description.rstrip('.')}; by default the agent's.")


def applied(flag: str, settings: SettingsType, changed: dict[str, Any]) -> SettingsType:
    """Settings with the changes of a field that is marked with ``ChangesOf``.  flag: its alias.

    Raises:
        SettingsError: a value is not allowed.

    """
    try:
        return type(settings).model_validate(_merged(settings.model_dump(), changed))
    except ValidationError as error:
        lines = explain(error).splitlines()
        raise SettingsError("\n".join(f"{flag}.{line}" for line in lines)) from None


def _merged(values: dict[str, Any], changed: dict[str, Any]) -> dict[str, Any]:
    inner = {name: _merged(values[name], value) for name, value in changed.items() if isinstance(value, dict)}
    return values | changed | inner


def _changed_by(field: FieldInfo) -> type[Settings] | None:
    """Settings of which a field holds changes; None if it holds none."""
    return next((mark.settings for mark in field.metadata if isinstance(mark, ChangesOf)), None)


def _typed(argv: Sequence[str], values: dict[str, Any], flag: str) -> dict[str, Any]:
    """Those of some values whose flags were typed."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        its_flag = f"{flag}.{name}"
        if isinstance(value, dict):
            inner = _typed(argv, value, its_flag)
            found |= {name: inner} if inner else {}
        elif any(word.partition("=")[0].replace("-", "_") == its_flag.replace("-", "_") for word in argv):
            found[name] = value
    return found


def _validated(argv: Sequence[str], *parts: tuple[type[Settings], Any]) -> tuple[Any, ...]:
    """Check what was filled in.  parts: settings, and what was found for them."""
    settings, wrong = [], []
    for kind, found in parts:
        values = _values(found)
        for field in kind.model_fields.values():
            if field.alias and _changed_by(field):
                values[field.alias] = _typed(argv, values[field.alias], f"--{field.alias}")
        try:
            settings.append(kind.model_validate(values))
        except ValidationError as error:
            wrong.append(explain(error))
    if wrong:
        raise SettingsError("\n".join(wrong))
    return tuple(settings)


def _values(found: Any) -> dict[str, Any]:
    values = {field.name: getattr(found, field.name) for field in dataclasses.fields(found)}
    return {name: _values(value) if dataclasses.is_dataclass(value) else value for name, value in values.items()}


def _plain(settings: Settings | type[Settings], helps: Mapping[str, str]) -> type[Any]:
    """A dataclass like settings, with their values as defaults, but without validation; sections likewise."""
    kind = settings if isinstance(settings, type) else type(settings)
    fields = []
    for name, field in kind.model_fields.items():
        annotation = Annotated[
            (field.annotation, *field.metadata, tyro.conf.arg(help=helps.get(name) or field.description))
        ]
        if field.is_required() and isinstance(settings, type):
            fields.append((field.alias or name, annotation))
            continue
        value = field.get_default() if isinstance(settings, type) else getattr(settings, name)
        changed = _changed_by(field)
        if changed is not None:
            value = changed()
        if isinstance(value, Settings):
            section = _plain(value, {})
            if changed is not None:
                section.__doc__ = field.description
            annotation, value = section, section()
        fields.append((field.alias or name, annotation, value))
    plain = dataclasses.make_dataclass(kind.__name__, fields, frozen=True)
    plain.__doc__ = kind.__doc__
    return plain


@_REGISTRY.primitive_rule
def _whole_number(type_info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """Whole numbers may be written as 10_000 or 1e4; what is none is left to the validation, which names the field."""
    if type_info.type is not int:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=lambda words: _number(words[0]),
        is_instance=lambda value: isinstance(value, int) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )


def _number(word: str) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(word)
        except ValueError:
            pass
    return word


@_REGISTRY.primitive_rule
def _wheel(type_info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """A wheel is six numbers: its axis, and then what else it has, in the order of its settings."""
    if type_info.type is not WheelConfig:
        return None
    names = [*WheelConfig.model_fields]
    return PrimitiveConstructorSpec(
        nargs=2 + len(names),
        metavar="X Y Z MAX-TORQUE MAX-MOMENTUM MOMENTUM",
        instance_from_str=lambda args: {"axis": tuple(args[:3]), **dict(zip(names[1:], args[3:], strict=True))},
        is_instance=lambda instance: isinstance(instance, WheelConfig),
        str_from_instance=lambda wheel: [
            str(number) for number in (*wheel.axis, *list(wheel.model_dump().values())[1:])
        ],
    )


@_REGISTRY.primitive_rule
def _gyro(type_info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """A gyro is nine numbers: its two axes, and then what else it has, in the order of its settings."""
    if type_info.type is not GyroConfig:
        return None
    names = [*GyroConfig.model_fields]
    return PrimitiveConstructorSpec(
        nargs=4 + len(names),
        metavar="NINE NUMBERS",
        instance_from_str=lambda args: {
            "gimbal_axis": tuple(args[:3]),
            "rotor_axis": tuple(args[3:6]),
            **dict(zip(names[2:], args[6:], strict=True)),
        },
        is_instance=lambda instance: isinstance(instance, GyroConfig),
        str_from_instance=lambda gyro: [
            str(number) for number in (*gyro.gimbal_axis, *gyro.rotor_axis, *list(gyro.model_dump().values())[2:])
        ],
    )


@_REGISTRY.primitive_rule
def _goal(type_info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """A goal is QUANTITY=BOUND."""
    if type_info.type is not GoalConfig:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="QUANTITY=BOUND",
        instance_from_str=lambda words: dict(zip(GoalConfig.model_fields, words[0].split("=", 1), strict=False)),
        is_instance=lambda instance: isinstance(instance, GoalConfig),
        str_from_instance=lambda goal: [str(goal)],
    )
