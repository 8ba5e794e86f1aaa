"""Golden vectors: situations all over the flight envelope, with what the core observes and the agent decides there."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from koz_jax.agents.agent import Agent
from koz_jax.agents.numpy_policy import exported_zone_count
from koz_jax.config.actuators.wheels import Wheels
from koz_jax.config.base import Vector
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.training import NetworkConfig
from koz_jax.evaluation.cases import draw_case
from koz_jax.task import environment, observation, rotations, state
from koz_jax.task.actuators import ReactionWheels
from koz_jax.task.any_spacecraft import nondimensional, units
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE, FREE_RATE, LEAST_RATE
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.scenario import Scenario
from koz_jax.task.state import EnvState, Model

# Case of ``koz evaluate`` that the exported example flies.
EXAMPLE_CASE = 0

_SMALLEST_ANGLE_DEG, _LARGEST_RATE = 1e-3, 0.2  # [deg], [rad/s]
_ABSENT = 0.25  # share of zones after the first
_LEAST_FILL, _NEARLY_FULL, _EVERY_FULL = 0.01, 0.99, 3  # of wheels' largest momentum; every third set has a full one

# Of wheels, situations drawn for each that is kept, and what a small change of their momentum may change.
_DRAWN_ON_WHEELS = 2
_SHIFT, _STEADY = 1e-6, 1e-4


class Situation(struct.PyTreeNode):
    """What an exported controller derives the observation from, in the order of its ``koz_situation``."""

    q_BN: jax.Array  # (4,)
    omega_BN_B: jax.Array  # (3,) [rad/s]
    q_DN: jax.Array  # (4,) target
    zone_axis_N: jax.Array  # (zones, 3) unit vectors
    zone_half_angle: jax.Array  # (zones,) [rad]
    wheel_momentum: jax.Array | None = None  # (wheels,) [N m s]; None where there are no wheels
    zone_instrument: jax.Array | None = None  # (zones,) int32, number of each zone's; None where there is one

    def state(self, model: Model, boresights_B: jax.Array) -> EnvState:
        """The core's own state, as at a start.  boresights_B: (3,), or of several instruments (n, 3)."""
        if self.zone_instrument is None:
            looks_B = jnp.tile(boresights_B, (len(self.zone_half_angle), 1))
        else:
            looks_B = boresights_B[self.zone_instrument]
        zones = PointingConstraint(looks_B, self.zone_axis_N, self.zone_half_angle)
        start = state.begin(Scenario(RigidBodyState(self.q_BN, self.omega_BN_B), self.q_DN, zones), model)
        return start if self.wheel_momentum is None else start.replace(actuators=self.wheel_momentum)


class Golden(NamedTuple):
    """Situations and the answers to them; float32, leading axis (count,)."""

    situation: np.ndarray  # (count, 11 + 4 zones + wheels), of several instruments (count, 11 + 5 zones + wheels): the
    # fields of ``Situation`` side by side; attitudes of either sign
    memory: np.ndarray  # (count, 4) q_e one step ago, of the sign that is continuous with the observation's; then the
    # urgency where the policy sees one, three zeros where there are wheels, and 0 where there are several instruments
    observation: np.ndarray  # (count, entries)
    action: np.ndarray  # (count, 3)
    torque: np.ndarray  # (count, 3) [N m] body axes
    wheel_torque: np.ndarray  # (count, wheels) [N m] of each wheel for that torque


def golden(
    agent: Agent, count: int, seed: int = 0, further_boresights: Sequence[Vector] = (), least_zones: int = 0
) -> Golden:
    """Draw situations, and urgencies where the policy sees one, and answer them.

    further_boresights: unit vectors (3,) in body axes, of instruments beside the task's own; least_zones: so many are
    told at least.
    """
    model, boresights_B = known(agent, further_boresights)
    network, wheels = agent.controller.network, agent.task.spacecraft.wheels
    instruments = 1 + len(further_boresights)
    if wheels:
        drawn = _steady(situations(agent, _DRAWN_ON_WHEELS * count, seed, instruments, least_zones), model, count)
    else:
        drawn = situations(agent, count, seed, instruments, least_zones)
    rng = np.random.default_rng(seed)
    # Sensors may hand over either sign, and what is observed stays the same.
    sign = rng.choice([-1.0, 1.0], (count, 1)).astype(np.float32)
    urgency = rng.uniform(size=(count, 1)).astype(np.float32)
    memory, observed = map(np.asarray, _observe(drawn, urgency[:, 0], model, boresights_B, network))
    action = agent.predict(observed)
    torque, wheel_torque = map(np.asarray, _torque(drawn, action, model, boresights_B, network))
    memory = np.concatenate([memory, urgency], axis=1) if network.scaled else memory
    memory = np.pad(memory, ((0, 0), (0, 3 * bool(wheels) + bool(further_boresights))))
    return Golden(rows(drawn.replace(q_BN=sign * drawn.q_BN)), memory, observed, action, torque, wheel_torque)


