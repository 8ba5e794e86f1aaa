"""Exported controllers in the loop: what runs outside of jax, flown by the Monte Carlo of the core."""

from collections.abc import Callable

import jax
import numpy as np
from flax import struct

from koz_jax.control.base import Memoryless
from koz_jax.task import observation
from koz_jax.task.any_spacecraft import nondimensional
from koz_jax.task.observation_layout import ACTION_SIZE
from koz_jax.task.state import EnvState, Model


class HostController(Memoryless):
    """A controller that asks a function of NumPy arrays at every step.

    Where it is ``scaled``, the function is of a policy for any spacecraft.
    """

    predict: Callable[[np.ndarray], np.ndarray] = struct.field(pytree_node=False)
    """Actions (batch, 3) in [-1, 1] for observations (batch, entries), float32."""
    observed_zones: int = struct.field(pytree_node=False, default=1)
    scaled: bool = struct.field(pytree_node=False, default=False)
    urgency: float = 0.5
    """From 0 to 1, where the policy sees one."""

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """Action (3,) in [-1, 1] for the state, by its observation."""
        if self.scaled:
            observed = nondimensional.observe(state, model, self.urgency, self.observed_zones)
            return nondimensional.command(self._decide(observed), state, model), memory
        return self._decide(observation.observe(state, self.observed_zones)), memory

    def _decide(self, observed: jax.Array) -> jax.Array:
        shape = jax.ShapeDtypeStruct((ACTION_SIZE,), np.float32)
        return jax.pure_callback(self._ask, shape, observed, vmap_method="broadcast_all")

    def _ask(self, observed: np.ndarray) -> np.ndarray:
        rows = np.asarray(observed).reshape(-1, observed.shape[-1])
        return self.predict(rows).reshape(*observed.shape[:-1], ACTION_SIZE)
