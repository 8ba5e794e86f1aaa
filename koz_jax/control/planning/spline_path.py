"""A smooth path along given attitudes: a cumulative cubic B-spline of quaternions.

After Kim, Kim & Shin, "A general construction scheme for unit quaternion curves with simple high order derivatives"
(SIGGRAPH 1995).  Its rate and acceleration are continuous; it begins at the first and ends at the last attitude, and
passes within a sixth of their second differences of the others.
"""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.control import feedback
from koz_jax.task import rotations


class SplinePath(struct.PyTreeNode):
    """A path without timing."""

    controls: jax.Array  # (pieces + 3, 4) attitudes relative to inertial, neighbours of one sign

    def attitude(self, s: jax.Array) -> jax.Array:
        """q(s).  s: () in [0, 1].  Returns (4,)."""
        return self.attitude_and_slope(s)[0]

    def attitude_and_slope(self, s: jax.Array) -> tuple[jax.Array, jax.Array]:
        """q(s) (4,), and the body rate (3,) [rad] per unit of s."""
        pieces = self.controls.shape[0] - 3
        piece = jnp.clip(jnp.floor(s * pieces).astype(jnp.int32), 0, pieces - 1)
        t = s * pieces - piece
        near = jax.lax.dynamic_slice_in_dim(self.controls, piece, 4)
        turns_B = jax.vmap(turn)(near[:-1], near[1:])
        shares = jnp.stack([5.0 + t * (3.0 + t * (t - 3.0)), 1.0 + t * (3.0 + t * (3.0 - 2.0 * t)), t**3]) / 6.0
        slopes = pieces * 0.5 * jnp.stack([(1.0 - t) ** 2, 1.0 + 2.0 * t * (1.0 - t), t**2])

        def follow(
            now: tuple[jax.Array, jax.Array], row: tuple[jax.Array, jax.Array, jax.Array]
        ) -> tuple[tuple[jax.Array, jax.Array], None]:
            (q, rate_B), (turn_B, share, slope) = now, row
            step = feedback.from_rotation_vector(share * turn_B)
            rate_B = rotations.rotate(rotations.conjugate(step), rate_B) + slope * turn_B
            return (rotations.multiply(q, step), rate_B), None

        # A loop, which compiles in a third of the time of the product written out.
        return jax.lax.scan(follow, (near[0], jnp.zeros(3)), (turns_B, shares, slopes))[0]


def along(points: jax.Array) -> SplinePath:
    """The spline of at least two attitudes (points, 4); what lies before and after them continues the turns there."""
    before = turned(points[0], -turn(points[0], points[1]))
    after = turned(points[-1], turn(points[-2], points[-1]))
    return SplinePath(jnp.concatenate([before[None], points, after[None]]))


def turn(begin: jax.Array, end: jax.Array) -> jax.Array:
    """Rotation vector from one attitude (4,) to another (4,).  Returns (3,) [rad] in the axes of both."""
    return feedback.rotation_vector(rotations.multiply(rotations.conjugate(begin), end))


def turned(q: jax.Array, vector_B: jax.Array) -> jax.Array:
    """Attitude (4,) turned by a rotation vector (3,) [rad] in its own axes.  Returns (4,)."""
    return rotations.multiply(q, feedback.from_rotation_vector(vector_B))


def evenly(way: jax.Array, count: int) -> jax.Array:
    """So many attitudes, even in angle, along the turns between those of a way (n, 4).  Returns (count, 4)."""
    turns_B = jax.vmap(turn)(way[:-1], way[1:])
    lengths = jax.vmap(rotations.norm)(turns_B)
    reached = jnp.concatenate([jnp.zeros(1), jnp.cumsum(lengths)])
    at = jnp.linspace(0.0, 1.0, count) * reached[-1]
    i = jnp.clip(jnp.searchsorted(reached, at, side="right") - 1, 0, lengths.shape[0] - 1)
    share = (at - reached[i]) / jnp.where(lengths[i] > 0.0, lengths[i], 1.0)
    return jax.vmap(turned)(way[i], share[:, None] * turns_B[i]).at[-1].set(way[-1])
