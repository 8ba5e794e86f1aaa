"""What makes a way of many corners one that is flown without a stop: shortcuts, then as little bend as the zones allow.

A way is a row of attitudes.  Bend is the sum of the squared second differences.  Steps that lessen it take turns with
steps that bring the attitude that is nearest to a zone back to its distance, by the change of the whole way that adds
least bend: the shape of a beam on two supports, pushed at one point.
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from koz_jax.control.planning import spline_path
from koz_jax.task import pointing_constraints, rotations
from koz_jax.task.pointing_constraints import PointingConstraint

# Lengths of shortcuts, in shares of the way; each is tried from places that are a quarter of its length apart.
_SPANS = (1.0, 0.75, 0.5, 0.375, 0.25, 0.1875, 0.125)

# Share of the bend that a step takes, and how many pushes out of zones follow it.
_EASED = 0.15
_PUSHES = 4


class _Shortened(struct.PyTreeNode):
    way: jax.Array  # (points, 4)
    margins: jax.Array  # (points,) [rad] to the nearest zone


def shortcut(way: jax.Array, zones: PointingConstraint, margin: jax.Array | float) -> jax.Array:
    """Put eigen-axis turns in place of pieces of a way (points, 4), where they keep a margin () [rad].

    Where a piece itself keeps less, its turn may keep as little.  Returns (points, 4).
    """
    place = jnp.arange(way.shape[0])

    def cut(found: _Shortened, ends: jax.Array) -> tuple[_Shortened, None]:
        first, last = ends
        share = jnp.clip((place - first) / (last - first), 0.0, 1.0)
        begin = found.way[first]
        turn_B = spline_path.turn(begin, found.way[last])
        straight = jax.vmap(lambda part: spline_path.turned(begin, part * turn_B))(share)
        margins = margins_along(straight, zones)
        inside = (place > first) & (place < last)
        least, before = (jnp.min(jnp.where(inside, of, jnp.inf)) for of in (margins, found.margins))
        take = inside & (least >= jnp.minimum(margin, before))
        cut_short = jnp.where(take[:, None], straight, found.way)
        return _Shortened(cut_short, jnp.where(take, margins, found.margins)), None

    ends = jnp.asarray(list(_pieces(way.shape[0] - 1)), jnp.int32)
    return jax.lax.scan(cut, _Shortened(way, margins_along(way, zones)), ends)[0].way


def _pieces(last: int) -> Iterator[tuple[int, int]]:
    """First and last place of each shortcut that is tried, twice over."""
    for _ in range(2):
        for span in (max(int(share * last), 2) for share in _SPANS):
            places = max(round(4 * (last - span) / span), 0) + 1
            yield from ((int(at), int(at) + span) for at in np.linspace(0, last - span, places))


def margins_along(way: jax.Array, zones: PointingConstraint) -> jax.Array:
    """Margin to the nearest zone at each attitude of a way (points, 4).  Returns (points,) [rad]."""
    return jax.vmap(pointing_constraints.smallest_margin, in_axes=(0, None))(way, zones)


def eased(way: jax.Array, zones: PointingConstraint, margin: jax.Array | float, steps: int) -> jax.Array:
    """Ways (steps, points, 4) with less and less bend, and with a margin () [rad] where they find it."""
    second_differences = _second_differences(way.shape[0])
    straighten = jnp.asarray(np.linalg.inv(second_differences), jnp.float32)
    soft = np.linalg.inv(second_differences.T @ second_differences)
    # By how much all others are moved when one is moved by one.
    pushed = jnp.asarray(soft / np.diag(soft)[None], jnp.float32)

    def move(way: jax.Array, moves_B: jax.Array) -> jax.Array:
        return way.at[1:-1].set(jax.vmap(spline_path.turned)(way[1:-1], moves_B))

    def push(way: jax.Array, _: None) -> tuple[jax.Array, None]:
        margins = jax.vmap(pointing_constraints.margins, in_axes=(0, None))(way[1:-1], zones)
        point, zone = jnp.unravel_index(jnp.argmin(margins), margins.shape)
        nearest = jax.tree.map(lambda leaf: leaf[zone], zones)
        away_B = jnp.maximum(margin - margins[point, zone], 0.0) * _away(way[1:-1][point], nearest)
        return move(way, pushed[:, point][:, None] * away_B[None]), None

    def ease(way: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        turns_B = jax.vmap(spline_path.turn)(way[:-1], way[1:])
        way = move(way, -_EASED * straighten @ (turns_B[1:] - turns_B[:-1]))
        way, _ = jax.lax.scan(push, way, None, length=_PUSHES)
        return way, way

    return jax.lax.scan(ease, way, None, length=steps)[1]


def _second_differences(points: int) -> np.ndarray:
    """Matrix that takes the inner ones of points, whose ends stay, to their second differences."""
    inner = points - 2
    return -2.0 * np.eye(inner) + np.eye(inner, k=1) + np.eye(inner, k=-1)


def _away(q_BN: jax.Array, zone: PointingConstraint) -> jax.Array:
    """Unit rotation vector (3,), in body axes, that takes the boresight straight away from the axis of a zone."""
    across_B = rotations.cross(pointing_constraints.axis_B(q_BN, zone), zone.boresight_B)
    return across_B / jnp.maximum(rotations.norm(across_B), 1e-6)
