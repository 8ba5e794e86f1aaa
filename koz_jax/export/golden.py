"""Golden vectors: situations all over the flight envelope, with what the core observes and the agent decides there."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from koz_jax.agents.agent import Agent
from koz_jax.agents.numpy_policy import exported_zone_count
from koz_jax.config.shield import ShieldConfig
from koz_jax.control import shield
from koz_jax.control.shield import Shield
from koz_jax.task import environment, observation, rotations, state
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.scenario import Scenario
from koz_jax.task.state import EnvState, Model

_SMALLEST_ANGLE_DEG, _LARGEST_RATE = 1e-3, 0.2  # [deg], [rad/s]
_ABSENT = 0.25  # share of zones after the first
_DRAWN_PER_VECTOR = 20  # few requests are refused
_MARGIN_SHIFT = 2e-4  # [rad], far above what is rounded
_STEADY = 1e-2  # of the torque limit: another candidate is farther away


class Situation(struct.PyTreeNode):
    """What an exported controller derives the observation from, in the order of its ``koz_situation``."""

    q_BN: jax.Array  # (4,)
    omega_BN_B: jax.Array  # (3,) [rad/s]
    q_DN: jax.Array  # (4,) target
    zone_axis_N: jax.Array  # (zones, 3) unit vectors
    zone_half_angle: jax.Array  # (zones,) [rad]
    q_e0_previous: jax.Array  # ()

    def state(self, model: Model, boresight_B: jax.Array) -> EnvState:
        """The core's own state.  boresight_B: (3,) of the instrument that the zones are for."""
        boresights_B = jnp.tile(boresight_B, (len(self.zone_half_angle), 1))
        zones = PointingConstraint(boresights_B, self.zone_axis_N, self.zone_half_angle)
        drawn = Scenario(RigidBodyState(self.q_BN, self.omega_BN_B), self.q_DN, zones)
        return state.begin(drawn, model).replace(q_e0_previous=self.q_e0_previous)


class Golden(NamedTuple):
    """Situations and the answers to them; float32, leading axis (count,)."""

    situation: np.ndarray  # (count, 12 + 4 zones), the fields of ``Situation`` side by side
    observation: np.ndarray  # (count, entries)
    action: np.ndarray  # (count, 3)


class ShieldGolden(NamedTuple):
    """Situations and what the shield makes of them, none close to a threshold; leading axis (count,)."""

    situation: np.ndarray  # (count, 12 + 4 zones) float32
    requested: np.ndarray  # (count, 3) float32 [N m]
    allowed: np.ndarray  # (count, 3) float32 [N m]
    safe: np.ndarray  # (count,) bool, whether the situation itself is safe


def golden(agent: Agent, count: int, seed: int = 0) -> Golden:
    """Draw situations and answer them."""
    drawn = situations(agent, count, seed)
    observed = np.asarray(_observe(drawn, *_known(agent), agent.controller.network.observed_zones))
    return Golden(_side_by_side(drawn), observed, agent.predict(observed))


def shield_golden(agent: Agent, config: ShieldConfig, count: int, seed: int = 0) -> ShieldGolden:
    """Draw situations and requests; of those that the shield passes and of those that it does not, half the count each.

    Where other roundings could decide otherwise, as they do with a margin a little larger or smaller, none is kept.
    """
    limits = agent.task.spacecraft.torque_limits
    config.check(limits)
    model, boresight_B = _known(agent)
    made = shield.from_config(config, model)
    drawn = situations(agent, _DRAWN_PER_VECTOR * count, seed)
    box = np.random.default_rng(seed).uniform(np.negative(limits), limits, (_DRAWN_PER_VECTOR * count, 3))
    requested = box.astype(np.float32)
    answers = [
        _answer(made.replace(margin=made.margin + shift), drawn, requested, model, boresight_B)
        for shift in (0.0, _MARGIN_SHIFT, -_MARGIN_SHIFT)
    ]
    allowed, safe = (np.stack(answer) for answer in zip(*answers, strict=True))
    steady = np.all(np.ptp(allowed, axis=0) < _STEADY * np.array(limits), axis=1) & (safe[0] == safe).all(axis=0)
    passed = np.all(allowed[0] == requested, axis=1)
    kept = np.concatenate([np.flatnonzero(steady & which)[: count // 2] for which in (passed, ~passed)])
    return ShieldGolden(_side_by_side(drawn)[kept], requested[kept], allowed[0][kept], safe[0][kept])


@jax.jit
def _answer(
    made: Shield, drawn: Situation, requested: jax.Array, model: Model, boresight_B: jax.Array
) -> tuple[jax.Array, jax.Array]:
    def one(situation: Situation, torque_B: jax.Array) -> tuple[jax.Array, jax.Array]:
        at = situation.state(model, boresight_B)
        zones = at.scenario.constraints
        allowed_B = made.filter(at.body, torque_B, zones, state.torque_limits(at, model), model)
        return allowed_B, shield.is_safe(made, at.body, zones, model, made.margin)

    return jax.vmap(one)(drawn, requested)


def _side_by_side(drawn: Situation) -> np.ndarray:
    """Fields as columns (count, 12 + 4 zones)."""
    return np.concatenate([np.reshape(leaf, (len(leaf), -1)) for leaf in jax.tree.leaves(drawn)], axis=1)


def situations(agent: Agent, count: int, seed: int = 0) -> Situation:
    """Draw situations.  Returns leaves (count, ...).

    Angles to the target and rates are spread evenly over the orders of magnitude between resting on the target and
    turning towards it from the other side; targets and zones are anywhere, and some zones after the first are absent.
    """
    rng = np.random.default_rng(seed)
    limits = agent.task.scenario
    angle = jnp.deg2rad(10 ** rng.uniform(np.log10(_SMALLEST_ANGLE_DEG), np.log10(180.0), count))
    rate = _LARGEST_RATE * 10 ** rng.uniform(-4.0, 0.0, count)
    q_DN, q_e = _directions(rng, count, 4), jax.vmap(rotations.from_axis_angle)(_directions(rng, count, 3), angle)
    zones = exported_zone_count(agent.controller.network, limits)
    half_angle = np.deg2rad(rng.uniform(limits.min_half_angle_deg, limits.max_half_angle_deg, (count, zones)))
    half_angle[:, 1:][rng.uniform(size=(count, zones - 1)) < _ABSENT] = ABSENT_HALF_ANGLE
    return Situation(
        q_BN=jax.vmap(rotations.multiply)(q_DN, q_e),
        omega_BN_B=jnp.float32(rate[:, None] * _directions(rng, count, 3)),
        q_DN=q_DN,
        zone_axis_N=_directions(rng, count * zones, 3).reshape(count, zones, 3),
        zone_half_angle=jnp.float32(half_angle),
        # The last step went towards the target at about this rate.
        q_e0_previous=jnp.float32(np.cos(0.5 * (angle + rate * agent.task.step_seconds))),
    )


def _directions(rng: np.random.Generator, count: int, size: int) -> jax.Array:
    vectors = rng.normal(size=(count, size))
    return jnp.float32(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


@functools.partial(jax.jit, static_argnames="observed_zones")
def _observe(drawn: Situation, model: Model, boresight_B: jax.Array, observed_zones: int) -> jax.Array:
    return jax.vmap(lambda one: observation.observe(one.state(model, boresight_B), observed_zones))(drawn)


def _known(agent: Agent) -> tuple[Model, jax.Array]:
    """Spacecraft of an agent, and the telescope (3,) in its body axes."""
    return environment.model_from_config(agent.task), jnp.array(agent.task.spacecraft.boresight)
