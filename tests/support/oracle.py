"""Float64 twin of the core, from the paper's equations, with SciPy's rotations and integrator.

It shares no code with the package, and integrates adaptively where the package takes fixed steps.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation, Slerp

INERTIA = np.array([[60.0, 5.0, 1.0], [5.0, 50.0, 2.0], [1.0, 2.0, 70.0]])
BORESIGHT = np.array([1.0, 0.0, 0.0])
TORQUE_LIMIT = 2.0
DT = 0.1
SETTLED = np.deg2rad(0.25)


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Table 1.  Not SciPy's composition, which does not promise the sign of the quaternion."""
    return np.array([a[0] * b[0] - a[1:] @ b[1:], *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])


def conjugate(q: np.ndarray) -> np.ndarray:
    return np.array([q[0], *-q[1:]])


def rotation(q: ArrayLike) -> Rotation:
    return Rotation.from_quat(np.asarray(q, np.float64), scalar_first=True)


def half_way(q_start: ArrayLike, q_end: ArrayLike) -> Rotation:
    """The middle of the shortest rotation between two attitudes."""
    return Slerp([0.0, 1.0], rotation(np.stack([np.asarray(q_start), np.asarray(q_end)])))(0.5)


def angle_between(a: ArrayLike, b: ArrayLike) -> np.ndarray:
    """Angles between vectors along the last axis."""
    a, b = np.broadcast_arrays(np.asarray(a, np.float64), np.asarray(b, np.float64))
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def rotation_angle(q: ArrayLike) -> np.ndarray:
    """Full rotation angle in [0, 2 pi], the sign of q kept.  q: (..., 4)."""
    q = np.asarray(q, np.float64)
    return 2.0 * np.arctan2(np.linalg.norm(q[..., 1:], axis=-1), q[..., 0])


