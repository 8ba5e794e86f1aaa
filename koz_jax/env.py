"""The reorientation environment of one sample: ``reset`` and ``step``.  Batch it with vmap."""

from typing import TypeVar

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax import dynamics, keep_out, rotations
from koz_jax.dynamics import RigidBodyState, Spacecraft
from koz_jax.reward import Outcome, RewardParams
from koz_jax.scenario import Scenario

Tree = TypeVar("Tree")


class EnvParams(struct.PyTreeNode):
    """Everything physical about the task; traced."""

    spacecraft: Spacecraft
    reward: RewardParams
    dt: jax.Array  # () [s]
    disturbance_B: jax.Array  # (3,) [N m] torque from outside; controllers do not know it


class EnvState(struct.PyTreeNode):
    """A maneuver under way."""

    body: RigidBodyState
    scenario: Scenario
    angle: jax.Array  # () [rad] full rotation angle to the target
    q_e0_previous: jax.Array  # () scalar part of q_e one step ago
    torque_B: jax.Array  # (3,) [N m] applied in the last step
    steps: jax.Array  # () int32, steps since the reset


def attitude_error(state: EnvState) -> jax.Array:
    """q_e = q_d* (x) q, the attitude relative to the target.  Returns (4,)."""
    return rotations.multiply(rotations.conjugate(state.scenario.q_DN), state.body.q_BN)


def boresight_N(body: RigidBodyState, spacecraft: Spacecraft) -> jax.Array:
    """Where the telescope looks.  Returns (3,) unit vector in inertial axes."""
    return rotations.rotate(body.q_BN, spacecraft.boresight_B)


def push(body: RigidBodyState, torque_B: jax.Array, params: EnvParams, dt: jax.Array) -> RigidBodyState:
    """What a held torque (3,) [N m] makes of the body in a time dt () [s], disturbance included."""
    return dynamics.step(body, torque_B + params.disturbance_B, params.spacecraft, dt)


def reset(scenario: Scenario) -> EnvState:
    """The state in which a scenario starts."""
    state = EnvState(
        body=scenario.initial,
        scenario=scenario,
        angle=jnp.zeros(()),
        q_e0_previous=jnp.zeros(()),
        torque_B=jnp.zeros(3),
        steps=jnp.zeros((), jnp.int32),
    )
    q_e = attitude_error(state)
    return state.replace(angle=rotations.rotation_angle(q_e), q_e0_previous=q_e[0])


def step(state: EnvState, action: jax.Array, params: EnvParams) -> tuple[EnvState, Outcome]:
    """Apply an action for one time step.

    action: (3,) in [-1, 1] (clipped), scaled by the torque limit.  Returns the next state and what the reward needs.
    """
    torque_B = params.spacecraft.torque_limit * jnp.clip(action, -1.0, 1.0)
    next_state = state.replace(
        body=push(state.body, torque_B, params, params.dt),
        q_e0_previous=attitude_error(state)[0],
        torque_B=torque_B,
        steps=state.steps + 1,
    )
    next_state = next_state.replace(angle=rotations.rotation_angle(attitude_error(next_state)))
    change = jnp.where(state.steps == 0, 0.0, rotations.norm(torque_B - state.torque_B))
    outcome = Outcome(
        angle=next_state.angle,
        angle_previous=state.angle,
        torque=rotations.norm(torque_B),
        torque_change=change,
        zone_margin=keep_out.smallest_margin(boresight_N(next_state.body, params.spacecraft), state.scenario.zones),
        intervention=jnp.zeros(()),
    )
    return next_state, outcome


def choose(mask: jax.Array, chosen: Tree, otherwise: Tree) -> Tree:
    """Take the environments of one tree where ``mask`` (n,) holds, those of another elsewhere."""

    def pick(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape((-1,) + (1,) * (new.ndim - 1)), new, old)

    return jax.tree.map(pick, chosen, otherwise)
