"""The torque nearest to a requested one within a box, half-spaces and an ellipsoid: a programme of three variables.

The nearest point of a polytope is the nearest one of the plane, line or corner that it lies on.  With three variables
these are few, so all are tried: no iteration, no tolerance of convergence.  The ellipsoid, a limit of the energy, is
weighed against the distance by a number in [0, 1], which is searched for where the limit is passed without it.
"""

import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from koz_jax.task import dynamics, rotations

# By so much, in shares of the box, rounding may pass a limit.
TOLERANCE = 1e-5

_TRIES = 25


class Halfspaces(struct.PyTreeNode):
    """Torques u with normals @ u <= limits."""

    normals: jax.Array  # (rows, 3) unit vectors; zeros for none
    limits: jax.Array  # (rows,) [N m]


class Ellipsoid(struct.PyTreeNode):
    """Torques u with u . form u + slope . u <= room."""

    form: jax.Array  # (3, 3), positive definite
    slope: jax.Array  # (3,)
    room: jax.Array  # ()

    def excess(self, torque_B: jax.Array) -> jax.Array:
        """What is above the room.  torque_B: (3,).  Returns ()."""
        return rotations.dot(torque_B, dynamics.matvec(self.form, torque_B) + self.slope) - self.room


class Solution(struct.PyTreeNode):
    """What was found."""

    torque_B: jax.Array  # (3,) [N m]; without meaning where there is none
    exists: jax.Array  # () bool


class _Bracket(struct.PyTreeNode):
    """Weights of the energy between which its limit is just kept."""

    low: jax.Array  # () with which the limit is passed
    high: jax.Array  # () with which it is kept
    over: jax.Array  # () excess with the one
    under: jax.Array  # () with the other
    torque_B: jax.Array  # (3,) with the other
    left: jax.Array  # () int32 tries


def nearest(requested_B: jax.Array, box_B: jax.Array, cones: Halfspaces, energy: Ellipsoid) -> Solution:
    """Find the torque nearest to a requested one (3,) [N m].  box_B: (3,) [N m] largest about each body axis."""
    # In shares of the largest torque, and with an ellipsoid whose slope and curvature are of the size of one.
    unit = jnp.max(box_B)
    steepness = unit * (jnp.sum(jnp.abs(energy.slope)) + unit * jnp.trace(energy.form))
    scaled = Ellipsoid(energy.form * unit**2 / steepness, energy.slope * unit / steepness, energy.room / steepness)
    best = _by_weight(requested_B / unit, box_B / unit, cones.replace(limits=cones.limits / unit), scaled)
    without, least = best(jnp.float32(0.0)), best(jnp.float32(1.0))
    needed = scaled.excess(without.torque_B) > 0.0

    def narrow(at: _Bracket) -> _Bracket:
        # False position, with the excess of an end that stays halved (the Illinois method).
        weight = (at.low * at.under - at.high * at.over) / (at.under - at.over)
        torque_B = best(weight).torque_B
        excess = scaled.excess(torque_B)
        kept = excess <= 0.0
        return _Bracket(
            low=jnp.where(kept, at.low, weight),
            high=jnp.where(kept, weight, at.high),
            over=jnp.where(kept, 0.5 * at.over, excess),
            under=jnp.where(kept, excess, 0.5 * at.under),
            torque_B=jnp.where(kept, torque_B, at.torque_B),
            left=jnp.where(kept & (excess > -TOLERANCE), 0, at.left - 1),
        )

    # A loop that is passed over where the limit is not reached.
    begin = _Bracket(
        low=jnp.float32(0.0),
        high=jnp.float32(1.0),
        over=scaled.excess(without.torque_B),
        under=scaled.excess(least.torque_B),
        torque_B=least.torque_B,
        left=jnp.where(needed & least.exists, _TRIES, 0),
    )
    end = jax.lax.while_loop(lambda at: at.left > 0, narrow, begin)
    return Solution(
        torque_B=unit * jnp.where(needed, end.torque_B, without.torque_B),
        exists=without.exists & (scaled.excess(least.torque_B) <= TOLERANCE),
    )


def _by_weight(
    requested: jax.Array, box: jax.Array, cones: Halfspaces, energy: Ellipsoid
) -> Callable[[jax.Array], Solution]:
    """Make a function of a weight w () that finds the least (1 - w) |u - requested|^2 + w energy(u) of the polytope."""
    normals = jnp.concatenate([jnp.eye(3), -jnp.eye(3), cones.normals, jnp.zeros((1, 3))])
    limits = jnp.concatenate([box, box, cones.limits, jnp.zeros(1)])
    sets = _active_sets(cones.limits.shape[0])
    active_normals, active_limits = normals[sets], limits[sets]
    unused = jnp.asarray(sets == len(normals) - 1, jnp.float32)

    def best(weight: jax.Array) -> Solution:
        hessian = (1.0 - weight) * jnp.eye(3) + weight * energy.form
        inverse = dynamics.inverse(hessian)
        free = dynamics.matvec(inverse, (1.0 - weight) * requested - 0.5 * weight * energy.slope)

        def on(rows: jax.Array, limits_here: jax.Array, unused_here: jax.Array) -> tuple[jax.Array, jax.Array]:
            """Best point where some limits are met exactly, and what it costs."""
            # Sums of products, which compile to quicker code than products of matrices as small as these.
            reach = [dynamics.matvec(inverse, row) for row in rows]
            gram = jnp.stack([jnp.stack([rotations.dot(row, way) for way in reach]) for row in rows])
            missing = jnp.stack([rotations.dot(row, free) for row in rows]) - limits_here
            forces = dynamics.matvec(dynamics.inverse(gram + jnp.diag(unused_here)), missing)
            change = sum(force * way for force, way in zip(forces, reach, strict=True))
            point = free - change
            # False also where limits that contradict each other make it nan.
            allowed = jnp.all(jnp.sum(normals * point[None], axis=1) <= limits + TOLERANCE)
            return point, jnp.where(allowed, rotations.dot(change, dynamics.matvec(hessian, change)), jnp.inf)

        points, costs = jax.vmap(on)(active_normals, active_limits, unused)
        first = jnp.argmin(costs)
        return Solution(jnp.clip(points[first], -box, box), jnp.isfinite(costs[first]))

    return best


def _active_sets(cones: int) -> np.ndarray:
    """Limits that can be met exactly at once, as rows of three indices: 6 faces of the box, the cones, or none."""
    none = 6 + cones
    sets = [
        (*chosen, *[none] * (3 - size))
        for size in range(4)
        for chosen in itertools.combinations(range(none), size)
        if not any(face < 3 and face + 3 in chosen for face in chosen)
    ]
    return np.array(sets)
