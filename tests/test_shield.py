"""What the shield guarantees, against an independent float64 integration, and that it lets through what it can."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from flax import struct
from hypothesis import given, settings
from hypothesis import strategies as st

from koz_jax import env, evaluation, rotations, scenario, shield, task
from koz_jax.agent import load_agent
from koz_jax.controllers.registry import load_controller
from koz_jax.dynamics import RigidBodyState
from koz_jax.env import EnvParams, EnvState
from koz_jax.evaluation import MonteCarloConfig
from koz_jax.keep_out import NO_ZONE_HALF_ANGLE, KeepOutZone
from koz_jax.scenario import Scenario
from koz_jax.shield_config import ShieldConfig, UncertaintyConfig
from koz_jax.task_config import SpacecraftConfig, TaskConfig

TASK = TaskConfig()
PARAMS = task.env_params(TASK)
SHIELD = shield.for_spacecraft(ShieldConfig(), PARAMS.spacecraft, PARAMS.dt)
MARGIN = float(SHIELD.margin)
STATES = 64
ERRORS = UncertaintyConfig(inertia_error=0.1, disturbance_torque=0.01, attitude_noise_deg=0.01, rate_noise_deg=0.001)


def _states(seed: int, max_rate: float, zones: int = 2) -> tuple[RigidBodyState, KeepOutZone]:
    """Random attitudes, rates up to ``max_rate`` [rad/s], zones that the boresight is near to."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(STATES, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    omega = rng.normal(size=(STATES, 3))
    omega *= max_rate * rng.uniform(size=(STATES, 1)) / np.linalg.norm(omega, axis=1, keepdims=True)
    axes = np.array([oracle.rotation(attitude).apply(oracle.BORESIGHT) for attitude in q])[:, None]
    axes = axes + rng.normal(scale=0.7, size=(STATES, zones, 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    half_angles = rng.uniform(0.1, 0.7, size=(STATES, zones))
    arrays = (jnp.asarray(x, jnp.float32) for x in (q, omega, axes, half_angles))
    q, omega, axes, half_angles = arrays
    return RigidBodyState(q, omega), KeepOutZone(axes, half_angles)


@jax.jit
def _safe(bodies: RigidBodyState, zones: KeepOutZone) -> jax.Array:
    return jax.vmap(lambda body, zone: shield.is_safe(SHIELD, body, zone, PARAMS, SHIELD.margin))(bodies, zones)


@jax.jit
def _filter(bodies: RigidBodyState, torques_B: jax.Array, zones: KeepOutZone) -> jax.Array:
    return jax.vmap(lambda body, torque_B, zone: SHIELD.filter(body, torque_B, zone, PARAMS))(bodies, torques_B, zones)


def _margins(q: np.ndarray, axes: np.ndarray, half_angles: np.ndarray) -> np.ndarray:
    """Margin to the nearest zone in double precision.  q: (n, 4).  Returns (n,)."""
    looks = oracle.rotation(q).apply(oracle.BORESIGHT)
    return (oracle.angle_between(looks[:, None], axes) - half_angles).min(axis=1)


def _brake_to_rest(bodies: RigidBodyState, zones: KeepOutZone) -> np.ndarray:
    """Smallest margin while the brake works to the end, by the oracle, checked 4 times a step.  Returns (n,)."""
    brake = jax.jit(jax.vmap(lambda body: shield.brake_torque(SHIELD, body, PARAMS)))
    q, omega = (np.asarray(leaf, np.float64) for leaf in (bodies.q_BN, bodies.omega_BN_B))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    axes, half_angles = np.asarray(zones.axis_N, np.float64), np.asarray(zones.half_angle, np.float64)
    smallest = _margins(q, axes, half_angles)
    while np.linalg.norm(omega, axis=1).max() > 1e-6:
        torques = np.asarray(brake(RigidBodyState(jnp.float32(q), jnp.float32(omega))), np.float64)
        for _ in range(4):
            q, omega = oracle.propagate_many(q, omega, torques, oracle.DT / 4)
            smallest = np.minimum(smallest, _margins(q, axes, half_angles))
    return smallest


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 10**6), max_rate=st.sampled_from([0.05, 0.2, 0.5]))
def test_braking_from_a_safe_state_keeps_the_margin(seed, max_rate):
    bodies, zones = _states(seed, max_rate)
    safe = np.asarray(_safe(bodies, zones))
    clearance = _brake_to_rest(bodies, zones)
    assert np.all(clearance[safe] >= MARGIN - 1e-5)
    # It is not safe by calling nothing safe: what keeps well clear at a common rate is.
    if max_rate <= 0.2:
        assert np.all(safe[clearance > MARGIN + np.deg2rad(3.0)])


def test_the_oracle_of_many_states_is_the_one_of_one_state():
    rng = np.random.default_rng(0)
    q, omega, torque = (rng.normal(size=(3, size)) for size in (4, 3, 3))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    found = oracle.propagate_many(q, omega, torque, 0.1)
    for i in range(3):
        for one, many in zip(oracle.propagate(q[i], omega[i], torque[i], 0.1), found, strict=True):
            np.testing.assert_allclose(many[i], one, atol=1e-9)


