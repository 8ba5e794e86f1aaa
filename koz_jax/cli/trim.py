"""``koz trim``: make finished runs small."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tyro.conf import Positional

from koz_jax.cli import invocation
from koz_jax.cli.exit_status import exit_status
from koz_jax.cli.flags import parsing
from koz_jax.config.base import Settings
from koz_jax.errors import SettingsError


class TrimFlags(Settings):
    """Remove checkpoints and snapshots from finished runs.  Agents, settings, curves and tables stay; such a run cannot
    be resumed, and no other can start from it.
    """

    runs: Positional[tuple[Path, ...]]
    """Folders of finished runs, or of several seeds."""


def main(argv: Sequence[str]) -> int:
    """Trim.  Returns the exit status."""
    return exit_status(lambda: _trim(parsing.parse(TrimFlags, argv, invocation.command("trim"))))


def _trim(asked: TrimFlags) -> int:
    from koz_jax.runs.folder import RunFolder

    if not asked.runs:
        raise SettingsError("runs: give the folder of one run or more")
    for run in asked.runs:
        seeds = sorted(run.glob("seed-*")) if (run / "seeds.json").is_file() else []
        for folder in map(RunFolder, seeds or [run]):
            freed = folder.trim()
            print(f"{folder.path}: {freed / 1e6:.1f} MB removed, {folder.size / 1e6:.1f} MB left")
    return 0
