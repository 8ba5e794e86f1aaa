"""Graphs, and the shortest ways over them."""

import heapq
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from koz_jax.control.planning import icosphere, mrp_grid, shortest_way
from koz_jax.control.planning.shortest_way import Graph


def test_the_sphere_has_2562_directions_with_six_neighbours_and_twelve_with_five():
    sphere = icosphere.sphere(4)
    assert sphere.directions.shape == (2562, 3) and sphere.neighbours.shape == (2562, 6)
    np.testing.assert_allclose(np.linalg.norm(sphere.directions, axis=1), 1.0)
    assert np.bincount(np.isfinite(sphere.angles).sum(axis=1)).tolist() == [0, 0, 0, 0, 0, 12, 2550]
    found = np.rad2deg(sphere.angles[np.isfinite(sphere.angles)])
    assert 3.9 < found.min() and found.max() < 4.8


def test_the_grid_of_8_holds_every_attitude_in_both_signs():
    grid = mrp_grid.grid(8)
    count = len(grid.attitudes) // 2
    np.testing.assert_allclose(np.linalg.norm(grid.attitudes, axis=1), 1.0)
    np.testing.assert_allclose(grid.attitudes[count:], -grid.attitudes[:count])
    # MRPs on the grid, in its ball.
    sigmas = 7.0 * grid.attitudes[:count, 1:] / (1.0 + grid.attitudes[:count, :1])
    np.testing.assert_allclose(sigmas, np.rint(sigmas), atol=1e-9)
    within = np.stack(np.meshgrid(*3 * [np.arange(-7, 8)]), axis=-1).reshape(-1, 3)
    assert count == np.sum(np.sum(within**2, axis=1) <= 49) == len(np.unique(np.rint(sigmas), axis=0))
    # A step is a turn in the nearer sense, also one that leaves the ball.
    finite = np.isfinite(grid.angles)
    assert np.rad2deg(grid.angles[finite]).max() < 56.0
    leaves = (grid.neighbours[:count] >= count) & finite[:count]
    assert leaves.sum() > 1000 and np.linalg.norm(sigmas[leaves.any(axis=1)], axis=1).min() > 7.0 - 2.0 * np.sqrt(3.0)


@pytest.mark.parametrize("grid", [icosphere.sphere(4), mrp_grid.grid(8)], ids=["icosphere", "mrp"])
def test_neighbours_are_symmetric(grid):
    first, column = np.nonzero(np.isfinite(grid.angles))
    second = grid.neighbours[first, column]
    there = dict(zip(zip(first.tolist(), second.tolist(), strict=True), grid.angles[first, column], strict=True))
    assert len(there) == len(first)
    assert all(there[j, i] == pytest.approx(angle) for (i, j), angle in there.items())
    assert all(i != j for i, j in there)


def dijkstra(neighbours, costs, last):
    """Least costs to the goal, one node after the other."""
    found = np.array(last, float)
    queue = [(cost, node) for node, cost in enumerate(found) if np.isfinite(cost)]
    heapq.heapify(queue)
    while queue:
        cost, node = heapq.heappop(queue)
        if cost > found[node]:
            continue
        for other, step in zip(neighbours[node], costs[node], strict=True):
            if cost + step < found[other]:
                found[other] = cost + step
                heapq.heappush(queue, (cost + step, other))
    return found


@jax.jit
def _search(graph, first, last):
    to_go = shortest_way.costs_to_go(graph, last)
    return to_go, *shortest_way.follow(graph, to_go, first, last, 160)


def test_ways_are_as_short_as_dijkstra_s():
    sphere = icosphere.sphere(4)
    random = np.random.default_rng(0)
    # Four directions in ten are closed, so that ways wind, and some directions are cut off.
    closed = random.uniform(size=2562) < 0.4
    closed[[5, 1000]] = False
    costs = np.where(closed[:, None] | closed[sphere.neighbours], np.inf, sphere.angles)
    first, last = np.full(2562, np.inf), np.full(2562, np.inf)
    first[5], last[1000] = 0.3, 0.2
    to_go, nodes, found = _search(
        Graph(jnp.asarray(sphere.neighbours), jnp.asarray(costs, jnp.float32)),
        jnp.asarray(first, jnp.float32),
        jnp.asarray(last, jnp.float32),
    )
    expected = dijkstra(sphere.neighbours, costs, last)
    np.testing.assert_allclose(to_go, expected, rtol=1e-5)
    assert 0 < np.isinf(expected[~closed]).sum() < 1000
    nodes = np.asarray(nodes)
    assert bool(found) and nodes[0] == 5 and nodes[-1] == 1000
    way = nodes[: np.argmax(nodes == 1000) + 1]
    steps = [costs[i, list(sphere.neighbours[i]).index(j)] for i, j in itertools.pairwise(way)]
    assert sum(steps) + 0.2 == pytest.approx(expected[5], rel=1e-5)
