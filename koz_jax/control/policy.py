"""A trained policy as a controller."""

import jax
from flax import struct

from koz_jax.config.training import NetworkConfig
from koz_jax.control import encoding
from koz_jax.control.base import Memoryless
from koz_jax.sac.networks import Params, Policy
from koz_jax.task import observation
from koz_jax.task.any_spacecraft import nondimensional
from koz_jax.task.observation_layout import ACTION_SIZE
from koz_jax.task.state import EnvState, Model


def policy_network(config: NetworkConfig) -> Policy:
    """The policy's network for this task."""
    return Policy(config.hidden_sizes, encoding.views(config), ACTION_SIZE, encoding.dials(config))


class PolicyController(Memoryless):
    """The deterministic policy as a controller."""

    policy: Params
    network: NetworkConfig = struct.field(pytree_node=False)
    urgency: jax.Array | float = 0.5  # () in [0, 1], where it sees one

    def act(self, observed: jax.Array) -> jax.Array:
        """Action (..., 3) in [-1, 1] for an observation (..., 16), longer where it sees several zones."""
        return policy_network(self.network).apply(self.policy, observed).mode()  # pyright: ignore

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """Action (3,) in [-1, 1] for the state, by its observation."""
        if self.network.scaled:
            seen = nondimensional.observe(state, model, self.urgency, self.network.observed_zones)
            return nondimensional.command(self.act(seen), state, model), memory
        return self.act(observation.observe(state, self.network.observed_zones)), memory
