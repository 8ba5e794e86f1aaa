"""Scenarios: where a maneuver starts, where it must end, and what it must not look at (spec of the Monte Carlo).

The zone sits where the boresight would be half-way along the shortest (eigen-axis) rotation from start to target.
A draw is *feasible* when start and target both lie outside the zone by at least ``separation``.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax import rotations
from koz_jax.dynamics import RigidBodyState
from koz_jax.keep_out import NO_ZONE_HALF_ANGLE, KeepOutZone

InfeasibleRule = Literal["resample", "shrink"]


class ScenarioRanges(struct.PyTreeNode):
    """Distribution of the scenarios; traced, because the curriculum changes it."""

    min_angle: jax.Array  # () [rad] smallest initial deviation
    max_angle: jax.Array  # () [rad] largest initial deviation
    angle_bias: jax.Array  # () exponent p of angle = min + (max - min) u^p; 1 is uniform, 2 favours small angles
    max_rate: jax.Array  # () [rad/s] each component of the initial rate is uniform in [-max_rate, max_rate]
    min_half_angle: jax.Array  # () [rad]
    max_half_angle: jax.Array  # () [rad]
    separation: jax.Array  # () [rad] between the zone's edge and the boresight at start and target


class Scenario(struct.PyTreeNode):
    """One maneuver to fly."""

    initial: RigidBodyState
    q_DN: jax.Array  # (4,) desired attitude, relative to inertial
    zones: KeepOutZone  # stacked along a leading axis (zones,)


class _Draw(struct.PyTreeNode):
    angle: jax.Array  # () [rad] deviation
    q_e: jax.Array  # (4,) attitude relative to the target
    omega_BN_B: jax.Array  # (3,) [rad/s]
    zone_axis_D: jax.Array  # (3,) zone axis in target axes
    room: jax.Array  # () [rad] smaller of the angles zone axis - start and zone axis - target
    size: jax.Array  # () in [0, 1], where the half angle lies in its range


def _draw(key: jax.Array, ranges: ScenarioRanges, boresight_B: jax.Array, angle: jax.Array | None = None) -> _Draw:
    """Draw once, with a new deviation or with the one given."""
    key_axis, key_angle, key_rate, key_size = jax.random.split(key, 4)
    axis = rotations.normalize(jax.random.normal(key_axis, (3,)))
    if angle is None:
        share = jax.random.uniform(key_angle) ** ranges.angle_bias
        angle = ranges.min_angle + (ranges.max_angle - ranges.min_angle) * share
    zone_axis_D = rotations.rotate(rotations.from_axis_angle(axis, 0.5 * angle), boresight_B)
    return _Draw(
        angle=angle,
        q_e=rotations.from_axis_angle(axis, angle),
        omega_BN_B=ranges.max_rate * jax.random.uniform(key_rate, (3,), minval=-1.0, maxval=1.0),
        zone_axis_D=zone_axis_D,
        # The axis is half-way, so start and target are equally far from it.
        room=rotations.angle_between(zone_axis_D, boresight_B),
        size=jax.random.uniform(key_size),
    )


def _full_half_angle(draw: _Draw, ranges: ScenarioRanges) -> jax.Array:
    return ranges.min_half_angle + (ranges.max_half_angle - ranges.min_half_angle) * draw.size


def _is_feasible(draw: _Draw, ranges: ScenarioRanges) -> jax.Array:
    return draw.room >= _full_half_angle(draw, ranges) + ranges.separation


def _shrunk_half_angle(draw: _Draw, ranges: ScenarioRanges) -> jax.Array:
    """Half angle uniform in [min, min(max, room - separation)]; no zone where that range is empty.  Returns ()."""
    largest = jnp.minimum(ranges.max_half_angle, draw.room - ranges.separation)
    half_angle = ranges.min_half_angle + (largest - ranges.min_half_angle) * draw.size
    return jnp.where(largest >= ranges.min_half_angle, half_angle, NO_ZONE_HALF_ANGLE)


def sample(
    key: jax.Array,
    ranges: ScenarioRanges,
    boresight_B: jax.Array,
    rule: InfeasibleRule = "resample",
    max_draws: int = 1000,
    keep_angle: bool = False,
) -> Scenario:
    """Draw one scenario with target attitude identity.

    Args:
        key: () typed PRNG key.
        ranges: the distribution.
        boresight_B: (3,) unit vector.
        rule: what to do where the zone would hold start or target: ``resample`` draws the whole case again,
            ``shrink`` makes the zone smaller, or leaves it out where even the smallest does not fit.
        max_draws: ``resample`` gives up after so many draws, and shrinks the zone of the last one.
        keep_angle: ``resample`` draws all but the deviation again.  Deviations are then distributed as ``ranges`` says,
            while drawing them again favours large ones, which leave more room for a zone.
    """
    first = _draw(jax.random.fold_in(key, 0), ranges, boresight_B)
    if rule == "shrink":
        draw, half_angle = first, _shrunk_half_angle(first, ranges)
    else:

        def infeasible(carry: tuple[jax.Array, _Draw]) -> jax.Array:
            draws, draw = carry
            return (draws < max_draws) & ~_is_feasible(draw, ranges)

        def again(carry: tuple[jax.Array, _Draw]) -> tuple[jax.Array, _Draw]:
            draws, draw = carry
            key_next = jax.random.fold_in(key, draws)
            return draws + 1, _draw(key_next, ranges, boresight_B, draw.angle if keep_angle else None)

        _, draw = jax.lax.while_loop(infeasible, again, (jnp.int32(1), first))
        half_angle = jnp.where(
            _is_feasible(draw, ranges), _full_half_angle(draw, ranges), _shrunk_half_angle(draw, ranges)
        )
    zone = KeepOutZone(axis_N=draw.zone_axis_D, half_angle=half_angle)
    return Scenario(
        initial=RigidBodyState(draw.q_e, draw.omega_BN_B),
        q_DN=jnp.array([1.0, 0.0, 0.0, 0.0]),
        zones=jax.tree.map(lambda leaf: leaf[None], zone),
    )


def paper_test() -> Scenario:
    """The test scenario of the paper (Table 3): a deviation of 100 deg with the zone on the shortest path."""
    return Scenario(
        initial=RigidBodyState(
            q_BN=rotations.normalize(jnp.array([0.6428, 0.3138, -0.5892, 0.3757])),
            omega_BN_B=jnp.deg2rad(jnp.array([-5.7e-4, -1.1e-4, -9.9e-4])),
        ),
        q_DN=jnp.array([1.0, 0.0, 0.0, 0.0]),
        zones=KeepOutZone(
            axis_N=rotations.normalize(jnp.array([0.703, 0.263, 0.661]))[None],
            half_angle=jnp.deg2rad(jnp.array([15.20])),
        ),
    )
