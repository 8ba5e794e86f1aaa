"""A random tree of attitudes, grown from the start until it sees the target.

After Frazzoli, Dahleh, Feron & Kornfeld, "A randomized attitude slew planning algorithm for autonomous spacecraft"
(AIAA GNC 2001, AIAA 2001-4155): the tree grows towards attitudes drawn at random, from its nearest node and as far as
the turn there is free of zones, and every new node tries to turn straight to the target.  The shortest way of all that
get there is taken.  All instruments are looked at, and zones where they are at the start.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.control.planning import smoothing, spline_path
from koz_jax.control.planning.way_planner import WayPlanner
from koz_jax.task import rotations
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.state import EnvState, Model


class _Tree(NamedTuple):
    """Leaves (nodes, ...): the start is the first; those not yet grown are infinitely far."""

    attitudes: jax.Array  # (nodes, 4)
    parents: jax.Array  # (nodes,) int32
    angles: jax.Array  # (nodes,) [rad] turned since the start
    to_go: jax.Array  # (nodes,) [rad] straight to the target; infinite where a zone is between


class RRT(WayPlanner):
    """Grows a tree of so many nodes in every maneuver."""

    nodes: int = struct.field(pytree_node=False, default=2048)
    hops: int = struct.field(pytree_node=False, default=64)  # of a way, at most
    samples: int = struct.field(pytree_node=False, default=16)  # of a turn, at which its margin is looked at
    samples_to_go: int = struct.field(pytree_node=False, default=64)  # the same of a turn to the target
    least: float = 0.0087  # () [rad] margin of the tree
    reach: float = 0.7  # () [rad] longest turn from a node to the next

    def way(self, state: EnvState, model: Model, key: jax.Array) -> jax.Array:
        """Shortest way in the tree, or straight to the target where it has none.  Returns (hops + 2, 4)."""
        tree = self._grown(state, key)
        best = jnp.argmin(tree.angles + tree.to_go)
        best = jnp.where(jnp.isfinite(tree.angles[best] + tree.to_go[best]), best, 0)

        def back(node: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
            return tree.parents[node], tree.attitudes[node]

        _, backwards = jax.lax.scan(back, best, None, length=self.hops)
        return jnp.concatenate([tree.attitudes[:1], backwards[::-1], state.scenario.q_DN[None]])

    def _grown(self, state: EnvState, key: jax.Array) -> _Tree:
        zones, goal = state.scenario.constraints, state.scenario.q_DN
        start = state.body.q_BN

        def grow(tree: _Tree, draw: tuple[jax.Array, jax.Array]) -> tuple[_Tree, None]:
            place, key_node = draw
            nearest, attitude = self._extended(tree, self._drawn(start, goal, key_node), zones)
            turned = rotations.norm(spline_path.turn(tree.attitudes[nearest], attitude))
            return _Tree(
                tree.attitudes.at[place].set(attitude),
                tree.parents.at[place].set(nearest),
                tree.angles.at[place].set(tree.angles[nearest] + turned),
                tree.to_go.at[place].set(self._straight(attitude, goal, zones)),
            ), None

        unknown = jnp.full(self.nodes, jnp.inf)
        planted = _Tree(
            jnp.tile(start[None], (self.nodes, 1)),
            jnp.zeros(self.nodes, jnp.int32),
            unknown.at[0].set(0.0),
            unknown.at[0].set(self._straight(start, goal, zones)),
        )
        draws = jnp.arange(1, self.nodes), jax.random.split(key, self.nodes - 1)
        return jax.lax.scan(grow, planted, draws)[0]

    def _drawn(self, start: jax.Array, goal: jax.Array, key: jax.Array) -> jax.Array:
        """Any attitude, in the sign that is nearer to start and target.  Returns (4,)."""
        # In the axes of the target, so that it makes no difference how the inertial ones are turned.
        drawn = rotations.multiply(goal, rotations.normalize(jax.random.normal(key, (4,))))
        return jnp.where(rotations.dot(drawn, start + goal) < 0.0, -drawn, drawn)

    def _extended(self, tree: _Tree, towards: jax.Array, zones: PointingConstraint) -> tuple[jax.Array, jax.Array]:
        """Nearest node () to an attitude (4,), and how far one can turn from there (4,)."""
        likeness = jnp.where(jnp.isfinite(tree.angles), tree.attitudes @ towards, -jnp.inf)
        nearest = jnp.argmax(likeness)
        begin = tree.attitudes[nearest]
        turn_B = spline_path.turn(begin, towards)
        turn_B = turn_B * jnp.minimum(1.0, self.reach / jnp.maximum(rotations.norm(turn_B), 1e-6))
        between, margins = _along(begin, turn_B, self.samples, zones)
        free = jnp.cumprod(margins >= jnp.minimum(self.least, margins[0]))
        return nearest, between[jnp.sum(free.astype(jnp.int32)) - 1]

    def _straight(self, begin: jax.Array, goal: jax.Array, zones: PointingConstraint) -> jax.Array:
        """Angle () [rad] of the turn from an attitude (4,) to the target (4,), infinite where it meets a zone."""
        turn_B = spline_path.turn(begin, goal)
        _, margins = _along(begin, turn_B, self.samples_to_go, zones)
        needed = jnp.minimum(self.least, jnp.minimum(margins[0], margins[-1]))
        return jnp.where(jnp.min(margins) >= needed, rotations.norm(turn_B), jnp.inf)


def _along(begin: jax.Array, turn_B: jax.Array, count: int, zones: PointingConstraint) -> tuple[jax.Array, jax.Array]:
    """Attitudes (count, 4) of a turn (3,) [rad] from an attitude (4,) on, and their margins (count,) [rad]."""
    shares = jnp.linspace(0.0, 1.0, count)
    between = jax.vmap(lambda share: spline_path.turned(begin, share * turn_B))(shares)
    return between, smoothing.margins_along(between, zones)