def example(agent: Agent, several: bool = False, least_zones: int = 0) -> np.ndarray:
    """Where the maneuver of the exported example starts; its zones are for instrument 0, also of several.

    least_zones: so many are told at least.  Returns (entries,) float32, a row as in ``Golden``.
    """
    drawn = draw_case(agent.task, MonteCarloConfig(), EXAMPLE_CASE)
    zones = drawn.constraints
    missing = exported_zone_count(agent.controller.network, agent.task.scenario, least_zones) - zones.count
    momenta = [wheel.momentum for wheel in agent.task.spacecraft.wheels]
    start = Situation(
        q_BN=drawn.initial.q_BN,
        omega_BN_B=drawn.initial.omega_BN_B,
        q_DN=drawn.q_DN,
        zone_axis_N=jnp.concatenate([zones.axis_N, jnp.tile(jnp.array([1.0, 0.0, 0.0]), (missing, 1))]),
        zone_half_angle=jnp.concatenate([zones.half_angle, jnp.full(missing, ABSENT_HALF_ANGLE)]),
        wheel_momentum=jnp.array(momenta) if momenta else None,
        zone_instrument=jnp.zeros(zones.count + missing, jnp.int32) if several else None,
    )
    return rows(jax.tree.map(lambda leaf: leaf[None], start))[0]


def rows(drawn: Situation) -> np.ndarray:
    """Fields of situations with a leading axis (count,) as columns.

    Returns (count, entries) float32, as in ``Golden``.
    """
    columns = [np.reshape(leaf, (len(leaf), -1)) for leaf in jax.tree.leaves(drawn)]
    return np.concatenate(columns, axis=1, dtype=np.float32)


def situations(agent: Agent, count: int, seed: int = 0, instruments: int = 1, least_zones: int = 0) -> Situation:
    """Draw situations.  Returns leaves (count, ...).

    Angles to the target and rates are spread evenly over the orders of magnitude between resting on the target and
    turning towards it from the other side; targets and zones are anywhere, and some zones after the first are absent.
    For a policy for any spacecraft, rates are those of the paper's in units of its own, and zones are for one of its
    instruments each.  Wheels hold any momentum, and in every third situation one of them is nearly full.
    """
    rng = np.random.default_rng(seed)
    limits = agent.task.scenario
    angle = jnp.deg2rad(10 ** rng.uniform(np.log10(_SMALLEST_ANGLE_DEG), np.log10(180.0), count))
    largest_rate = _LARGEST_RATE * (agent.task.time_to_paper if agent.controller.network.scaled else 1.0)
    rate = largest_rate * 10 ** rng.uniform(-4.0, 0.0, count)
    q_DN, q_e = directions(rng, count, 4), jax.vmap(rotations.from_axis_angle)(directions(rng, count, 3), angle)
    zones = exported_zone_count(agent.controller.network, limits, least_zones)
    half_angle = np.deg2rad(rng.uniform(limits.min_half_angle_deg, limits.max_half_angle_deg, (count, zones)))
    half_angle[:, 1:][rng.uniform(size=(count, zones - 1)) < _ABSENT] = ABSENT_HALF_ANGLE
    drawn = Situation(
        q_BN=jax.vmap(rotations.multiply)(q_DN, q_e),
        omega_BN_B=jnp.float32(rate[:, None] * directions(rng, count, 3)),
        q_DN=q_DN,
        zone_axis_N=directions(rng, count * zones, 3).reshape(count, zones, 3),
        zone_half_angle=jnp.float32(half_angle),
        zone_instrument=jnp.int32(rng.integers(instruments, size=(count, zones))) if instruments > 1 else None,
    )
    wheels = agent.task.spacecraft.wheels
    return drawn.replace(wheel_momentum=_momenta(rng, count, wheels)) if wheels else drawn


