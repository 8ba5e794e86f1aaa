"""Policies of other libraries as controllers of the Monte Carlo."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.base import Memoryless
from koz_jax.evaluation.cases import fly_cases
from koz_jax.evaluation.summary import Summary, summarise
from koz_jax.sac.networks import Encoding, encode
from koz_jax.task import observation
from koz_jax.task.observation_layout import ACTION_SIZE
from koz_jax.task.state import EnvState, Model

# Scenarios by which policies are compared while they learn; no training and no final table draws them.
_EVAL_SEED = 3_141_592_653


class MlpController(Memoryless):
    """tanh of a network's first outputs, on normalised observations: the deterministic policy of all of them."""

    mean: jax.Array  # (16,)
    std: jax.Array  # (16,)
    weights: tuple[jax.Array, ...]  # (inputs, outputs) each
    biases: tuple[jax.Array, ...]  # (outputs,) each
    activation: Callable[[jax.Array], jax.Array] = struct.field(pytree_node=False)
    encoding: Encoding = struct.field(pytree_node=False, default=())

    def act(self, observed: jax.Array) -> jax.Array:
        """Action (3,) in [-1, 1] for an observation (16,)."""
        hidden = encode((observed - self.mean) / self.std, self.encoding)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = self.activation(hidden @ weight + bias)
        return jnp.tanh(hidden @ self.weights[-1] + self.biases[-1])[:ACTION_SIZE]

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """Action (3,) in [-1, 1] for the state, by its observation."""
        return self.act(observation.observe(state)), memory


def evaluate(controller: MlpController, task: TaskConfig, cases: int, seed: int = _EVAL_SEED) -> Summary:
    """Fly the Monte Carlo of the paper (80 to 180 deg)."""
    return summarise(fly_cases(controller, task, MonteCarloConfig(cases=cases, seed=seed)))
