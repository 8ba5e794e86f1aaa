"""Attitudes on a uniform grid of modified Rodrigues parameters.  NumPy, once for a program.

The grid fills the ball |sigma| <= 1, which holds every attitude.  Beyond it lies the shadow set -sigma / |sigma|^2, the
same attitudes with the opposite sign of their quaternion.  As a maneuver ends at one sign, the ball is here twice, and
a step that leaves one of them enters the other.
"""

import functools
from typing import NamedTuple

import numpy as np

from koz_jax.control.planning import shortest_way

# Steps from a node to those around it.
_STEPS = np.array([(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) != (0, 0, 0)])


class Grid(NamedTuple):
    """Both balls; node i + n is node i with the opposite sign."""

    attitudes: np.ndarray  # (2 n, 4) unit quaternions
    neighbours: np.ndarray  # (2 n, most) int32, filled up with the node itself
    angles: np.ndarray  # (2 n, most) [rad] of the turns to them; infinite to itself


@functools.cache
def grid(half_axis: int) -> Grid:
    """The grid with so many nodes along each half axis, 0 and 1 among them (N of Calaon & Schaub)."""
    last = half_axis - 1
    axis = np.arange(-last, last + 1)
    cells = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = cells[np.sum(cells**2, axis=1) <= last**2]
    count = len(cells)
    place = np.full((2 * last + 1,) * 3, -1)
    place[tuple((cells + last).T)] = np.arange(count)

    here = np.repeat(np.arange(count), len(_STEPS))
    there = (cells[:, None] + _STEPS[None]).reshape(-1, 3)
    crosses = np.sum(there**2, axis=1) > last**2
    squared = np.maximum(np.sum((there / last) ** 2, axis=1, keepdims=True), 1e-9)
    shadow = np.rint(-there / squared).astype(int)
    landed = np.where(crosses[:, None], shadow, there)
    inside = np.all(np.abs(landed) <= last, axis=1)
    here, crosses, landed = here[inside], crosses[inside], landed[inside]
    other = place[tuple((landed + last).T)]
    known = other >= 0
    here, other = here[known], other[known] + count * crosses[known]

    pairs = np.stack([here, other], axis=1)
    pairs = np.concatenate([pairs, (pairs + count) % (2 * count)])
    neighbours = shortest_way.neighbour_table(2 * count, np.concatenate([pairs, pairs[:, ::-1]]))
    sigmas = cells / last
    norms = np.sum(sigmas**2, axis=1, keepdims=True)
    attitudes = np.concatenate([1.0 - norms, 2.0 * sigmas], axis=1) / (1.0 + norms)
    attitudes = np.concatenate([attitudes, -attitudes])
    return Grid(attitudes, neighbours, _angles(attitudes, neighbours))


def _angles(attitudes: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    likeness = np.sum(attitudes[:, None] * attitudes[neighbours], axis=2)
    alone = neighbours == np.arange(len(attitudes))[:, None]
    # A node on the surface is in both balls: a step between them is short, and costs something all the same.
    return np.where(alone, np.inf, np.maximum(2.0 * np.arccos(np.clip(likeness, -1.0, 1.0)), 1e-3))