def _momenta(rng: np.random.Generator, count: int, wheels: Wheels) -> jax.Array:
    """Draw momenta of wheels.  Returns (count, wheels) [N m s] float32."""
    shares = _LEAST_FILL ** rng.uniform(size=(count, 1)) * rng.uniform(-1.0, 1.0, (count, len(wheels)))
    full = np.arange(0, count, _EVERY_FULL)
    ends = rng.choice([-1.0, 1.0], len(full)) * rng.uniform(_NEARLY_FULL, 1.0, len(full))
    shares[full, rng.integers(len(wheels), size=len(full))] = ends
    return jnp.float32(shares * np.array([wheel.max_momentum for wheel in wheels]))


def _steady(drawn: Situation, model: Model, count: int) -> Situation:
    """The first situations in which other roundings change nothing: near its end, the rate limit's logarithm is steep.

    Returns leaves (count, ...).
    """
    held = drawn.wheel_momentum
    assert held is not None
    shifted = [_seen_rate((1.0 + shift) * held, drawn.omega_BN_B, model) for shift in (-_SHIFT, 0.0, _SHIFT)]
    kept = np.flatnonzero(np.ptp(shifted, axis=0) < _STEADY)[:count]
    return jax.tree.map(lambda leaf: leaf[kept], drawn)


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, 0, None))
def _seen_rate(momentum: jax.Array, omega_BN_B: jax.Array, model: Model) -> jax.Array:
    largest = model.actuators.largest_rate(momentum, omega_BN_B, model.inertia_B)
    assert largest is not None
    return jnp.log(jnp.maximum(units.of(model).time * largest, FREE_RATE * LEAST_RATE))


def directions(rng: np.random.Generator, count: int, size: int) -> jax.Array:
    """Draw unit vectors evenly.  Returns (count, size) float32."""
    vectors = rng.normal(size=(count, size))
    return jnp.float32(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def known(agent: Agent, further_boresights: Sequence[Vector] = ()) -> tuple[Model, jax.Array]:
    """Spacecraft of an agent, and the telescope (3,) in its body axes; of several instruments all, (n, 3)."""
    own = agent.task.spacecraft.boresight
    boresights_B = jnp.array([own, *further_boresights] if further_boresights else own)
    return environment.model_from_config(agent.task), boresights_B


@functools.partial(jax.jit, static_argnames="network")
def _observe(
    drawn: Situation, urgency: jax.Array, model: Model, boresights_B: jax.Array, network: NetworkConfig
) -> tuple[jax.Array, jax.Array]:
    """Attitude errors one step ago, at the same rate, and what is observed now; leading axis (count,)."""

    def one(situation: Situation, urgency: jax.Array) -> tuple[jax.Array, jax.Array]:
        now = situation.state(model, boresights_B)
        turned = model.dt * situation.omega_BN_B
        angle = rotations.norm(turned)
        back = rotations.from_axis_angle(turned / jnp.where(angle > 0.0, angle, 1.0), -angle)
        before = rotations.multiply(state.attitude_error(now), back)
        now = now.replace(q_e0_previous=before[0])
        if network.scaled:
            return before, nondimensional.observe(now, model, urgency, network.observed_zones)
        return before, observation.observe(now, network.observed_zones)

    return jax.vmap(one)(drawn, urgency)


@functools.partial(jax.jit, static_argnames="network")
def _torque(
    drawn: Situation, action: jax.Array, model: Model, boresights_B: jax.Array, network: NetworkConfig
) -> tuple[jax.Array, jax.Array]:
    """What is asked for by actions (count, 3) in these situations.  Returns torques (count, 3), (count, wheels)."""

    def one(situation: Situation, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        at = situation.state(model, boresights_B)
        command = nondimensional.command(action, at, model) if network.scaled else action
        torque_B = state.torque_limits(at, model).box_B * jnp.clip(command, -1.0, 1.0)
        wheels = model.actuators
        if not isinstance(wheels, ReactionWheels):
            return torque_B, jnp.zeros(0)
        return torque_B, wheels.torques(torque_B, at.actuators, at.body.omega_BN_B, model.inertia_B, model.dt)

    return jax.vmap(one)(drawn, action)
