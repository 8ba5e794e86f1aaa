"""Export a trained agent: ``python -m koz_jax.export``, ``python -m koz_jax.export --help`` for every setting."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from koz_jax import storage
from koz_jax.errors import UserError, exit_status
from koz_jax.export.names import C_FILES, SHIELD_FILES
from koz_jax.shield_config import ShieldConfig

if TYPE_CHECKING:
    from koz_jax.agent import Agent

GOLDEN_VECTORS = 100


@dataclasses.dataclass(frozen=True)
class ExportArgs:
    """Write a trained agent as C99 source, ONNX, or StableHLO."""

    agent: Annotated[str, tyro.conf.Positional]
    """A shipped agent by name (phase1, phase2), the folder of a run or of an agent, or a Stable-Baselines3 SAC zip."""
    to: Literal["c", "onnx", "stablehlo"]
    """c: C99 with a self-test; onnx: a graph for onnxruntime; stablehlo: a program for XLA and jax.export."""
    out: Path
    """Folder to write into; the files of an earlier export to the same format are replaced."""
    shield: bool = False
    """Also write the shield, which keeps the boresight out of every zone; for --to c."""
    shield_margin_deg: float = ShieldConfig().margin_deg
    """Angle that the shield keeps from every zone [deg]."""


def main(argv: list[str]) -> int:
    """Export.  Returns the exit status."""
    return exit_status(lambda: _export(tyro.cli(ExportArgs, args=argv, prog="python -m koz_jax.export")))


def _export(args: ExportArgs) -> int:
    # jax is imported only now: --help and flags that do not exist are answered at once.
    from koz_jax.agent import load_agent

    if args.shield and args.to != "c":
        raise UserError(f"shield: is exported as C only, got --to {args.to}")
    config = ShieldConfig(margin_deg=args.shield_margin_deg)
    if not args.shield and config != ShieldConfig():
        raise UserError(f"shield_margin_deg: needs --shield, got {args.shield_margin_deg} without it")
    storage.make_folder("out", args.out)
    files = export(load_agent(args.agent), args.to, config if args.shield else None)
    for path in write_files(args.out, files):
        print(path)
    return 0


def export(agent: Agent, to: Literal["c", "onnx", "stablehlo"], shield: ShieldConfig | None = None) -> dict[str, bytes]:
    """Contents of the exported files by their names.

    shield: of C only; None leaves it out.

    Raises:
        UserError: a package that the format needs is not installed, or the shield cannot be.

    """
    if to == "onnx":
        from koz_jax.export.onnx import onnx_files

        return onnx_files(agent.to_numpy())
    if to == "stablehlo":
        from koz_jax.export.stablehlo import stablehlo_files

        return stablehlo_files(agent)
    from koz_jax.export.c import c_files, shield_files
    from koz_jax.export.golden import golden, shield_golden

    files = c_files(agent.to_numpy(), golden(agent, GOLDEN_VECTORS))
    if shield is None:
        return files
    return files | shield_files(agent.to_numpy(), shield, shield_golden(agent, shield, GOLDEN_VECTORS))


def write_files(folder: Path, files: Mapping[str, bytes]) -> list[Path]:
    """Write the files of an export, each in one step, in place of those of an earlier one.  Returns their paths.

    Raises:
        UserError: a file is there that no export has written; nothing was changed.

    """
    # The shield of another controller would be compiled in.
    superseded = {*SHIELD_FILES} - {*files} if {*C_FILES} <= {*files} else set()
    for name in (*files, *superseded):
        if (folder / name).exists() and b"koz_jax" not in (folder / name).read_bytes():
            raise UserError(f"out: {folder / name} was not written by an export; choose another folder")
    for name in superseded:
        (folder / name).unlink(missing_ok=True)
    for name, content in files.items():
        storage.write_bytes(folder / name, content)
    return [folder / name for name in files]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
