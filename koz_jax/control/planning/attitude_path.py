"""Attitude paths: an eigen-axis turn bent aside, and how fast the torque box lets a path be flown.

The bent turn is q(s) = q_end (x) exp(bend(s)) (x) exp((s - 1) turn) for s from 0 to 1, with the bend a sum of sines
that vanishes at both ends: without rounding at its end, where the body will stay.  The timing of any path is the
fastest that keeps the torque in its box, with rest at both ends: a backward pass for the rates from which one can still
stop, then a forward pass along the limit (H. Pham, Q.-C. Pham, "A new approach to time-optimal path parameterization
based on reachability analysis", IEEE Transactions on Robotics 34 (2018)).
"""

import itertools
from typing import Protocol

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.control import feedback
from koz_jax.task import dynamics, pointing_constraints, rotations
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.pointing_constraints import PointingConstraint


class Path(Protocol):
    """Attitudes q(s) from the start, at s = 0, to the target, at s = 1; implementations are pytrees."""

    def attitude(self, s: jax.Array) -> jax.Array:
        """q(s).  s: () in [0, 1].  Returns (4,), continuous also in its sign."""
        ...

    def attitude_and_slope(self, s: jax.Array) -> tuple[jax.Array, jax.Array]:
        """q(s) (4,), and the body rate (3,) [rad] per unit of s."""
        ...


class AttitudePath(struct.PyTreeNode):
    """An eigen-axis turn bent aside, without timing."""

    q_end: jax.Array  # (4,) attitude at its end, relative to inertial
    turn_B: jax.Array  # (3,) [rad] rotation vector from start to end
    bends_B: jax.Array  # (sines, 3) [rad] amplitude of each sine, in the axes of the end

    def attitude(self, s: jax.Array) -> jax.Array:
        """q(s).  s: () in [0, 1].  Returns (4,)."""
        sines = jnp.sin(jnp.pi * (1.0 - s) * jnp.arange(1, self.bends_B.shape[0] + 1))
        bend_B = jnp.sum(sines[:, None] * self.bends_B, axis=0)
        aside = rotations.multiply(self.q_end, feedback.from_rotation_vector(bend_B))
        return rotations.multiply(aside, feedback.from_rotation_vector((s - 1.0) * self.turn_B))

    def attitude_and_slope(self, s: jax.Array) -> tuple[jax.Array, jax.Array]:
        """q(s) (4,), and the body rate (3,) [rad] per unit of s."""
        q, slope = jax.jvp(self.attitude, (s,), (jnp.ones_like(s),))
        return q, 2.0 * rotations.multiply(rotations.conjugate(q), slope)[1:]


class Timing(struct.PyTreeNode):
    """When a path is where; leaves (points,), for points that are even in s."""

    speed: jax.Array  # (points,) [1/s] ds/dt
    time: jax.Array  # (points,) [s]

    @property
    def duration(self) -> jax.Array:
        """Time from end to end.  Returns () [s]."""
        return self.time[-1]

    def at(self, time: jax.Array) -> tuple[jax.Array, jax.Array]:
        """s and ds/dt at a time () [s], held before the start and after the end."""
        pieces = self.time.shape[0] - 1
        now = jnp.clip(time, 0.0, self.duration)
        i = jnp.clip(jnp.searchsorted(self.time, now, side="right") - 1, 0, pieces - 1)
        length = self.time[i + 1] - self.time[i]
        passed = now - self.time[i]
        acceleration = (self.speed[i + 1] - self.speed[i]) / jnp.where(length > 0.0, length, 1.0)
        s = i / pieces + (self.speed[i] + 0.5 * acceleration * passed) * passed
        speed = self.speed[i] + acceleration * passed
        arrived = time >= self.duration
        return jnp.where(arrived, 1.0, jnp.clip(s, 0.0, 1.0)), jnp.where(arrived, 0.0, speed)


class Samples(struct.PyTreeNode):
    """A path at points that are even in s."""

    q_BN: jax.Array  # (points, 4)
    slope_B: jax.Array  # (points, 3) [rad] body rate per unit of s


def sample(path: Path, points: int) -> Samples:
    """Sample a path at so many points, both ends included."""
    return Samples(*jax.vmap(path.attitude_and_slope)(jnp.linspace(0.0, 1.0, points)))


def clearance(samples: Samples, zones: PointingConstraint, timing: Timing) -> jax.Array:
    """Smallest angle [rad] between boresights and zones along a path; a bound, so between samples too.  Returns ().

    zones: as they are when the path begins.
    """
    then = jax.vmap(pointing_constraints.later, in_axes=(None, 0))(zones, timing.time)
    looks_N = jax.vmap(jax.vmap(pointing_constraints.boresight_N, in_axes=(None, 0)))(samples.q_BN, then)
    at_points = jnp.min(jax.vmap(pointing_constraints.smallest_margin)(samples.q_BN, then))
    seen_from_axes = looks_N - then.axis_N
    steps = jnp.max(jnp.sum((seen_from_axes[1:] - seen_from_axes[:-1]) ** 2, axis=-1))
    # A great circle between two points at equal distance from an axis dips towards it by about step^2 / 8 times the
    # cotangent of the distance, where that is below 90 deg.
    present = jnp.where(zones.is_present, zones.half_angle, 0.5 * jnp.pi)
    return at_points - 0.125 * steps / jnp.tan(jnp.minimum(jnp.min(present), 0.5 * jnp.pi))