def propagate(
    q: np.ndarray, omega: np.ndarray, torque: np.ndarray, seconds: float, inertia: np.ndarray = INERTIA
) -> tuple[np.ndarray, np.ndarray]:
    """Attitude and rate after a time under a constant body torque."""

    def slope(_: float, x: np.ndarray) -> np.ndarray:
        w = x[4:]
        return np.concatenate(
            [0.5 * product(x[:4], np.array([0.0, *w])), np.linalg.solve(inertia, torque - np.cross(w, inertia @ w))]
        )

    start = np.concatenate([q, omega]).astype(np.float64)
    end = solve_ivp(slope, (0.0, seconds), start, method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
    return end[:4] / np.linalg.norm(end[:4]), end[4:]


def propagate_many(
    q: np.ndarray, omega: np.ndarray, torque: np.ndarray, seconds: float, inertia: np.ndarray = INERTIA
) -> tuple[np.ndarray, np.ndarray]:
    """``propagate`` of n states at once: Runge-Kutta steps so short that they are exact to 1e-9.

    q: (n, 4); omega, torque: (n, 3).
    """
    inverse = np.linalg.inv(inertia)

    def slope(q: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        scalar = -np.sum(q[:, 1:] * w, axis=1, keepdims=True)
        vector = q[:, :1] * w + _cross(q[:, 1:], w)
        return 0.5 * np.hstack([scalar, vector]), (torque - _cross(w, w @ inertia.T)) @ inverse.T

    # No step turns the body by more than this [rad], whatever the torque adds to its rate.
    fastest = np.linalg.norm(omega, axis=1) + seconds * np.linalg.norm(torque @ inverse.T, axis=1)
    count = max(int(np.ceil(seconds * fastest.max(initial=0.0) / 0.02)), 1)
    h = seconds / count
    for _ in range(count):
        k1 = slope(q, omega)
        k2 = slope(q + h / 2 * k1[0], omega + h / 2 * k1[1])
        k3 = slope(q + h / 2 * k2[0], omega + h / 2 * k2[1])
        k4 = slope(q + h * k3[0], omega + h * k3[1])
        q, omega = (
            x + h / 6 * (a + 2 * b + 2 * c + d) for x, a, b, c, d in zip((q, omega), k1, k2, k3, k4, strict=True)
        )
    return q / np.linalg.norm(q, axis=1, keepdims=True), omega


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``np.cross`` of (n, 3), which takes longer to find its axes than to multiply."""
    return a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]]


def margins(q: np.ndarray, boresight: np.ndarray, axes: np.ndarray, half_angles: np.ndarray) -> np.ndarray:
    """theta - theta_F for each of several zones (n, 3), (n,); boresight: (3,), or (n, 3) with one for each."""
    return angle_between(rotation(q).apply(boresight), axes) - half_angles


def observation(
    q: np.ndarray,
    omega: np.ndarray,
    q_target: np.ndarray,
    axis: np.ndarray,
    half_angle: float,
    q_e0_previous: float,
    boresight: np.ndarray = BORESIGHT,
) -> np.ndarray:
    """Eq. 6: q_e, w, r, theta_margin, theta, dn, q_e0 one step ago."""
    q_e = product(conjugate(q_target), q)
    towards = rotation(q).inv().apply(axis) - boresight
    theta = angle_between(rotation(q).apply(boresight), axis)
    direction = towards / np.linalg.norm(towards)
    return np.array([*q_e, *omega, *boresight, theta - half_angle, theta, *direction, q_e0_previous])


def reward_terms(
    phi: float, phi_previous: float, torque: np.ndarray, torque_previous: np.ndarray | None, margin: float
) -> dict[str, float]:
    """Eq. 7 to 9, signed as they enter the sum; ``torque_previous`` is None in the first step."""
    change = 0.0 if torque_previous is None else float(np.linalg.norm(torque - torque_previous))
    return {
        "attitude": float(np.exp(-phi / (0.14 * 2 * np.pi))),
        "settled": 9.0 if phi <= SETTLED else 0.0,
        "torque": -0.05 * float(np.linalg.norm(torque)) / (2.0 * np.sqrt(3.0)),
        "torque_change": -0.005 * change,
        "zone": -10.0 if margin <= 0 else -10.0 * float(np.exp(-66.0 * margin)),
        "no_progress": 0.0 if phi < phi_previous else -1.0,
    }


def settling_time(phi: np.ndarray, dt: float = DT, settled: float = SETTLED) -> float:
    """First time from which phi stays within the accuracy to the end; nan if there is none.  phi: (steps + 1,)."""
    for k in range(len(phi)):
        if np.all(phi[k:] <= settled):
            return k * dt
    return float("nan")


def judge(phi: np.ndarray, torque: np.ndarray, margin: np.ndarray) -> dict[str, float]:
    """The metrics of one case.  phi, margin: (steps + 1,) with the start first; torque: (steps, 3)."""
    total = 0.0
    for t in range(len(torque)):
        before = torque[t - 1] if t else None
        total += sum(reward_terms(phi[t + 1], phi[t], torque[t], before, margin[t + 1]).values())
    return {
        "reward": total,
        "settling_time": settling_time(phi),
        "control_effort": float(np.sum(torque**2) * DT),
        "control_accuracy": float(phi[-1]),
        "min_margin": float(np.min(margin)),
        "settled": bool(phi[-1] <= SETTLED),
        "violated": bool(np.any(margin <= 0)),
    }


def random_attitude(rng: np.random.Generator) -> np.ndarray:
    """Uniform over rotations, both signs."""
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def random_direction(rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def random_inertia(rng: np.random.Generator) -> np.ndarray:
    """Inertia of a physical body: principal moments that obey the triangle inequality, in random axes."""
    squares = rng.uniform(5.0, 40.0, size=3)
    axes = rotation(random_attitude(rng)).as_matrix()
    return axes @ np.diag(squares.sum() - squares) @ axes.T
