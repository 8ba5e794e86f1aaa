"""A trained agent: load it, ask it, save it."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from flax.traverse_util import flatten_dict, unflatten_dict

from koz_jax import encoding, observation, storage
from koz_jax.agent_files import Provenance, Record, find_agent, read_agent_record, shipped_agents, shipped_folder
from koz_jax.config import NetworkConfig
from koz_jax.controllers.base import Memoryless
from koz_jax.env import EnvParams, EnvState
from koz_jax.errors import UserError
from koz_jax.layout import ACTION_SIZE, as_observations
from koz_jax.numpy_policy import NumpyPolicy, from_arrays
from koz_jax.sac.networks import Params, Policy
from koz_jax.sb3_policy import is_sb3, read_sb3
from koz_jax.task_config import TaskConfig

__all__ = [
    "Agent",
    "PolicyController",
    "Provenance",
    "find_agent",
    "load_agent",
    "policy_network",
    "shipped_agents",
    "shipped_folder",
]


def policy_network(config: NetworkConfig) -> Policy:
    """The policy's network for this task."""
    return Policy(config.hidden_sizes, encoding.views(config), ACTION_SIZE)


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
        observed = as_observations(observations, self.controller.network.observed_zones)
        return np.asarray(_act(self.controller, observed))

    def to_numpy(self) -> NumpyPolicy:
        """The deterministic policy without jax, as ``numpy_policy.load_policy`` reads it."""
        arrays = {name: np.asarray(leaf) for name, leaf in flatten_dict(self.controller.policy, sep="/").items()}
        return from_arrays(arrays, self._record(), self.name)

    def _record(self) -> Record:
        return Record(network=self.controller.network, task=self.task, provenance=self.provenance)

    def save(self, folder: Path | str) -> None:
        """Write the agent as a folder of arrays and JSON."""
        storage.save_tree(Path(folder), self.controller.policy, self._record().model_dump())


@jax.jit
def _act(controller: PolicyController, observed: jax.Array) -> jax.Array:
    return controller.act(observed)


def load_agent(name: str | Path = "phase2", task: TaskConfig | None = None) -> Agent:
    """Load an agent by name or folder, see ``find_agent``; or a zip of Stable-Baselines3, see ``sb3_policy``.

    task: what the agent of a zip was trained for, by default the paper's; agents of ours know theirs.

    Raises:
        UserError: there is no such agent, its files are damaged, or it is not of the task.

    """
    if is_sb3(name):
        record, arrays = read_sb3(name, task or TaskConfig())
        policy = unflatten_dict({leaf: jnp.asarray(array) for leaf, array in arrays.items()}, sep="/")
        return Agent(PolicyController(policy, record.network), record.task, record.provenance, str(name))
    if task is not None:
        raise UserError(f"task: is told for zips of Stable-Baselines3 only, got one for {name}")
    folder = find_agent(name)
    record = read_agent_record(folder)
    template = jax.eval_shape(
        functools.partial(policy_network(record.network).init, jax.random.key(0)),
        jax.ShapeDtypeStruct((observation.size(record.network.observed_zones),), np.float32),
    )
    policy = storage.load_tree(folder, template)
    return Agent(PolicyController(policy, record.network), record.task, record.provenance, str(name))
