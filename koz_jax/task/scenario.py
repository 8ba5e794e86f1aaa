"""Scenarios: where a maneuver starts, where it must end, and what it must not look at (spec of the Monte Carlo).

The zone sits where the boresight would be half-way along the shortest (eigen-axis) rotation from start to target.
A draw is *feasible* when start and target both lie outside the zone by at least ``separation``.

Further zones, which the paper does not have, lie around the first one: as far from start and target, and with a gap to
each other, so that a way around them is always left (what remains of the sphere is connected).  Where there are several
instruments, each further zone is for one of them, and may be a cone to keep it in; zones of different instruments have
no gap, so that a few draws have no way.
"""

import dataclasses
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from koz_jax.config.task import TaskConfig
from koz_jax.task import pointing_constraints, rotations
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE
from koz_jax.task.pointing_constraints import PointingConstraint

InfeasibleRule = Literal["resample", "shrink"]

# Separates the draws of further zones from those of a case with one.
_FURTHER = 0x5A4F4E45

# Places that are tried for a further zone.
_PLACES = 32

# Separates the draw of a zone's instrument from that of its place.
_INSTRUMENT = 0x494E53

# Separates the draw of how zones turn from all others of a case.
_TURNING = 0x5455524E

# [rad] Smallest and largest half angle of a cone to keep an instrument in.
_KEEP_IN = (np.deg2rad(60.0), np.deg2rad(100.0))


@dataclasses.dataclass(frozen=True)
class SamplingRule:
    """How scenarios are drawn; static."""

    infeasible: InfeasibleRule = "resample"
    """What to do where the zone would hold start or target: ``resample`` draws the whole case again, ``shrink`` makes
    the zone smaller, or leaves it out where even the smallest does not fit."""
    max_draws: int = 1000
    """``resample`` gives up after so many draws, and shrinks the zone of the last one."""
    keep_angle: bool = False
    """``resample`` draws all but the deviation again.  Deviations are then distributed as the ranges say, while drawing
    them again favours large ones, which leave more room for a zone."""


class ScenarioRanges(struct.PyTreeNode):
    """Distribution of the scenarios; traced, because the curriculum changes it."""

    boresight_B: jax.Array  # (3,) unit vector of the instrument that zones are for, in body axes
    min_angle: jax.Array  # () [rad] smallest initial deviation
    max_angle: jax.Array  # () [rad] largest initial deviation
    angle_bias: jax.Array  # () exponent p of angle = min + (max - min) u^p; 1 is uniform, 2 favours small angles
    max_rate: jax.Array  # () [rad/s] each component of the initial rate is uniform in [-max_rate, max_rate]
    min_half_angle: jax.Array  # () [rad]
    max_half_angle: jax.Array  # () [rad]
    separation: jax.Array  # () [rad] between a zone's edge and the boresight at start and target
    zone_gap: jax.Array  # () [rad] least gap between the edges of two zones
    zone_counts: jax.Array  # (2,) int32, least and largest number of zones
    keep_in: jax.Array  # () share of the other instruments' zones that are cones to keep them in
    others_B: jax.Array | None  # (n, 3) unit vectors of other instruments; None where there are none
    cone_rate: jax.Array | None  # () [rad/s] at which the axes of zones turn; None where they stand still
    max_zones: int = struct.field(pytree_node=False)  # length of the stack of zones


class Scenario(struct.PyTreeNode):
    """One maneuver to fly."""

    initial: RigidBodyState
    q_DN: jax.Array  # (4,) desired attitude, relative to inertial
    constraints: PointingConstraint  # stacked along a leading axis; in the state of a maneuver, as they are now

    def after(self, seconds: jax.Array | float) -> "Scenario":
        """The same a time () [s] later, when the axes of constraints have turned."""
        return self.replace(constraints=pointing_constraints.later(self.constraints, seconds))


class _Draw(struct.PyTreeNode):
    angle: jax.Array  # () [rad] deviation
    q_e: jax.Array  # (4,) attitude relative to the target
    omega_BN_B: jax.Array  # (3,) [rad/s]
    zone_axis_D: jax.Array  # (3,) zone axis in target axes
    room: jax.Array  # () [rad] smaller of the angles zone axis - start and zone axis - target
    size: jax.Array  # () in [0, 1], where the half angle lies in its range


def _draw(key: jax.Array, ranges: ScenarioRanges, angle: jax.Array | None = None) -> _Draw:
    """Draw once, with a new deviation or with the one given."""
    boresight_B = ranges.boresight_B
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


