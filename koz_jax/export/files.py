"""Exports as files: what an agent becomes in each format, and how that replaces an earlier export."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from koz_jax.agents.agent import Agent
from koz_jax.config.shield import ShieldConfig
from koz_jax.errors import SettingsError
from koz_jax.export.c import C_FILES, SHIELD_FILES, c_files, shield_files
from koz_jax.export.golden import example, golden
from koz_jax.export.shield_golden import shield_golden
from koz_jax.storage import files

GOLDEN_VECTORS = 100


def export(agent: Agent, to: Literal["c", "onnx", "stablehlo"], shield: ShieldConfig | None = None) -> dict[str, bytes]:
    """Contents of the exported files by their names.

    shield: of C only; None leaves it out.

    Raises:
        MissingExtraError: a package that the format needs is not installed.
        SettingsError: the shield cannot be.

    """
    # What only one format needs is imported for that format.
    if to == "onnx":
        from koz_jax.export.onnx import onnx_files

        return onnx_files(agent.to_numpy())
    if to == "stablehlo":
        from koz_jax.export.stablehlo import stablehlo_files

        return stablehlo_files(agent)
    contents = c_files(agent.to_numpy(), golden(agent, GOLDEN_VECTORS), example(agent))
    if shield is None:
        return contents
    return contents | shield_files(agent.to_numpy(), shield, shield_golden(agent, shield, GOLDEN_VECTORS))


def write_files(folder: Path, contents: Mapping[str, bytes]) -> list[Path]:
    """Write the files of an export, each in one step, in place of those of an earlier one.  Returns their paths.

    Raises:
        SettingsError: a file is there that no export has written; nothing was changed.
        StorageError: a file cannot be written.

    """
    # The shield of another controller would be compiled in.
    superseded = {*SHIELD_FILES} - {*contents} if {*C_FILES} <= {*contents} else set()
    for name in (*contents, *superseded):
        if (folder / name).exists() and b"koz_jax" not in (folder / name).read_bytes():
            raise SettingsError(f"out: {folder / name} was not written by an export; choose another folder")
    for name in superseded:
        (folder / name).unlink(missing_ok=True)
    for name, content in contents.items():
        files.write_bytes(folder / name, content)
    return [folder / name for name in contents]
