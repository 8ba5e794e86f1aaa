"""A trained agent: load it, ask it, save it."""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict

from koz_jax import devices
from koz_jax.agents import numpy_policy, older
from koz_jax.agents.numpy_policy import NumpyPolicy
from koz_jax.agents.record import Provenance, Record, find_agent, read_agent_record
from koz_jax.agents.sb3 import is_sb3, read_sb3
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.policy import PolicyController, policy_network
from koz_jax.errors import SettingsError
from koz_jax.storage import archive
from koz_jax.task import observation_layout
from koz_jax.task.observation_layout import as_observations


@dataclasses.dataclass(frozen=True)
class Agent:
    """A policy with what is needed to fly it and to know where it comes from."""

    controller: PolicyController
    task: TaskConfig
    provenance: Provenance
    name: str

    def predict(self, observations: np.ndarray) -> np.ndarray:
        """Deterministic actions.

        observations: (16,) or (batch, 16), in the order of ``observation_layout.layout``; 5 entries more for each
        further zone that the agent sees.  Returns (3,) or (batch, 3) in [-1, 1]; times the torque limits that is the
        torque in body axes.
        """
        network = self.controller.network
        observed = as_observations(observations, network.observed_zones, network.scaled)
        return np.asarray(_act(self.controller, observed))

    def with_urgency(self, urgency: float) -> "Agent":
        """The same agent in more or less of a hurry.

        urgency: from 0 (thrifty) to 1 (as fast as the torque allows).

        Raises:
            SettingsError: it is not in [0, 1], or the agent was not trained to listen to it.

        """
        if not self.controller.network.scaled:
            raise SettingsError(f"urgency: {self.name} was trained for one trade of time against effort; got {urgency}")
        if not 0.0 <= urgency <= 1.0:
            raise SettingsError(f"urgency: must be in [0, 1], got {urgency}")
        return dataclasses.replace(self, controller=self.controller.replace(urgency=jnp.float32(urgency)))

    def to_numpy(self) -> NumpyPolicy:
        """The deterministic policy without jax, as ``numpy_policy.load_policy`` reads it."""
        arrays = {name: np.asarray(leaf) for name, leaf in flatten_dict(self.controller.policy, sep="/").items()}
        return numpy_policy.from_arrays(arrays, self._record(), self.name)

    def _record(self) -> Record:
        return Record(network=self.controller.network, task=self.task, provenance=self.provenance)

    def save(self, folder: Path | str) -> None:
        """Write the agent as a folder of arrays and JSON."""
        archive.save_tree(Path(folder), self.controller.policy, self._record().model_dump())


@jax.jit
@devices.in_float32
def _act(controller: PolicyController, observed: jax.Array) -> jax.Array:
    return controller.act(observed)


def load_agent(
    name: str | Path = "phase2",
    task: TaskConfig | None = None,
    normalization: Path | str | Mapping[str, Any] | None = None,
) -> Agent:
    """Load an agent by name or folder, see ``find_agent``; or a zip of Stable-Baselines3, see ``agents.sb3``.

    Args:
        name: of a shipped agent; a folder; or a zip.
        task: what the agent of a zip was trained for, by default the paper's; agents of ours know theirs.
        normalization: statistics of a zip that was trained under VecNormalize: a file .npz or .json, or a mapping, with
            mean, var, epsilon and clip, see ``agents.normalization``.

    Raises:
        SettingsError: there is no such agent, its files are damaged, it is not of the task, or the statistics of its
            observations are missing.

    """
    if is_sb3(name):
        record, arrays = read_sb3(name, task or TaskConfig(), normalization)
        policy = unflatten_dict({leaf: jnp.asarray(array) for leaf, array in arrays.items()}, sep="/")
        return Agent(PolicyController(policy, record.network), record.task, record.provenance, str(name))
    for what, told in {"task": task, "normalization": normalization}.items():
        if told is not None:
            raise SettingsError(f"{what}: is told for zips of Stable-Baselines3 only, got one for {name}")
    folder = find_agent(name)
    record = read_agent_record(folder)
    template = jax.eval_shape(
        functools.partial(policy_network(record.network).init, jax.random.key(0)),
        jax.ShapeDtypeStruct(
            (observation_layout.size(record.network.observed_zones, record.network.scaled),), np.float32
        ),
    )
    policy = archive.load_tree(folder, template, functools.partial(older.as_today, network=record.network))
    # What was spread in training is not what is flown unless somebody asks for it.
    task = record.task.model_copy(update={"spread": SpreadConfig()})
    return Agent(PolicyController(policy, record.network), task, record.provenance, str(name))
