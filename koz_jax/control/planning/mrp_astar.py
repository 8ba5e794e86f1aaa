"""The shortest way over a uniform grid of modified Rodrigues parameters, forbidden attitudes dropped.

After Calaon & Schaub, "Constrained attitude maneuvering via modified-Rodrigues-parameter-based motion planning
algorithms" (Journal of Spacecraft and Rockets 59(4), 2022).  All instruments and kinds of cones are looked at, where
they are at the start.  They test the nodes; here the steps between nodes are tested too, at some attitudes of each, as
they are longer than zones are wide.
"""

import jax
import jax.numpy as jnp
from flax import struct
from jax.custom_batching import sequential_vmap

from koz_jax.control.planning import mrp_grid, shortest_way, smoothing
from koz_jax.control.planning.shortest_way import Graph
from koz_jax.control.planning.way_planner import WayPlanner
from koz_jax.task import rotations
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.state import EnvState, Model

# What a turn costs where a zone is at no distance, over what it costs at ``margin`` and farther.
_DEAREST = 5.0

# Attitudes inside a step that are tested, in shares of it.
_BETWEEN = (0.25, 0.5, 0.75)


class MRPAStar(WayPlanner):
    """Searches a grid of attitudes relative to the target."""

    half_axis: int = struct.field(pytree_node=False, default=8)  # nodes along each half axis: N of the paper
    hops: int = struct.field(pytree_node=False, default=128)  # of a way, at most
    least: float = 0.0087  # () [rad] margin of what is not forbidden

    def way(self, state: EnvState, model: Model, key: jax.Array) -> jax.Array:
        """Shortest way over the grid, or straight to the target where it has none.  Returns (hops + 2, 4)."""
        q_DN = state.scenario.q_DN
        to_target = rotations.conjugate(q_DN)
        q_BD = rotations.multiply(to_target, state.body.q_BN)
        zones = state.scenario.constraints
        axes_D = jax.vmap(rotations.rotate, in_axes=(None, 0))(to_target, zones.axis_N)
        # Of a batch one after the other, for memory.
        found = sequential_vmap(_shortest)(self, q_BD, zones.replace(axis_N=axes_D))
        return jax.vmap(rotations.multiply, in_axes=(None, 0))(q_DN, found)


def _shortest(planner: MRPAStar, q_BD: jax.Array, zones: PointingConstraint) -> jax.Array:
    """Way from an attitude (4,) to the identity.  Returns (hops + 2, 4)."""
    grid = mrp_grid.grid(planner.half_axis)
    attitudes, neighbours = jnp.asarray(grid.attitudes, jnp.float32), jnp.asarray(grid.neighbours)
    margins = smoothing.margins_along(attitudes, zones)
    dear = 1.0 + (_DEAREST - 1.0) * jnp.clip(1.0 - margins / planner.margin, 0.0, 1.0)
    dear = jnp.where(margins > planner.least, dear, jnp.inf)

    def to_neighbour(column: jax.Array) -> jax.Array:
        return jax.vmap(_is_free, in_axes=(0, 0, None, None))(attitudes, attitudes[column], zones, planner.least)

    # One neighbour of each node after the other, for memory.
    free = jax.lax.map(to_neighbour, neighbours.T).T
    angles = jnp.asarray(grid.angles, jnp.float32)
    graph = Graph(neighbours, jnp.where(free, 0.5 * angles * (dear[:, None] + dear[neighbours]), jnp.inf))
    target = jnp.eye(4)[0]

    def joined(end: jax.Array) -> jax.Array:
        needed = jnp.minimum(planner.least, smoothing.margins_along(end[None], zones)[0] - 1e-4)
        apart = jax.vmap(rotations.angle_between, in_axes=(None, 0))(end, attitudes) * 2.0
        free = jax.vmap(_is_free, in_axes=(None, 0, None, None))(end, attitudes, zones, needed)
        return jnp.where(free & (apart < 4.0 / (planner.half_axis - 1)), apart * dear, jnp.inf)

    first, last = joined(q_BD), joined(target)
    to_go = shortest_way.costs_to_go(graph, last)
    nodes, found = shortest_way.follow(graph, to_go, first, last, planner.hops)
    return jnp.concatenate([q_BD[None], jnp.where(found, attitudes[nodes], target[None]), target[None]])


def _is_free(begin: jax.Array, end: jax.Array, zones: PointingConstraint, least: jax.Array | float) -> jax.Array:
    """Whether a margin () [rad] is kept between two attitudes (4,).  Returns () bool."""

    def keeps(share: jax.Array) -> jax.Array:
        q = rotations.normalize(begin + share * (end - begin))
        looks = jax.vmap(rotations.rotate, in_axes=(None, 0))(q, zones.boresight_B)
        # Cosines, as there are many.
        nearness = jax.vmap(rotations.dot)(looks, zones.axis_N)
        return jnp.all((nearness < jnp.cos(zones.half_angle + least)) | ~zones.is_present)

    return jnp.all(jax.vmap(keeps)(jnp.asarray(_BETWEEN)))