def _full_half_angle(size: jax.Array, ranges: ScenarioRanges) -> jax.Array:
    """Half angle of a size () in [0, 1].  Returns () [rad]."""
    return ranges.min_half_angle + (ranges.max_half_angle - ranges.min_half_angle) * size


def _is_feasible(draw: _Draw, ranges: ScenarioRanges) -> jax.Array:
    return draw.room >= _full_half_angle(draw.size, ranges) + ranges.separation


def _shrunk_half_angle(draw: _Draw, ranges: ScenarioRanges) -> jax.Array:
    """Half angle uniform in [min, min(max, room - separation)]; no zone where that range is empty.  Returns ()."""
    largest = jnp.minimum(ranges.max_half_angle, draw.room - ranges.separation)
    half_angle = ranges.min_half_angle + (largest - ranges.min_half_angle) * draw.size
    return jnp.where(largest >= ranges.min_half_angle, half_angle, ABSENT_HALF_ANGLE)


def sample(key: jax.Array, ranges: ScenarioRanges, rule: SamplingRule = SamplingRule()) -> Scenario:
    """Draw one scenario with target attitude identity.  key: () typed PRNG key."""
    first = _draw(jax.random.fold_in(key, 0), ranges)
    if rule.infeasible == "shrink":
        draw, half_angle = first, _shrunk_half_angle(first, ranges)
    else:

        def infeasible(carry: tuple[jax.Array, _Draw]) -> jax.Array:
            draws, draw = carry
            return (draws < rule.max_draws) & ~_is_feasible(draw, ranges)

        def again(carry: tuple[jax.Array, _Draw]) -> tuple[jax.Array, _Draw]:
            draws, draw = carry
            key_next = jax.random.fold_in(key, draws)
            return draws + 1, _draw(key_next, ranges, draw.angle if rule.keep_angle else None)

        _, draw = jax.lax.while_loop(infeasible, again, (jnp.int32(1), first))
        half_angle = jnp.where(
            _is_feasible(draw, ranges), _full_half_angle(draw.size, ranges), _shrunk_half_angle(draw, ranges)
        )
    zones = PointingConstraint(ranges.boresight_B[None], draw.zone_axis_D[None], half_angle[None])
    if ranges.max_zones > 1:
        zones = _add_zones(jax.random.fold_in(key, _FURTHER), ranges, draw.q_e, zones)
    if ranges.cone_rate is not None:
        about_N = jax.random.normal(jax.random.fold_in(key, _TURNING), zones.axis_N.shape)
        zones = zones.replace(axis_rate_N=ranges.cone_rate * jax.vmap(rotations.normalize)(about_N))
    return Scenario(
        initial=RigidBodyState(draw.q_e, draw.omega_BN_B),
        q_DN=jnp.array([1.0, 0.0, 0.0, 0.0]),
        constraints=zones,
    )


class _Pair(NamedTuple):
    """What a further zone is for."""

    boresight_B: jax.Array  # (3,)
    half_angle: jax.Array  # () [rad]
    midway_D: jax.Array  # (3,) the half of the sphere around this direction is where it lies


def _pair(key: jax.Array, size: jax.Array, ranges: ScenarioRanges, q_e: jax.Array, first: PointingConstraint) -> _Pair:
    """Draw for which instrument a further zone of a size () in [0, 1] is."""
    half_angle = _full_half_angle(size, ranges)
    if ranges.others_B is None:
        return _Pair(ranges.boresight_B, half_angle, first.axis_N[0])
    key_which, key_kind = jax.random.split(jax.random.fold_in(key, _INSTRUMENT))
    instruments_B = jnp.concatenate([ranges.boresight_B[None], ranges.others_B])
    which = jax.random.randint(key_which, (), 0, len(instruments_B))
    boresight_B = instruments_B[which]
    half_turn = rotations.normalize(q_e.at[0].add(1.0))
    midway_D = rotations.rotate(half_turn, boresight_B)
    kept_in = (which > 0) & (jax.random.uniform(key_kind) < ranges.keep_in)
    narrowest, widest = _KEEP_IN
    # See ``pointing_constraints``: it is kept out of what is around the opposite direction.
    outside = jnp.pi - (narrowest + (widest - narrowest) * size)
    return _Pair(boresight_B, jnp.where(kept_in, outside, half_angle), jnp.where(kept_in, -midway_D, midway_D))


