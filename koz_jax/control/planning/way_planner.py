"""Base of planners that search a graph or a tree of attitudes: what they find is smoothed, timed and tracked."""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.control.planning import smoothing, spline_path
from koz_jax.control.planning.attitude_path import Timing
from koz_jax.control.planning.path_tracking import PathTracker
from koz_jax.control.planning.spline_path import SplinePath
from koz_jax.task.state import EnvState, Model


class WayPlanner(PathTracker):
    """Finds a way of corners by ``way``, and flies the fastest of smoother and smoother paths that keeps its margin."""

    points: int = struct.field(pytree_node=False, default=129)  # of a path
    eased: int = struct.field(pytree_node=False, default=32)  # steps of smoothing
    tried: int = struct.field(pytree_node=False, default=8)  # of which so many are timed

    def way(self, state: EnvState, model: Model, key: jax.Array) -> jax.Array:
        """Search for a way.  key: () typed PRNG key.  Returns (n, 4) attitudes, from the state's to the target's.

        Neighbours have one sign, and the eigen-axis turns between them are free of zones.
        """
        raise NotImplementedError

    def staying(self, state: EnvState) -> SplinePath:
        """No turn."""
        return spline_path.along(jnp.tile(state.body.q_BN, (self.points, 1)))

    def search(self, state: EnvState, model: Model, key: jax.Array) -> tuple[SplinePath, Timing]:
        """Search for a way, and smooth it."""
        return self.smoothed(self.way(state, model, key), state, model)

    def smoothed(self, way: jax.Array, state: EnvState, model: Model) -> tuple[SplinePath, Timing]:
        """Smooth a way (n, 4) of attitudes as far as that makes it faster."""
        zones = state.scenario.constraints
        short = smoothing.shortcut(spline_path.evenly(way, self.points), zones, self.margin)
        short = spline_path.evenly(short, self.points)
        smoother = smoothing.eased(short, zones, self.margin, self.eased)
        last = jnp.linspace(0, self.eased - 1, self.tried).astype(jnp.int32)
        paths = jax.vmap(spline_path.along)(jnp.concatenate([short[None], smoother[last]]))
        costs, timings = jax.vmap(lambda path: self.judged(path, state, model))(paths)
        best = jnp.argmin(jnp.where(jnp.isfinite(costs), costs, jnp.inf))
        return jax.tree.map(lambda leaf: leaf[best], (paths, timings))
