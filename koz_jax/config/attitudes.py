"""Attitudes and directions as people write them: quaternions in NumPy, float64.  Imports no jax.

The same conventions as ``task.rotations``: scalar first, and ``q_BN`` takes body components to inertial ones.
"""

import numpy as np


def normalized(values: np.ndarray | tuple[float, ...]) -> np.ndarray:
    """v / |v|; what is of unit length to the last digits is left as it is.  values: (n,), not zero."""
    found = np.asarray(values, np.float64)
    length = np.linalg.norm(found)
    return found if abs(length - 1.0) < 1e-14 else found / length


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternion product a (x) b.  a: (..., 4), b: (4,).  Returns (..., 4)."""
    scalar = a[..., :1] * b[0] - a[..., 1:] @ b[1:, None]
    vector = a[..., :1] * b[1:] + b[0] * a[..., 1:] + np.cross(a[..., 1:], b[1:])
    return np.concatenate([scalar, vector], axis=-1)


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Components of q (x) (0, v) (x) q*.  With q = q_BN: v_B to v_N.  q: (..., 4), v: (3,).  Returns (..., 3)."""
    t = 2.0 * np.cross(q[..., 1:], v)
    return v + q[..., :1] * t + np.cross(q[..., 1:], t)


def turn_about(axis: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """Unit quaternion of a rotation.  axis: (3,) unit; angle: (...) [rad].  Returns (..., 4)."""
    half = 0.5 * np.asarray(angle)[..., None]
    return np.concatenate([np.cos(half), np.sin(half) * axis], axis=-1)


def shortest_arc(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The smallest rotation that takes one direction to another; of opposite ones, about an axis square to both.

    a, b: (3,) unit.  Returns (4,).
    """
    across = np.cross(a, b)
    if np.linalg.norm(across) < 1e-12:
        across = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
    return turn_about(normalized(across), float(angle_between(a, b)))


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between unit vectors, exact also near 0 and 180 deg.  a: (..., 3), b: (3,).  Returns (...) [rad]."""
    return 2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
