"""A trained agent: load it, ask it, save it."""

import dataclasses
import functools
import importlib.resources
from pathlib import Path

import jax
import numpy as np
from flax import struct
from pydantic import Field, ValidationError

from koz_jax import observation, storage, task
from koz_jax.config import NetworkConfig
from koz_jax.controllers.base import Memoryless
from koz_jax.env import EnvParams, EnvState
from koz_jax.errors import UserError, explain
from koz_jax.sac.networks import Params, Policy
from koz_jax.settings import Settings
from koz_jax.task_config import TaskConfig

ACTION_SIZE = 3


def policy_network(config: NetworkConfig) -> Policy:
    """The policy's network for this task."""
    return Policy(config.hidden_sizes, task.encoding(config.encoding, config.observed_zones), ACTION_SIZE)


class PolicyController(Memoryless):
    """The deterministic policy as a controller."""

    policy: Params
    network: NetworkConfig = struct.field(pytree_node=False)

    def act(self, observed: jax.Array) -> jax.Array:
        """Action (..., 3) in [-1, 1] for an observation (..., 16), longer where it sees several zones."""
        return policy_network(self.network).apply(self.policy, observed).mode()  # pyright: ignore

    def decide(self, state: EnvState, params: EnvParams, memory: None) -> tuple[jax.Array, None]:
        """Action (3,) in [-1, 1] for the state, by its observation."""
        return self.act(observation.observe(state, params, self.network.observed_zones)), memory


class Provenance(Settings):
    """Where an agent comes from."""

    command: str = ""
    """The command that trained it."""
    commit: str = ""
    """Commit of the repository it was trained with."""
    version: str = ""
    """Version of koz_jax."""
    seed: int = 0
    """Seed of the training."""
    phase: int = 0
    """Phase of the curriculum that made it."""
    updates: int = 0
    """Gradient updates after which it was taken."""
    refinements: int = 0
    """Refinement iterations after those."""
    table: dict[str, float | int | str] = Field(default={})
    """Its Monte Carlo table."""


class _Record(Settings):
    """What is saved beside the weights."""

    network: NetworkConfig
    task: TaskConfig
    provenance: Provenance


@dataclasses.dataclass(frozen=True)
class Agent:
    """A policy with what is needed to fly it and to know where it comes from."""

    controller: PolicyController
    task: TaskConfig
    provenance: Provenance
    name: str

    def predict(self, observations: np.ndarray) -> np.ndarray:
        """Deterministic actions.

        observations: (16,) or (batch, 16), in the order of ``observation.layout``; 5 entries more for each further
        zone that the agent sees.  Returns (3,) or (batch, 3) in [-1, 1]; times the torque limit that is the torque in
        body axes.
        """
        observed = np.asarray(observations, np.float32)
        size = observation.size(self.controller.network.observed_zones)
        if observed.ndim not in (1, 2) or observed.shape[-1] != size:
            allowed = f"({size},) or (batch, {size})"
            raise UserError(f"observations: must have shape {allowed}, got {observed.shape}")
        return np.asarray(_act(self.controller, observed))

    def save(self, folder: Path | str) -> None:
        """Write the agent as a folder of arrays and JSON."""
        record = _Record(network=self.controller.network, task=self.task, provenance=self.provenance)
        storage.save_tree(Path(folder), self.controller.policy, record.model_dump())


@jax.jit
def _act(controller: PolicyController, observed: jax.Array) -> jax.Array:
    return controller.act(observed)


def shipped_agents() -> tuple[str, ...]:
    """Names of the agents inside the package."""
    return tuple(sorted(record.parent.name for record in shipped_folder().glob("[!.]*/record.json")))


def shipped_folder() -> Path:
    """Where the agents inside the package are."""
    return Path(str(importlib.resources.files("koz_jax"))) / "agents"


def find_agent(name: str | Path) -> Path:
    """Folder of an agent: a shipped one by name, the best of a run, or an agent folder itself.

    Raises:
        UserError: there is none; the message lists what is allowed.

    """
    if str(name) in shipped_agents():
        return shipped_folder() / str(name)
    folder = Path(name)
    # The latest phase's agent is the run's result.
    for candidate in (folder, folder / "agents" / "phase2", folder / "agents" / "phase1"):
        if storage.is_saved(candidate) and "network" in storage.read_record(candidate):
            return candidate
    shipped = ", ".join(shipped_agents()) or "there is none"
    raise UserError(
        f"agent: {str(name)!r} is neither a shipped agent ({shipped}) nor a folder with a trained agent (a run, or one"
        " of the folders in its agents/)"
    )


def load_agent(name: str | Path = "phase2") -> Agent:
    """Load an agent by name or folder; see ``find_agent``."""
    folder = find_agent(name)
    content = storage.read_record(folder)
    try:
        record = _Record.model_validate({name: content[name] for name in _Record.model_fields if name in content})
    except ValidationError as error:
        raise UserError(f"{folder / 'record.json'}: {explain(error)}") from None
    template = jax.eval_shape(
        functools.partial(policy_network(record.network).init, jax.random.key(0)),
        jax.ShapeDtypeStruct((observation.size(record.network.observed_zones),), np.float32),
    )
    policy = storage.load_tree(folder, template)
    return Agent(PolicyController(policy, record.network), record.task, record.provenance, str(name))
