"""Where an agent comes from: version and commit of the code, settings, command."""

import subprocess
from pathlib import Path

from koz_jax.agents.record import Provenance
from koz_jax.config.training import TrainConfig
from koz_jax.config.version import version

_PACKAGE = Path(__file__).parents[1]


def collect(config: TrainConfig, command: str) -> Provenance:
    """Note what is known before a run begins.

    command: the command line that trains; empty for a call from Python.
    """
    return Provenance(
        command=command,
        commit=commit(),
        version=version(),
        config_sha256=config.sha256,
        seed=config.seed,
    )


def commit(package: Path = _PACKAGE) -> str:
    """Commit of the checkout that a package runs from, marked when it has changes; empty where there is none.

    A repository that merely contains the package, installed in its virtual environment, is not the package's own: git
    is asked whether it tracks it.
    """
    if _git(package, "ls-files", "--error-unmatch", "__init__.py") is None:
        return ""
    return _git(package, "describe", "--always", "--dirty", "--abbrev=40") or ""


def _git(folder: Path, *command: str) -> str | None:
    """What git prints in a folder; None where it refuses, or is not installed."""
    try:
        done = subprocess.run(["git", "-C", str(folder), *command], capture_output=True, text=True, check=False)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None