def test_the_states_of_these_tests_are_both_safe_and_not():
    shares = [np.asarray(_safe(*_states(seed, 0.2))).mean() for seed in range(5)]
    assert 0.2 < np.mean(shares) < 0.8


@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_what_passes_leads_to_a_safe_state_or_is_the_brake(seed):
    bodies, zones = _states(seed, 0.3)
    rng = np.random.default_rng(seed)
    torques_B = jnp.asarray(rng.uniform(-2.0, 2.0, size=(STATES, 3)), jnp.float32)
    allowed_B = np.asarray(_filter(bodies, torques_B, zones))
    assert np.all(np.abs(allowed_B) <= 2.0 + 1e-6)
    brake_B = np.asarray(jax.vmap(lambda body: shield.brake_torque(SHIELD, body, PARAMS))(bodies))
    braked = np.all(np.abs(allowed_B - brake_B) < 1e-5, axis=1)
    q, omega = (np.asarray(leaf, np.float64) for leaf in (bodies.q_BN, bodies.omega_BN_B))
    q, omega = oracle.propagate_many(q, omega, allowed_B, oracle.DT)
    after = RigidBodyState(jnp.float32(q), jnp.float32(omega))
    half = jax.vmap(lambda body, zone: shield.is_safe(SHIELD, body, zone, PARAMS, 0.49 * SHIELD.margin))
    assert np.all(braked | np.asarray(half(after, zones)))


def test_a_request_that_leads_to_a_safe_state_passes_to_the_last_bit():
    bodies, zones = _states(3, 0.02)
    far = zones.replace(axis_N=-zones.axis_N)
    torques_B = jnp.asarray(np.random.default_rng(0).uniform(-2.0, 2.0, size=(STATES, 3)), jnp.float32)
    clear = _margins(np.asarray(bodies.q_BN), np.asarray(far.axis_N), np.asarray(far.half_angle)) > 0.3
    assert clear.sum() > STATES / 2
    np.testing.assert_array_equal(_filter(bodies, torques_B, far)[clear], torques_B[clear])


def test_without_a_zone_everything_passes():
    bodies, zones = _states(4, 1.0)
    absent = zones.replace(half_angle=jnp.full_like(zones.half_angle, NO_ZONE_HALF_ANGLE))
    torques_B = jnp.asarray(np.random.default_rng(0).uniform(-2.0, 2.0, size=(STATES, 3)), jnp.float32)
    np.testing.assert_array_equal(_filter(bodies, torques_B, absent), torques_B)


def test_the_answer_does_not_depend_on_the_inertial_frame():
    bodies, zones = _states(5, 0.3)
    torques_B = jnp.asarray(np.random.default_rng(0).uniform(-2.0, 2.0, size=(STATES, 3)), jnp.float32)
    turn = rotations.normalize(jnp.array([0.3, -0.5, 0.7, 0.2]))
    turned = bodies.replace(q_BN=jax.vmap(functools.partial(rotations.multiply, turn))(bodies.q_BN))
    axes = jax.vmap(jax.vmap(functools.partial(rotations.rotate, turn)))(zones.axis_N)
    expected = _filter(bodies, torques_B, zones)
    assert 0.2 < np.mean(np.any(expected != torques_B, axis=1)) < 0.9
    np.testing.assert_allclose(_filter(turned, torques_B, zones.replace(axis_N=axes)), expected, atol=1e-3)


def test_the_brake_takes_the_momentum_away_at_full_strength_and_then_rests():
    bodies, _ = _states(6, 0.5)
    brake = jax.jit(jax.vmap(lambda body: shield.brake_torque(SHIELD, body, PARAMS)))
    q, omega = (np.asarray(leaf, np.float64) for leaf in (bodies.q_BN, bodies.omega_BN_B))
    momentum = np.linalg.norm(omega @ oracle.INERTIA.T, axis=1)
    for _ in range(20):
        torques = np.asarray(brake(RigidBodyState(jnp.float32(q), jnp.float32(omega))), np.float64)
        assert np.all(np.abs(torques) <= 2.0 + 1e-6)
        q, omega = oracle.propagate_many(q, omega, torques, oracle.DT)
        after = np.linalg.norm(omega @ oracle.INERTIA.T, axis=1)
        np.testing.assert_allclose(after, np.maximum(momentum - 2.0 * oracle.DT, 0.0), atol=2e-3)
        momentum = after
    at_rest = RigidBodyState(jnp.float32(q), jnp.zeros_like(bodies.omega_BN_B))
    np.testing.assert_array_equal(brake(at_rest), 0.0)


