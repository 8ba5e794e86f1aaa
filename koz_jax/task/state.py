"""What a maneuver is made of: the model that controllers and shield know, the truth that flies, and the state."""

from typing import TypeVar

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.task import dynamics, rotations
from koz_jax.task.actuators import Actuators, ActuatorState, TorqueLimits
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.scenario import Scenario

Tree = TypeVar("Tree")


class Model(struct.PyTreeNode):
    """The spacecraft as controllers and shield know it; traced, so its numbers can be vmapped and randomised."""

    inertia_B: jax.Array  # (3, 3) [kg m^2], symmetric positive definite, in body axes
    actuators: Actuators
    dt: jax.Array  # () [s] time step, over which the torque is held


class Truth(struct.PyTreeNode):
    """The spacecraft that really flies.  No controller and no shield is given one."""

    inertia_B: jax.Array  # (3, 3) [kg m^2]
    disturbance_B: jax.Array  # (3,) [N m] constant torque from outside, in body axes


class EnvState(struct.PyTreeNode):
    """A maneuver under way."""

    body: RigidBodyState
    scenario: Scenario
    angle: jax.Array  # () [rad] full rotation angle to the target
    q_e0_previous: jax.Array  # () scalar part of q_e one step ago
    torque_B: jax.Array  # (3,) [N m] applied in the last step
    steps: jax.Array  # () int32, steps since the reset
    actuators: ActuatorState = None


def begin(scenario: Scenario, model: Model) -> EnvState:
    """The state in which a scenario starts."""
    state = EnvState(
        body=scenario.initial,
        scenario=scenario,
        angle=jnp.zeros(()),
        q_e0_previous=jnp.zeros(()),
        torque_B=jnp.zeros(3),
        steps=jnp.zeros((), jnp.int32),
        actuators=model.actuators.initial_state(),
    )
    q_e = attitude_error(state)
    return state.replace(angle=rotations.rotation_angle(q_e), q_e0_previous=q_e[0])


def attitude_error(state: EnvState) -> jax.Array:
    """q_e = q_d* (x) q, the attitude relative to the target.  Returns (4,)."""
    return rotations.multiply(rotations.conjugate(state.scenario.q_DN), state.body.q_BN)


def torque_limits(state: EnvState, model: Model) -> TorqueLimits:
    """Torques that can be asked for in this state."""
    return model.actuators.limits(state.actuators)


def nominal(model: Model) -> Truth:
    """The truth that is as the model says."""
    return Truth(inertia_B=model.inertia_B, disturbance_B=jnp.zeros(3))


def propagate(body: RigidBodyState, torque_B: jax.Array, truth: Truth, seconds: jax.Array) -> RigidBodyState:
    """What a held torque (3,) [N m] makes of the body in a time () [s], disturbance included."""
    return dynamics.step(body, torque_B + truth.disturbance_B, truth.inertia_B, seconds)


def select_envs(mask: jax.Array, chosen: Tree, otherwise: Tree) -> Tree:
    """Take the environments of one tree where ``mask`` (n,) holds, those of another elsewhere."""

    def pick(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape((-1,) + (1,) * (new.ndim - 1)), new, old)

    return jax.tree.map(pick, chosen, otherwise)