def fastest_timing(
    samples: Samples, inertia_B: jax.Array, limit_B: jax.Array, max_speed: jax.Array | None = None
) -> Timing:
    """Time a path as fast as a torque of at most ``limit_B`` (3,) [N m] about each body axis allows.

    max_speed: (points,) [1/s] largest ds/dt; None for any.
    """
    # In units in which numbers are of order one, so that the least of them, below, suit every spacecraft.
    inertia, torque = jnp.trace(inertia_B) / 3.0, jnp.sqrt(jnp.mean(limit_B**2))
    inertia_B, limit_B, unit = inertia_B / inertia, limit_B / torque, jnp.sqrt(inertia / torque)
    pieces = samples.slope_B.shape[0] - 1
    step = 1.0 / pieces
    middle_B = 0.5 * (samples.slope_B[1:] + samples.slope_B[:-1])
    change_B = (samples.slope_B[1:] - samples.slope_B[:-1]) / step
    along_B = jax.vmap(dynamics.matvec, in_axes=(None, 0))(inertia_B, middle_B)
    curved_B = jax.vmap(dynamics.matvec, in_axes=(None, 0))(inertia_B, change_B) + jax.vmap(rotations.cross)(
        middle_B, along_B
    )
    # With x = (ds/dt)^2 at both ends of a piece, torque = ahead x_end + back x_begin.
    ahead = (0.5 * curved_B + along_B / (2.0 * step)) / limit_B[None]
    back = (0.5 * curved_B - along_B / (2.0 * step)) / limit_B[None]

    top = jnp.full(pieces, jnp.inf) if max_speed is None else (unit * max_speed[:-1]) ** 2

    def fastest_begin(x_end: jax.Array, rows: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        ahead, back, most = rows
        found = jnp.minimum(_largest_begin(ahead, back, x_end), most)
        return found, found

    def fastest_end(x_begin: jax.Array, rows: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        ahead, back, most = rows
        room = 1.0 - jnp.sign(ahead) * back * x_begin
        found = jnp.clip(jnp.min(room / jnp.maximum(jnp.abs(ahead), 1e-9)), 1e-9, most)
        return found, found

    _, most = jax.lax.scan(fastest_begin, jnp.zeros(()), (ahead, back, top), reverse=True)
    limits = jnp.concatenate([most[1:], jnp.zeros(1)])
    _, ends = jax.lax.scan(fastest_end, jnp.zeros(()), (ahead, back, limits))
    speed = jnp.sqrt(jnp.concatenate([jnp.zeros(1), ends]))
    times = 2.0 * step / jnp.maximum(speed[1:] + speed[:-1], 1e-6)
    return Timing(speed / unit, unit * jnp.concatenate([jnp.zeros(1), jnp.cumsum(times)]))


def _largest_begin(ahead: jax.Array, back: jax.Array, most: jax.Array) -> jax.Array:
    """Largest x >= 0 for which some y in [0, most] has |ahead y + back x| <= 1 in every component.  Returns ().

    ahead, back: (3,).  A linear programme in two variables: its optimum lies at an end of y's range, or where two of
    the lines meet that bound x from above.
    """
    size = jnp.maximum(jnp.abs(back), 1e-9)
    height, fall = 1.0 / size, jnp.sign(back) * ahead / size
    meetings = []
    for i, j in itertools.combinations(range(3), 2):
        difference = fall[i] - fall[j]
        meetings.append((height[i] - height[j]) / jnp.where(difference == 0.0, 1.0, difference))
    y = jnp.clip(jnp.stack([jnp.zeros(()), most, *meetings]), 0.0, most)
    above = height[:, None] - fall[:, None] * y[None, :]
    below = -height[:, None] - fall[:, None] * y[None, :]
    x = jnp.min(above, axis=0)
    allowed = (x >= jnp.max(below, axis=0)) & (x >= 0.0)
    return jnp.max(jnp.where(allowed, x, 0.0))


def from_state(body: RigidBodyState, q_DN: jax.Array, bends_B: jax.Array) -> AttitudePath:
    """Make the path from an attitude to a target, bent; it ends at the target with the sign of its quaternion.

    q_DN: (4,); bends_B: (sines, 3) [rad].
    """
    turn_B = feedback.rotation_vector(rotations.multiply(rotations.conjugate(body.q_BN), q_DN))
    return AttitudePath(q_DN, turn_B, bends_B)
