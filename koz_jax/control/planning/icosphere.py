"""A sphere in triangles: an icosahedron whose faces are halved again and again.  NumPy, once for a program."""

import functools
from typing import NamedTuple

import numpy as np

from koz_jax.control.planning import shortest_way


class Sphere(NamedTuple):
    """Directions that are spread evenly, and which are next to each other."""

    directions: np.ndarray  # (10 * 4^halvings + 2, 3) unit vectors
    neighbours: np.ndarray  # (directions, 6) int32; twelve have five, and themselves as the sixth
    angles: np.ndarray  # (directions, 6) [rad] to each; infinite to itself


@functools.cache
def sphere(halvings: int) -> Sphere:
    """Halve the edges of an icosahedron so often: 4 times gives 2,562 directions, about 4 deg apart."""
    golden = (1.0 + np.sqrt(5.0)) / 2.0
    corners = np.array([(0.0, one, other * golden) for one in (-1, 1) for other in (-1, 1)])
    directions = np.concatenate([np.roll(corners, shift, axis=1) for shift in range(3)])
    near = np.linalg.norm(directions[:, None] - directions[None], axis=2) < 2.1
    faces = np.array([(i, j, k) for i, j in _pairs(near) for k in range(j + 1, 12) if near[i, k] and near[j, k]])
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    for _ in range(halvings):
        directions, faces = _halved(directions, faces)
    edges = _edges(faces)
    neighbours = shortest_way.neighbour_table(len(directions), np.concatenate([edges, edges[:, ::-1]]))
    cosines = np.sum(directions[:, None] * directions[neighbours], axis=2)
    alone = neighbours == np.arange(len(directions))[:, None]
    return Sphere(directions, neighbours, np.where(alone, np.inf, np.arccos(np.clip(cosines, -1.0, 1.0))))


def _pairs(near: np.ndarray) -> list[tuple[int, int]]:
    return [(i, j) for i, j in np.argwhere(near) if i < j]


def _edges(faces: np.ndarray) -> np.ndarray:
    """Every edge (edges, 2) once, lower index first."""
    return np.unique(np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)


def _halved(directions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    edges = _edges(faces)
    middles = directions[edges[:, 0]] + directions[edges[:, 1]]
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    middle_of = {(i, j): len(directions) + place for place, (i, j) in enumerate(edges.tolist())}
    parts = []
    for a, b, c in faces.tolist():
        ab, bc, ca = (middle_of[min(pair), max(pair)] for pair in ((a, b), (b, c), (c, a)))
        parts += [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]
    return np.concatenate([directions, middles]), np.array(parts)
