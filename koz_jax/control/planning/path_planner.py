"""Attitude path planning around the zones, tracked by feedback.

Before the maneuver a path is searched for: candidates bend the eigen-axis turn aside, each is timed as fast as the
torque box allows, and the fastest that keeps its distance from all zones is refined by a cross-entropy search.  After
Frazzoli, Dahleh, Feron & Kornfeld, "A randomized attitude slew planning algorithm for autonomous spacecraft" (AIAA GNC
2001), and Kjellberg & Lightsey, "Discretized constrained attitude pathfinding and control for satellites" (JGCD 2013),
who search a tree and a grid of attitudes instead.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.control import feedback
from koz_jax.control.planning import attitude_path
from koz_jax.control.planning.attitude_path import AttitudePath, Timing
from koz_jax.control.planning.path_tracking import PathTracker
from koz_jax.task import rotations
from koz_jax.task.state import EnvState, Model

# Bends that are tried first [deg], and to how many sides.
_BENDS_DEG = (30.0, 50.0, 80.0, 120.0)
_SIDES = 8

# Standard deviation [rad] of the first sine's amplitude in the first and in the last round; less for further sines.
_SPREADS = (0.3, 0.03)


class _Found(struct.PyTreeNode):
    """Where a search stands."""

    mean_B: jax.Array  # (sines, 3) [rad] of the better candidates
    best_B: jax.Array  # (sines, 3) [rad]


class PathPlanner(PathTracker):
    """Bends the eigen-axis turn, and is otherwise a ``PathTracker``, whose gains are tuned for it."""

    sines: int = struct.field(pytree_node=False, default=2)  # of the bend
    candidates: int = struct.field(pytree_node=False, default=32)  # of a round, or as many as there are first bends
    rounds: int = struct.field(pytree_node=False, default=16)

    def staying(self, state: EnvState) -> AttitudePath:
        """No turn."""
        return AttitudePath(state.body.q_BN, jnp.zeros(3), jnp.zeros((self.sines, 3)))

    def search(self, state: EnvState, model: Model, key: jax.Array) -> tuple[AttitudePath, Timing]:
        """Search for the fastest bend that keeps its distance."""

        def bent(bends_B: jax.Array) -> AttitudePath:
            return attitude_path.from_state(state.body, state.scenario.q_DN, bends_B)

        def cost(bends_B: jax.Array) -> jax.Array:
            return self.judged(bent(bends_B), state, model)[0]

        path = bent(self._refined(cost, self._first_bends(state), key))
        return path, self.timed(path, state, model)[1]

    def _refined(self, cost: Callable[[jax.Array], jax.Array], first_B: jax.Array, key: jax.Array) -> jax.Array:
        """Cross-entropy search from the best of the first bends (n, sines, 3).  Returns the best found (sines, 3)."""
        order = 1.0 / jnp.arange(1.0, self.sines + 1)[None, :, None]
        elite = max(len(first_B) // 4, 1)
        weights = jnp.log(elite + 0.5) - jnp.log(jnp.arange(1.0, elite + 1))

        def refine(found: _Found, draw: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[_Found, None]:
            key_round, spread, is_first = draw
            changes_B = spread * order * jax.random.normal(key_round, first_B.shape)
            around_B = (found.mean_B[None] + changes_B).at[0].set(found.best_B)
            tried_B = jnp.where(is_first, first_B, around_B)
            best_first = tried_B[jnp.argsort(jax.vmap(cost)(tried_B))]
            mean_B = jnp.tensordot(weights / jnp.sum(weights), best_first[:elite], axes=1)
            return _Found(jnp.where(is_first, best_first[0], mean_B), best_first[0]), None

        # The first bends are a round like the others, so that what a path costs is in the program once.
        keys = jnp.concatenate([key[None], jax.random.split(key, self.rounds)])
        spreads = jnp.concatenate([jnp.zeros(1), jnp.geomspace(*_SPREADS, self.rounds)])
        draws = (keys, spreads, jnp.arange(self.rounds + 1) == 0)
        return jax.lax.scan(refine, _Found(first_B[0], first_B[0]), draws)[0].best_B

    def _first_bends(self, state: EnvState) -> jax.Array:
        """Bends to all sides, by several angles; again, where a round has more.  Returns (n, sines, 3) [rad]."""
        straight = attitude_path.from_state(state.body, state.scenario.q_DN, jnp.zeros((self.sines, 3)))
        half_way = feedback.from_rotation_vector(-0.5 * straight.turn_B)
        look_B = rotations.rotate(half_way, state.scenario.constraints.boresight_B[0])
        # A turn about an axis square to the boresight moves it most.
        square_B = rotations.cross(look_B, jnp.eye(3)[jnp.argmin(jnp.abs(look_B))])
        square_B = rotations.normalize(square_B)
        across_B = rotations.cross(look_B, square_B)
        sides = jnp.arange(_SIDES) * (2.0 * jnp.pi / _SIDES)
        axes_B = jnp.cos(sides)[:, None] * square_B[None] + jnp.sin(sides)[:, None] * across_B[None]
        bends_B = (jnp.deg2rad(jnp.array(_BENDS_DEG))[:, None, None] * axes_B[None]).reshape(-1, 1, 3)
        rest = jnp.zeros((bends_B.shape[0], self.sines - 1, 3))
        count = max(self.candidates, len(bends_B))
        return jnp.resize(jnp.concatenate([bends_B, rest], axis=1), (count, self.sines, 3))