def _add_zones(key: jax.Array, ranges: ScenarioRanges, q_e: jax.Array, first: PointingConstraint) -> PointingConstraint:
    """Put further zones in the way, as many as are drawn and as find a place.

    Each lies within 90 deg of where its instrument looks midway, a cone to keep it in with its opposite.

    q_e: (4,) attitude at the start, relative to the target; first: leaves (1, ...).  Returns leaves (max_zones, ...).
    """
    keys = jax.random.split(key, ranges.max_zones)
    fewest, most = ranges.zone_counts
    number = jax.random.randint(keys[0], (), fewest, most + 1)
    to_all = jax.vmap(rotations.angle_between, in_axes=(None, 0))

    def add(i: jax.Array, zones: PointingConstraint) -> PointingConstraint:
        key_axis, key_size = jax.random.split(keys[i])
        pair = _pair(keys[i], jax.random.uniform(key_size), ranges, q_e, first)
        looks_D = jnp.stack([pair.boresight_B, rotations.rotate(q_e, pair.boresight_B)])
        axes = jax.vmap(rotations.normalize)(jax.random.normal(key_axis, (_PLACES, 3)))
        # Mirrored into the half of the sphere around that.
        axes = axes * jnp.where(axes @ pair.midway_D < 0.0, -1.0, 1.0)[:, None]
        clear = jax.vmap(to_all, in_axes=(0, None))(axes, looks_D) >= pair.half_angle + ranges.separation
        room = pair.half_angle + zones.half_angle + ranges.zone_gap
        apart = jax.vmap(to_all, in_axes=(0, None))(axes, zones.axis_N) >= room[None]
        if ranges.others_B is not None:
            apart |= jnp.any(zones.boresight_B != pair.boresight_B[None], axis=1)[None]
        fits = jnp.all(clear, axis=1) & jnp.all(apart, axis=1)
        place = jnp.argmax(fits)
        wanted = (i < number) & fits[place]
        return zones.replace(
            boresight_B=zones.boresight_B.at[i].set(jnp.where(wanted, pair.boresight_B, zones.boresight_B[i])),
            axis_N=zones.axis_N.at[i].set(jnp.where(wanted, axes[place], zones.axis_N[i])),
            half_angle=zones.half_angle.at[i].set(jnp.where(wanted, pair.half_angle, ABSENT_HALF_ANGLE)),
        )

    zones = pointing_constraints.filled_up(first, ranges.max_zones)
    return jax.lax.fori_loop(1, ranges.max_zones, add, zones)


def paper_test() -> Scenario:
    """The test scenario of the paper (Table 3): a deviation of 100 deg with the zone on the shortest path."""
    return Scenario(
        initial=RigidBodyState(
            q_BN=rotations.normalize(jnp.array([0.6428, 0.3138, -0.5892, 0.3757])),
            omega_BN_B=jnp.deg2rad(jnp.array([-5.7e-4, -1.1e-4, -9.9e-4])),
        ),
        q_DN=jnp.array([1.0, 0.0, 0.0, 0.0]),
        constraints=PointingConstraint(
            boresight_B=jnp.array([[1.0, 0.0, 0.0]]),
            axis_N=rotations.normalize(jnp.array([0.703, 0.263, 0.661]))[None],
            half_angle=jnp.deg2rad(jnp.array([15.20])),
        ),
    )


def from_config(task: TaskConfig, min_angle_deg: float, max_angle_deg: float) -> ScenarioRanges:
    """Distribution of a task's scenarios, with deviations uniform between two angles [deg]."""
    config, (min_zones, max_zones) = task.scenario, task.zones
    return ScenarioRanges(
        boresight_B=jnp.array(task.spacecraft.boresight),
        min_angle=jnp.deg2rad(jnp.float32(min_angle_deg)),
        max_angle=jnp.deg2rad(jnp.float32(max_angle_deg)),
        angle_bias=jnp.float32(1.0),
        max_rate=jnp.deg2rad(jnp.float32(config.max_rate_deg)),
        min_half_angle=jnp.deg2rad(jnp.float32(config.min_half_angle_deg)),
        max_half_angle=jnp.deg2rad(jnp.float32(config.max_half_angle_deg)),
        separation=jnp.deg2rad(jnp.float32(config.separation_deg)),
        zone_gap=jnp.deg2rad(jnp.float32(config.zone_gap_deg)),
        zone_counts=jnp.array([min_zones, max_zones], jnp.int32),
        keep_in=jnp.zeros(()),
        others_B=None,
        cone_rate=jnp.deg2rad(jnp.float32(config.cone_rate_deg)) if config.cone_rate_deg else None,
        max_zones=max_zones,
    )
