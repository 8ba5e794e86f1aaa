"""Exported controllers in the loop: what runs outside of jax, flown by the Monte Carlo of the core."""

from collections.abc import Callable

import jax
import numpy as np
from flax import struct

from koz_jax.numpy_policy import ACTION_SIZE


class HostController(struct.PyTreeNode):
    """A controller that asks a function of NumPy arrays at every step (see ``rollout.Controller``)."""

    decide: Callable[[np.ndarray], np.ndarray] = struct.field(pytree_node=False)
    """Actions (batch, 3) in [-1, 1] for observations (batch, 16), float32."""

    def act(self, observed: jax.Array) -> jax.Array:
        """Action (3,) for an observation (16,)."""
        shape = jax.ShapeDtypeStruct((ACTION_SIZE,), np.float32)
        return jax.pure_callback(self._ask, shape, observed, vmap_method="broadcast_all")

    def _ask(self, observed: np.ndarray) -> np.ndarray:
        rows = np.asarray(observed).reshape(-1, observed.shape[-1])
        return self.decide(rows).reshape(*observed.shape[:-1], ACTION_SIZE)
