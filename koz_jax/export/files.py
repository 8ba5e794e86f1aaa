"""Exports as files: what an agent becomes in each format, and how that replaces an earlier export."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

from koz_jax.agents.agent import Agent
from koz_jax.config.base import Vector
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import TaskConfig
from koz_jax.errors import SettingsError
from koz_jax.export.c_source.policy import C_FILES, c_files
from koz_jax.export.c_source.shield import SHIELD_FILES, shield_files
from koz_jax.export.c_source.wheels import WHEEL_FILES
from koz_jax.export.golden import example, golden
from koz_jax.export.metadata import describe
from koz_jax.export.shield_golden import shield_golden
from koz_jax.storage import files
from koz_jax.task import host

GOLDEN_VECTORS = 100


def export(
    agent: Agent,
    to: Literal["c", "onnx", "stablehlo"],
    shield: ShieldConfig | None = None,
    task: TaskConfig | None = None,
    further_boresights: Sequence[Vector] = (),
    least_zones: int = 0,
) -> dict[str, bytes]:
    """Contents of the exported files by their names.

    Args:
        agent: who is exported.
        to: format.
        shield: of C only; None leaves it out.
        task: of an agent for any spacecraft, with the one that it is exported for; see ``made_for``.
        further_boresights: of an agent for any spacecraft, unit vectors (3,) in body axes of the instruments 1, 2, ...,
            such as of ``load_spacecraft(path).instruments[1:]``; of C only.  Number 0 is the task's own.
        least_zones: C is told of so many zones at least, such as ``len(load_spacecraft(path).constraints)``, also where
            the policy sees fewer.

    Raises:
        MissingExtraError: a package that the format needs is not installed.
        SettingsError: the shield cannot be, or the agent is of one spacecraft and is asked to fly another, or with
            several instruments; or these are no unit vectors, or the format is not C; or the format does not know the
            spacecraft's actuators.

    """
    made = made_for(agent, task)
    policy = agent.to_numpy()
    further = _checked(further_boresights, to)
    metadata = describe(policy, made.task, float(agent.controller.urgency), further, least_zones if to == "c" else 0)
    # What only one format needs is imported for that format.
    if to == "onnx":
        from koz_jax.export.onnx import onnx_files

        return onnx_files(policy, metadata)
    if to == "stablehlo":
        from koz_jax.export.stablehlo import stablehlo_files

        return stablehlo_files(agent, metadata)
    vectors = golden(made, GOLDEN_VECTORS, further_boresights=further, least_zones=least_zones)
    contents = c_files(policy, metadata, vectors, example(made, bool(further), least_zones))
    if shield is None:
        return contents
    answers = shield_golden(made, shield, GOLDEN_VECTORS, further_boresights=further, least_zones=least_zones)
    return contents | shield_files(metadata, shield, answers)


def made_for(agent: Agent, task: TaskConfig | None = None) -> Agent:
    """The agent on the one spacecraft that it is exported for.

    task: with its spacecraft, time step, and length and rates of maneuvers, such as ``load_spacecraft(path).task``; by
    default the agent's own.  Zones are those that the agent was trained for.

    Raises:
        SettingsError: a task is told for an agent that is of one spacecraft.

    """
    if not agent.controller.network.scaled:
        if task is None:
            return agent
        raise SettingsError(
            f"spacecraft: {agent.name} was trained for one spacecraft and can be exported for no other; leave it out"
        )
    own = task or agent.task
    zones = agent.task.scenario.model_copy(update={"max_rate_deg": own.scenario.max_rate_deg})
    one = own.model_copy(update={"spread": SpreadConfig(), "scenario": zones})
    return dataclasses.replace(agent, task=one)


def _checked(further_boresights: Sequence[Vector], to: str) -> tuple[Vector, ...]:
    if further_boresights and to != "c":
        raise SettingsError(
            f"further_boresights: zones of several instruments are known to exports to C only so far, got"
            f" {len(further_boresights)} for {to}"
        )
    units = (host.unit(f"further_boresights[{n}]", each, 3) for n, each in enumerate(further_boresights))
    return tuple((float(x), float(y), float(z)) for x, y, z in units)


def write_files(folder: Path, contents: Mapping[str, bytes]) -> list[Path]:
    """Write the files of an export, each in one step, in place of those of an earlier one.  Returns their paths.

    Raises:
        SettingsError: a file is there that no export has written; nothing was changed.
        StorageError: a file cannot be written.

    """
    # The shield of another controller would be compiled in, its wheels be taken for this one's.
    superseded = {*SHIELD_FILES, *WHEEL_FILES} - {*contents} if {*C_FILES} <= {*contents} else set()
    for name in (*contents, *superseded):
        if (folder / name).exists() and b"koz_jax" not in (folder / name).read_bytes():
            raise SettingsError(f"out: {folder / name} was not written by an export; choose another folder")
    for name in superseded:
        (folder / name).unlink(missing_ok=True)
    for name, content in contents.items():
        files.write_bytes(folder / name, content)
    return [folder / name for name in contents]
