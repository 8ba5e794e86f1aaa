"""What a maneuver is made of: the model that controllers and shield know, the truth that flies, states and steps."""

import functools
from typing import Protocol, TypeVar

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.config.uncertainty import MAX_DELAY
from koz_jax.task import dynamics, rotations
from koz_jax.task.actuators import Actuators, ActuatorState, TorqueLimits
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.reward import Outcome, RewardTerms
from koz_jax.task.scenario import Scenario

Tree = TypeVar("Tree")


class Model(struct.PyTreeNode):
    """The spacecraft as controllers and shield know it; traced, so its numbers can be vmapped and randomised."""

    inertia_B: jax.Array  # (3, 3) [kg m^2], symmetric positive definite, in body axes
    actuators: Actuators
    dt: jax.Array  # () [s] time step, over which the torque is held
    max_rate: jax.Array | None = None  # () [rad/s] limit of the rate's norm; None where there is none


class Truth(struct.PyTreeNode):
    """The spacecraft that really flies.  No controller and no shield is given one."""

    inertia_B: jax.Array  # (3, 3) [kg m^2]
    disturbance_B: jax.Array  # (3,) [N m] constant torque from outside, in body axes
    delay: jax.Array | None = None  # () int32, steps by which the torque comes late, to MAX_DELAY; None: never


class EnvState(struct.PyTreeNode):
    """A maneuver under way."""

    body: RigidBodyState
    scenario: Scenario
    angle: jax.Array  # () [rad] full rotation angle to the target
    q_e0_previous: jax.Array  # () scalar part of q_e one step ago
    torque_B: jax.Array  # (3,) [N m] applied in the last step
    steps: jax.Array  # () int32, steps since the reset
    actuators: ActuatorState = None
    on_the_way: jax.Array | None = None  # (MAX_DELAY, 3) last commands, the latest first; None where none is late


class Allowed(struct.PyTreeNode):
    """What a filter lets through."""

    action: jax.Array  # (3,) in [-1, 1]
    feasible: jax.Array  # () bool, whether there was any action that keeps what the filter guarantees


class ActionFilter(Protocol):
    """What stands between a controller and the actuators, such as the shield.  Implementations are pytrees."""

    def covers(self, at: EnvState, model: Model) -> jax.Array:
        """Whether what the filter guarantees holds from this state on.  Returns () bool."""
        ...

    def allow(self, measured: EnvState, action: jax.Array, model: Model) -> Allowed:
        """What is let through in place of the requested action (3,) in [-1, 1]."""
        ...


class Command(struct.PyTreeNode):
    """What is asked of the actuators in a step, as shares of the torque limits."""

    requested: jax.Array  # (3,) by the controller, clipped to [-1, 1]
    applied: jax.Array  # (3,) after the filter
    feasible: jax.Array  # () bool, false where the filter found no action that keeps what it guarantees

    @property
    def intervened(self) -> jax.Array:
        """Whether the filter changed anything.  Returns () bool."""
        return jnp.any(self.applied != self.requested)

    @property
    def change(self) -> jax.Array:
        """What the filter changed.  Returns (3,)."""
        return jax.lax.stop_gradient(self.applied - self.requested)


class Step(struct.PyTreeNode):
    """What one step gives.  The observation has 16 entries, 5 more for each zone above one that is observed."""

    state: EnvState
    observation: jax.Array  # (entries,) to act on next; of the next maneuver where ``step_autoreset`` has begun it
    final_observation: jax.Array  # (entries,) that the step itself led to
    command: Command
    outcome: Outcome
    terms: RewardTerms  # of the paper's reward, unweighted
    terminated: jax.Array  # () bool, always false: neither settling nor a violation ends a maneuver
    truncated: jax.Array  # () bool, the maneuver's time is up


def begin(scenario: Scenario, model: Model, late: bool = False) -> EnvState:
    """The state in which a scenario starts.  late: whether torques may come late."""
    state = EnvState(
        body=scenario.initial,
        scenario=scenario,
        angle=jnp.zeros(()),
        q_e0_previous=jnp.zeros(()),
        torque_B=jnp.zeros(3),
        steps=jnp.zeros((), jnp.int32),
        actuators=model.actuators.initial_state(),
        on_the_way=jnp.zeros((MAX_DELAY, 3)) if late else None,
    )
    q_e = attitude_error(state)
    return state.replace(angle=rotations.rotation_angle(q_e), q_e0_previous=q_e[0])


def attitude_error(state: EnvState) -> jax.Array:
    """q_e = q_d* (x) q, the attitude relative to the target.  Returns (4,)."""
    return rotations.multiply(rotations.conjugate(state.scenario.q_DN), state.body.q_BN)


def torque_limits(state: EnvState, model: Model) -> TorqueLimits:
    """Torques that can be asked for in this state."""
    return model.actuators.limits(state.actuators, state.body.omega_BN_B)


def nominal_limits(model: Model) -> TorqueLimits:
    """Torques that can be asked for at the start of a maneuver, at rest."""
    return model.actuators.limits(model.actuators.initial_state(), jnp.zeros(3))


def largest_rate(state: EnvState, model: Model) -> jax.Array | None:
    """Largest norm of the rate [rad/s] that the spacecraft may have and its actuators can stop; None for any."""
    return _least(model, model.actuators.largest_rate(state.actuators, state.body.omega_BN_B, model.inertia_B))


def nominal_rate(model: Model) -> jax.Array | None:
    """The same at the start of a maneuver, at rest."""
    return _least(model, model.actuators.largest_rate(model.actuators.initial_state(), jnp.zeros(3), model.inertia_B))


def _least(model: Model, of_actuators: jax.Array | None) -> jax.Array | None:
    known = [rate for rate in (model.max_rate, of_actuators) if rate is not None]
    return functools.reduce(jnp.minimum, known) if known else None


def nominal(model: Model) -> Truth:
    """The truth that is as the model says."""
    return Truth(inertia_B=model.inertia_B, disturbance_B=jnp.zeros(3))


def delayed(
    command: jax.Array, on_the_way: jax.Array | None, delay: jax.Array | None
) -> tuple[jax.Array, jax.Array | None]:
    """The command (3,) that reaches the actuators in this step, and those that are on the way after it.

    command: (3,) given in this step; on_the_way: (MAX_DELAY, 3), the latest first; delay: () int32.
    """
    if delay is None:
        return command, on_the_way
    assert on_the_way is not None, "the state was not begun for late torques"
    given = jnp.concatenate([command[None], on_the_way])
    return given[delay], given[:-1]


def propagate(
    body: RigidBodyState, torque_B: jax.Array, truth: Truth, seconds: jax.Array, held_B: jax.Array | None = None
) -> RigidBodyState:
    """What a held torque (3,) [N m] makes of the body in a time () [s], disturbance included.

    held_B: (3,) [N m s] momentum that the actuators hold, and that pays for the torque; None where they hold none.
    """
    stored = None if held_B is None else dynamics.StoredMomentum(held_B, torque_B)
    return dynamics.step(body, torque_B + truth.disturbance_B, truth.inertia_B, seconds, stored)


def select_envs(mask: jax.Array, chosen: Tree, otherwise: Tree) -> Tree:
    """Take the environments of one tree where ``mask`` (n,) holds, those of another elsewhere."""

    def pick(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape((-1,) + (1,) * (new.ndim - 1)), new, old)

    return jax.tree.map(pick, chosen, otherwise)
