"""Golden vectors of the shield: what it makes of requests everywhere, at a zone's edge, and inside a zone."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from koz_jax.agents.agent import Agent
from koz_jax.config.base import Vector
from koz_jax.config.shield import ShieldConfig
from koz_jax.control.shield import filter as shield
from koz_jax.control.shield.filter import Shield
from koz_jax.export.golden import Situation, directions, known, rows, situations
from koz_jax.task import rotations, state
from koz_jax.task.actuators import ReactionWheels
from koz_jax.task.state import Model

# Kinds of situations that are drawn in turn: as for the policy, slow at the edge of a zone, and slow inside it.
_EVERYWHERE, _EDGE, _INSIDE = 0, 1, 2
_KINDS = (_EVERYWHERE, _EDGE, _EVERYWHERE, _INSIDE)
_EDGE_MARGINS = (-0.5, 4.0)  # where "at the edge" is, in margins of the shield
_DEEPEST = 0.9  # share of the half angle
_SLOWEST, _FASTEST = 1e-3, 4.0  # momentum in steps of the brake

_DRAWN_PER_VECTOR = 20  # few requests are refused
_TRIED_PER_VECTOR = 3  # of those drawn, whether roundings could decide otherwise

# What rounding changes is far smaller, and what these change in a torque that is decided alike is below the last.
_MARGIN_SHIFT = 2e-5  # [rad]
_TURN = 1e-5  # [rad]
_RATE_SHIFT = 1e-4  # relative
_INERTIA_SHIFT = 2e-2  # moves the clearance after a torque beside that after the brake
_ROUNDINGS = 50
_STEADY = 1e-2  # of the torque limit: another candidate is farther away


class ShieldGolden(NamedTuple):
    """Situations and what the shield makes of them, none close to a threshold; leading axis (count,)."""

    situation: np.ndarray  # (count, entries) float32, rows as in ``Golden``
    requested: np.ndarray  # (count, 3) float32 [N m]
    allowed: np.ndarray  # (count, 3) float32 [N m]
    safe: np.ndarray  # (count,) bool, whether the situation itself is safe


class _Variant(struct.PyTreeNode):
    """A situation told a little differently, or to a shield that is a little different."""

    margin: float = 0.0  # [rad] added to the shield's
    rate: float = 0.0  # relative, added to all rates
    turn: float = 0.0  # [rad] of the attitude
    inertia_error: float = 0.0  # added to the one that the shield withstands


def _variants() -> list[_Variant]:
    """Each way of being different alone, then many that only round differently; the first is not different."""
    rng = np.random.default_rng(0)
    shifts = {"margin": _MARGIN_SHIFT, "rate": _RATE_SHIFT, "turn": _TURN, "inertia_error": _INERTIA_SHIFT}
    alone = [_Variant(**{name: sign * shift}) for name, shift in shifts.items() for sign in (-1.0, 1.0)]
    drawn = rng.uniform(-1.0, 1.0, (_ROUNDINGS, 2)) * (_RATE_SHIFT, _TURN)
    return [_Variant(), *alone, *(_Variant(rate=float(rate), turn=float(turn)) for rate, turn in drawn)]


def shield_golden(
    agent: Agent,
    config: ShieldConfig,
    count: int,
    seed: int = 0,
    further_boresights: Sequence[Vector] = (),
    least_zones: int = 0,
) -> ShieldGolden:
    """Draw situations and requests; of every kind, passed and not, about as many, as far as there are.

    Where other roundings could decide otherwise, as they do with a margin, a rate or an attitude that is a little
    different, none is kept.  further_boresights: unit vectors (3,) in body axes, of instruments beside the task's own;
    least_zones: so many are told at least.

    Raises:
        SettingsError: there is no torque for what the shield is to withstand.

    """
    limits = agent.task.spacecraft.torque_limits
    config.check(agent.task.spacecraft.brake_limits)
    model, boresights_B = known(agent, further_boresights)
    made = shield.from_config(config, model)
    drawn, kind = shield_situations(agent, config, _DRAWN_PER_VECTOR * count, seed, further_boresights, least_zones)
    box = np.random.default_rng(seed).uniform(np.negative(limits), limits, (_DRAWN_PER_VECTOR * count, 3))
    left = np.asarray(_left(drawn, model, boresights_B))
    requested = np.clip(box.astype(np.float32), -left, left)
    allowed, _ = _answer(made, drawn, requested, model, boresights_B, _Variant())
    tried = _in_turn(np.arange(len(kind)), 2 * kind + np.all(allowed == requested, axis=1))[: _TRIED_PER_VECTOR * count]
    drawn, requested, kind = jax.tree.map(lambda leaf: leaf[tried], (drawn, requested, kind))
    answers = [_answer(made, drawn, requested, model, boresights_B, variant) for variant in _variants()]
    allowed, safe = (np.stack(answer) for answer in zip(*answers, strict=True))
    steady = np.all(np.ptp(allowed, axis=0) < _STEADY * np.array(limits), axis=1) & (safe[0] == safe).all(axis=0)
    passed = np.all(allowed == requested, axis=2)
    steady &= (passed[0] == passed).all(axis=0)
    kept = _in_turn(np.flatnonzero(steady), 2 * kind + passed[0])[:count]
    return ShieldGolden(rows(drawn)[kept], requested[kept], allowed[0][kept], safe[0][kept])


def shield_situations(
    agent: Agent,
    config: ShieldConfig,
    count: int,
    seed: int = 0,
    further_boresights: Sequence[Vector] = (),
    least_zones: int = 0,
) -> tuple[Situation, np.ndarray]:
    """Draw situations of all kinds.  Returns leaves (count, ...), and the kinds (count,).

    Those at an edge or inside have the nearest zone moved there, and rates of the order that the brake takes up in a
    step.
    """
    rng = np.random.default_rng(seed)
    drawn = situations(agent, count, seed, 1 + len(further_boresights), least_zones)
    model, boresights_B = known(agent, further_boresights)
    made = shield.from_config(config, model)
    kind = np.resize(_KINDS, count)
    half_angle = np.asarray(drawn.zone_half_angle[:, 0])
    margin = np.where(
        kind == _EDGE,
        float(made.guide.margin) * rng.uniform(*_EDGE_MARGINS, count),
        -half_angle * rng.uniform(0.0, _DEEPEST, count),
    )
    which = drawn.zone_instrument
    look_B = jnp.tile(boresights_B, (count, 1)) if which is None else boresights_B[which[:, 0]]
    look_N = jax.vmap(rotations.rotate)(drawn.q_BN, look_B)
    side_N = jax.vmap(rotations.cross)(look_N, directions(rng, count, 3))
    side_N = side_N / jnp.linalg.norm(side_N, axis=1, keepdims=True)
    tilt = jax.vmap(rotations.from_axis_angle)(side_N, jnp.float32(half_angle + margin))
    axis_N = jax.vmap(rotations.rotate)(tilt, look_N)
    steps = _SLOWEST * (_FASTEST / _SLOWEST) ** rng.uniform(size=(count, 1))
    rate = steps * float(made.brake.torque * model.dt / made.brake.largest_moment)
    moved = jnp.asarray(kind != _EVERYWHERE)
    return drawn.replace(
        omega_BN_B=jnp.where(moved[:, None], jnp.float32(rate * directions(rng, count, 3)), drawn.omega_BN_B),
        zone_axis_N=drawn.zone_axis_N.at[:, 0].set(jnp.where(moved[:, None], axis_N, drawn.zone_axis_N[:, 0])),
    ), kind


def _in_turn(chosen: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Sort indices so that one of every group comes after the other, as long as there are any."""
    place = np.zeros(len(chosen), int)
    for which in np.unique(group[chosen]):
        members = group[chosen] == which
        place[members] = np.arange(np.sum(members))
    return chosen[np.lexsort((group[chosen], place))]


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, None, None))
def _left(situation: Situation, model: Model, boresights_B: jax.Array) -> jax.Array:
    """What can be asked for in each situation.  Returns (count, 3) [N m]."""
    return state.torque_limits(situation.state(model, boresights_B), model).box_B


