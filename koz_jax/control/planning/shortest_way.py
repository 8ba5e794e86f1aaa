"""Shortest ways over the nodes of a graph, in fixed shapes: what A* finds, for all nodes at once.

A* opens one node after the other from a queue; here all nodes ask their neighbours at the same time, again and again
until nothing changes (R. Bellman, "On a routing problem", 1958).  A graph is a table of the neighbours of each node,
filled up with the node itself at an infinite cost.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct


class Graph(struct.PyTreeNode):
    """Nodes, and what it costs to go from each to its neighbours."""

    neighbours: jax.Array  # (nodes, most) int32
    costs: jax.Array  # (nodes, most) more than 0; infinite where there is no way


def costs_to_go(graph: Graph, last: jax.Array) -> jax.Array:
    """Least cost from each node to the goal.  last: (nodes,) from each straight to it.  Returns (nodes,)."""

    def through_neighbours(found: jax.Array) -> jax.Array:
        return jnp.minimum(found, jnp.min(graph.costs + found[graph.neighbours], axis=1))

    def ask(pair: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return pair[1], through_neighbours(pair[1])

    return jax.lax.while_loop(lambda pair: jnp.any(pair[1] < pair[0]), ask, (last, through_neighbours(last)))[1]


def follow(graph: Graph, to_go: jax.Array, first: jax.Array, last: jax.Array, hops: int) -> tuple[jax.Array, jax.Array]:
    """Nodes (hops,) of the shortest way, the last of them again and again, and whether it reaches the goal () bool.

    to_go: (nodes,) by ``costs_to_go``; first: (nodes,) cost from the start straight to each; last: as there.
    """

    def step(node: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        onward = graph.costs[node] + to_go[graph.neighbours[node]]
        return jnp.where(last[node] <= jnp.min(onward), node, graph.neighbours[node, jnp.argmin(onward)]), node

    begin = jnp.argmin(first + to_go)
    end, nodes = jax.lax.scan(step, begin, None, length=hops)
    return nodes, jnp.isfinite(first[begin] + to_go[begin]) & (end == nodes[-1])


def neighbour_table(count: int, pairs: np.ndarray) -> np.ndarray:
    """Second indices of pairs (n, 2) of each first one, filled up with itself.  Returns (count, most) int32."""
    pairs = np.unique(pairs, axis=0)
    first, second = pairs.T
    most = int(np.bincount(first, minlength=count).max())
    places = np.arange(len(pairs)) - np.searchsorted(first, first)
    found = np.tile(np.arange(count, dtype=np.int32)[:, None], (1, most))
    found[first, places] = second
    return found
