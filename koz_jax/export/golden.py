"""Golden vectors: situations all over the flight envelope, with what the core observes and the agent decides there."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from koz_jax import env, observation, rotations, task
from koz_jax.agent import Agent
from koz_jax.dynamics import RigidBodyState
from koz_jax.env import EnvParams, EnvState
from koz_jax.keep_out import NO_ZONE_HALF_ANGLE, KeepOutZone
from koz_jax.numpy_policy import told_zones
from koz_jax.scenario import Scenario

_SMALLEST_ANGLE_DEG, _LARGEST_RATE = 1e-3, 0.2  # [deg], [rad/s]
_ABSENT = 0.25  # share of zones after the first


class Situation(struct.PyTreeNode):
    """What an exported controller derives the observation from, in the order of its ``koz_situation``."""

    q_BN: jax.Array  # (4,)
    omega_BN_B: jax.Array  # (3,) [rad/s]
    q_DN: jax.Array  # (4,) target
    zone_axis_N: jax.Array  # (zones, 3) unit vectors
    zone_half_angle: jax.Array  # (zones,) [rad]
    q_e0_previous: jax.Array  # ()

    def state(self) -> EnvState:
        """The core's own state."""
        zones = KeepOutZone(self.zone_axis_N, self.zone_half_angle)
        state = env.reset(Scenario(RigidBodyState(self.q_BN, self.omega_BN_B), self.q_DN, zones))
        return state.replace(q_e0_previous=self.q_e0_previous)


class Golden(NamedTuple):
    """Situations and the answers to them; float32, leading axis (count,)."""

    situation: np.ndarray  # (count, 12 + 4 zones), the fields of ``Situation`` side by side
    observation: np.ndarray  # (count, entries)
    action: np.ndarray  # (count, 3)


def golden(agent: Agent, count: int, seed: int = 0) -> Golden:
    """Draw situations and answer them."""
    drawn = situations(agent, count, seed)
    observed = np.asarray(_observe(drawn, task.env_params(agent.task), agent.controller.network.observed_zones))
    rows = [np.reshape(leaf, (count, -1)) for leaf in jax.tree.leaves(drawn)]
    return Golden(np.concatenate(rows, axis=1), observed, agent.predict(observed))


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
    zones = told_zones(agent.controller.network, limits)
    half_angle = np.deg2rad(rng.uniform(limits.min_half_angle_deg, limits.max_half_angle_deg, (count, zones)))
    half_angle[:, 1:][rng.uniform(size=(count, zones - 1)) < _ABSENT] = NO_ZONE_HALF_ANGLE
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
def _observe(drawn: Situation, params: EnvParams, observed_zones: int) -> jax.Array:
    return jax.vmap(lambda one: observation.observe(one.state(), params, observed_zones))(drawn)