def test_a_start_is_slowed_down_until_it_is_safe_and_no_further():
    bodies, zones = _states(7, 0.5)
    target = jnp.array([1.0, 0.0, 0.0, 0.0])
    begin = jax.vmap(lambda body, zone: shield.safe_start(SHIELD, Scenario(body, target, zone), PARAMS))
    slowed = jax.jit(begin)(bodies, zones).initial
    safe = np.asarray(_safe(bodies, zones))
    np.testing.assert_array_equal(slowed.omega_BN_B[safe], bodies.omega_BN_B[safe])
    at_rest = bodies.replace(omega_BN_B=jnp.zeros_like(bodies.omega_BN_B))
    can_be = np.asarray(_safe(at_rest, zones))
    assert np.any(can_be & ~safe)
    assert np.all(np.asarray(_safe(slowed, zones))[can_be])
    twice = slowed.replace(omega_BN_B=2.0 * slowed.omega_BN_B)
    assert not np.any(np.asarray(_safe(twice, zones))[can_be & ~safe])
    np.testing.assert_allclose(jnp.cross(slowed.omega_BN_B, bodies.omega_BN_B), 0.0, atol=1e-6)


ROGUES = ("random", "bang_bang", "adversary", "spin_up")


class AnyRogue(struct.PyTreeNode):
    """One of the rogues, so that all are compiled once."""

    which: jax.Array  # () int32
    rogues: tuple[Any, ...]

    def begin(self, state: EnvState, params: EnvParams, key: jax.Array) -> list[Any]:
        return [rogue.begin(state, params, key) for rogue in self.rogues]

    def decide(self, state: EnvState, params: EnvParams, memory: list[Any]) -> tuple[jax.Array, list[Any]]:
        decided = [rogue.decide(state, params, kept) for rogue, kept in zip(self.rogues, memory, strict=True)]
        return jnp.stack([action for action, _ in decided])[self.which], [kept for _, kept in decided]


FLOWN = TASK.with_rules(zones=2, max_rate_deg=5.0).model_copy(update={"episode_seconds": 40.0})
FREE = MonteCarloConfig(cases=40, substeps=2)
GUARDED = MonteCarloConfig(cases=40, substeps=2, shield=ShieldConfig())
ROBUST = MonteCarloConfig(cases=40, substeps=2, shield=ShieldConfig(withstands=ERRORS), uncertainty=ERRORS)


def _violations(name: str, config: MonteCarloConfig, flown: TaskConfig = FLOWN) -> int:
    rogues = tuple(load_controller(rogue).controller for rogue in ROGUES)
    results = evaluation.fly_cases(AnyRogue(jnp.int32(ROGUES.index(name)), rogues), flown, config)
    return int(np.sum(results.violated))


@pytest.mark.parametrize("name", ROGUES)
def test_rogues_enter_the_zone_and_with_the_shield_never(name):
    assert _violations(name, FREE) >= 8
    assert _violations(name, GUARDED) == 0


@pytest.mark.parametrize("name", ROGUES)
def test_the_guarantee_holds_for_the_errors_that_it_is_made_for(name):
    assert _violations(name, ROBUST) == 0


def test_another_spacecraft_is_guarded_too():
    craft = SpacecraftConfig(
        inertia=((9.0, 0.5, 0.2), (0.5, 12.0, -0.3), (0.2, -0.3, 6.0)), boresight=(0.0, 0.6, 0.8), torque_limit=0.3
    )
    flown = FLOWN.model_copy(update={"spacecraft": craft})
    assert _violations("adversary", FREE, flown) >= 20
    assert _violations("adversary", GUARDED, flown) == 0


def test_the_shipped_agent_flies_under_the_shield_as_it_does_without():
    agent = load_agent("phase2")
    flown = agent.task.model_copy(update={"episode_seconds": 40.0})
    free, guarded = (
        evaluation.fly_cases(agent.controller, flown, MonteCarloConfig(40, shield=guard))
        for guard in (None, ShieldConfig())
    )
    untouched = np.asarray(guarded.intervention_rate) == 0.0
    assert untouched.mean() > 0.9
    np.testing.assert_allclose(guarded.settling_time[untouched], free.settling_time[untouched], atol=0.11)
    assert not np.any(guarded.violated) and np.all(guarded.settled)


def _params_with(**changed: object) -> EnvParams:
    return task.env_params(TASK.model_copy(update={"spacecraft": SpacecraftConfig(**changed)}))  # pyright: ignore


def test_an_action_that_passes_comes_back_to_the_last_bit_for_any_torque_limit():
    params = _params_with(torque_limit=0.3)
    guard = shield.for_spacecraft(ShieldConfig(), params.spacecraft, params.dt)
    state = env.reset(scenario.paper_test())
    actions = jnp.asarray(np.random.default_rng(0).uniform(-1.5, 1.5, size=(200, 3)), jnp.float32)
    through = jax.jit(jax.vmap(lambda action: shield.guard(guard, state, action, params)))(actions)
    np.testing.assert_array_equal(through, jnp.clip(actions, -1.0, 1.0))
