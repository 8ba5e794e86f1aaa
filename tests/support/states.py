"""States of maneuvers for the tests of controllers: anywhere, and at the places where formulas may break."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from koz_jax.config.task import TaskConfig
from koz_jax.task import environment, rotations, state
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.scenario import Scenario
from koz_jax.task.state import EnvState, Model

MODEL = environment.model_from_config(TaskConfig())
LOOK = jnp.array([1.0, 0.0, 0.0])  # boresight of the paper's spacecraft


def model_with(**spacecraft: Any) -> Model:
    """The model of the paper's spacecraft with some settings changed."""
    return environment.model_from_config(TaskConfig.model_validate({"spacecraft": spacecraft}))


def quaternions(count: int, seed: int) -> jax.Array:
    draws = np.random.default_rng(seed).standard_normal((count, 4))
    return jnp.asarray(draws / np.linalg.norm(draws, axis=1, keepdims=True), jnp.float32)


def directions(count: int, seed: int) -> jax.Array:
    draws = np.random.default_rng(seed).standard_normal((count, 3))
    return jnp.asarray(draws / np.linalg.norm(draws, axis=1, keepdims=True), jnp.float32)


def state_of(
    q_BN: jax.Array, omega_B: jax.Array, q_DN: jax.Array, axes_N: jax.Array, half_angles: jax.Array
) -> EnvState:
    """At a start, with zones for the paper's boresight."""
    zones = PointingConstraint(jnp.tile(LOOK, (axes_N.shape[0], 1)), axes_N, half_angles)
    return state.begin(Scenario(RigidBodyState(q_BN, omega_B), q_DN, zones), MODEL)


states_of = jax.vmap(state_of)


def random_states(count: int, seed: int, rate: float = 0.2) -> EnvState:
    """States anywhere, with two zones and an absent one."""
    half_angles = jnp.tile(jnp.array([0.4, 0.3, ABSENT_HALF_ANGLE]), (count, 1))
    axes_N = directions(3 * count, seed + 1).reshape(count, 3, 3)
    omega_B = rate * directions(count, seed + 2)
    return states_of(quaternions(count, seed), omega_B, quaternions(count, seed + 3), axes_N, half_angles)


def special_states() -> EnvState:
    """At the target, half a turn and a whole turn away, and looking at a zone's axis, edge and inside.  As many as
    there are random states, for a single compilation."""
    beside = jnp.array([0.0, 0.0, 1.0])

    def zone_at(angle: float) -> jax.Array:
        return rotations.rotate(rotations.from_axis_angle(beside, jnp.float32(angle)), LOOK)

    upright, half, whole = jnp.eye(4)[0], jnp.eye(4)[2], -jnp.eye(4)[0]
    attitudes = jnp.stack([upright, half, whole, upright, upright, jnp.eye(4)[1], jnp.eye(4)[3], upright])
    axes = jnp.stack([zone_at(angle) for angle in (2.0, 1.0, 0.5, 0.0, 0.3, 0.1, 0.3, 0.2)])
    rates = jnp.repeat(jnp.array([[0.0, 0.0, 0.0], [0.5, -0.5, 1.0], [0.0, 0.0, 0.1], [-2.0, 0.0, 0.0]]), 8, axis=0)
    zones = jnp.tile(axes[None, :, None], (4, 1, 3, 1)).reshape(32, 3, 3)
    return states_of(
        jnp.tile(attitudes, (4, 1)),
        rates,
        jnp.tile(upright, (32, 1)),
        zones,
        jnp.tile(jnp.array([0.3, 0.3, -3.0]), (32, 1)),
    )


@jax.jit
def _first_actions(controller: Any, states: EnvState, model: Model, keys: jax.Array) -> jax.Array:
    def first(at: EnvState, key: jax.Array) -> jax.Array:
        return controller.decide(at, model, controller.begin(at, model, key))[0]

    return jax.vmap(first)(states, keys)


def actions(controller: Any, states: EnvState, model: Model = MODEL) -> np.ndarray:
    """What a controller does first in each state.  Returns (states, 3)."""
    keys = jax.random.split(jax.random.key(0), states.steps.shape[0])
    return np.asarray(_first_actions(controller, states, model, keys))