@jax.jit
def _answer(
    made: Shield,
    drawn: Situation,
    requested: jax.Array,
    model: Model,
    boresights_B: jax.Array,
    variant: _Variant,
) -> tuple[jax.Array, jax.Array]:
    brake = made.brake.replace(inertia_error=made.brake.inertia_error + variant.inertia_error)
    made = made.replace(margin=made.margin + variant.margin, brake=brake)

    def one(situation: Situation, torque_B: jax.Array) -> tuple[jax.Array, jax.Array]:
        turned = rotations.from_axis_angle(jnp.array([0.6, 0.0, 0.8]), jnp.float32(variant.turn))
        told = situation.replace(
            q_BN=rotations.multiply(turned, situation.q_BN),
            omega_BN_B=(1.0 + variant.rate) * situation.omega_BN_B,
        )
        at = told.state(model, boresights_B)
        limits = state.torque_limits(at, model)
        torque_B = jnp.clip(torque_B, -limits.box_B, limits.box_B)
        allowed_B = made.in_state(at, model).filter(at.body, torque_B, at.scenario.constraints, limits, model)
        if isinstance(model.actuators, ReactionWheels):
            # Above the rate that they can stop, less may be left than the brake counts on.
            allowed_B = jnp.clip(allowed_B, -limits.box_B, limits.box_B)
        return allowed_B, made.covers(at, model)

    return jax.vmap(one)(drawn, requested)
