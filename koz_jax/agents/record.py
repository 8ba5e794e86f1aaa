"""Where agents lie and what their records hold; without jax."""

import importlib.resources
from pathlib import Path

from pydantic import Field, ValidationError

from koz_jax.config.base import Settings
from koz_jax.config.task import TaskConfig
from koz_jax.config.training import NetworkConfig
from koz_jax.errors import DamagedFileError, SettingsError, explain
from koz_jax.storage import archive

# Who flies where nobody is named: the paper's spacecraft, and any other.
DEFAULT_AGENT, DEFAULT_FOR_OTHERS = "phase2", "universal"


class Provenance(Settings):
    """Where an agent comes from."""

    command: str = ""
    """The command that trained it."""
    commit: str = ""
    """Commit of the repository it was trained with."""
    version: str = ""
    """Version of koz_jax."""
    config_sha256: str = ""
    """Hash of the whole ``config.json`` of the run; empty where there was none."""
    seed: int = 0
    """Seed of the training."""
    phase: int = 0
    """Phase of the curriculum that made it."""
    updates: int = 0
    """Gradient updates after which it was taken."""
    refinements: int = 0
    """Refinement iterations after those."""
    refinements_tried: int = 0
    """Refinement iterations that the run came to; with 0 ``refinements``, none of them gave a better agent."""
    table: dict[str, float | int | str] = Field(default={})
    """Its Monte Carlo table."""


class Record(Settings):
    """What is saved beside the weights."""

    network: NetworkConfig
    task: TaskConfig
    provenance: Provenance


def shipped_agents() -> tuple[str, ...]:
    """Names of the agents inside the package."""
    return tuple(sorted(record.parent.name for record in shipped_folder().glob("[!.]*/record.json")))


def shipped_folder() -> Path:
    """Where the agents inside the package are."""
    return Path(str(importlib.resources.files("koz_jax"))) / "agents" / "shipped"


def find_agent(name: str | Path) -> Path:
    """Folder of an agent: a shipped one by name, the best of a run, or an agent folder itself.

    Raises:
        SettingsError: there is none; the message lists what is allowed.

    """
    if str(name) in shipped_agents():
        return shipped_folder() / str(name)
    folder = Path(name)
    # The latest phase's agent is the run's result.
    for candidate in (folder, folder / "agents" / "phase2", folder / "agents" / "phase1"):
        if archive.is_saved(candidate) and "network" in archive.read_record(candidate):
            return candidate
    shipped = ", ".join(shipped_agents()) or "there is none"
    raise SettingsError(
        f"agent: {str(name)!r} is neither a shipped agent ({shipped}) nor a folder with a trained agent (a run, or one"
        " of the folders in its agents/)"
    )


def read_agent_record(folder: Path) -> Record:
    """Read and check the record of an agent's folder."""
    content = archive.read_record(folder)
    try:
        return Record.model_validate({name: content[name] for name in Record.model_fields if name in content})
    except ValidationError as error:
        raise DamagedFileError(f"{folder / 'record.json'}: {explain(error)}") from None
