"""What the shield guarantees, against an independent float64 integration, and that it lets through what it can."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import oracle, states

from koz_jax.agents.agent import load_agent
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import SpacecraftConfig, TaskConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.control.adversarial import AnyAdversary
from koz_jax.control.registry import ADVERSARIAL, load_controller
from koz_jax.control.shield import brake_path
from koz_jax.control.shield import filter as shield
from koz_jax.control.shield.filter import Shield
from koz_jax.evaluation import cases, rollout
from koz_jax.evaluation.rollout import History
from koz_jax.task import pointing_constraints, rotations, scenario
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.environment import Reorientation
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.scenario import Scenario
from koz_jax.task.state import Command, EnvState, Model

TASK = TaskConfig()
MODEL = states.MODEL
SHIELD = shield.from_config(ShieldConfig(), MODEL)
MARGIN = float(SHIELD.margin)
STATES = 64
ERRORS = UncertaintyConfig(inertia_error=0.1, disturbance_torque=0.01, attitude_noise_deg=0.01, rate_noise_deg=0.001)


def _states(seed: int, max_rate: float, zones: int = 2) -> tuple[RigidBodyState, PointingConstraint]:
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
    return RigidBodyState(q, omega), PointingConstraint(jnp.broadcast_to(states.LOOK, axes.shape), axes, half_angles)


@jax.jit
def _is_safe(made: Shield, model: Model, bodies: RigidBodyState, zones: PointingConstraint) -> jax.Array:
    return jax.vmap(lambda body, zone: shield.is_safe(made, body, zone, model))(bodies, zones)


def _safe(bodies: RigidBodyState, zones: PointingConstraint) -> jax.Array:
    return _is_safe(SHIELD, MODEL, bodies, zones)


@jax.jit
def _filter_with(
    made: Shield, model: Model, bodies: RigidBodyState, torques_B: jax.Array, zones: PointingConstraint
) -> jax.Array:
    limits = model.actuators.limits(None, jnp.zeros(3))
    return jax.vmap(lambda body, torque_B, zone: made.filter(body, torque_B, zone, limits, model))(
        bodies, torques_B, zones
    )


def _filter(bodies: RigidBodyState, torques_B: jax.Array, zones: PointingConstraint) -> jax.Array:
    return _filter_with(SHIELD, MODEL, bodies, torques_B, zones)


@jax.jit
def _brake(made: Shield, model: Model, bodies: RigidBodyState) -> jax.Array:
    return jax.vmap(lambda body: brake_path.torque(made.brake, body, model))(bodies)


def _margins(q: np.ndarray, axes: np.ndarray, half_angles: np.ndarray) -> np.ndarray:
    """Margin to the nearest zone in double precision.  q: (n, 4).  Returns (n,)."""
    looks = oracle.rotation(q).apply(oracle.BORESIGHT)
    return (oracle.angle_between(looks[:, None], axes) - half_angles).min(axis=1)


def _brake_to_rest(bodies: RigidBodyState, zones: PointingConstraint) -> np.ndarray:
    """Smallest margin while the brake works to the end, by the oracle, checked 4 times a step.  Returns (n,)."""
    q, omega = (np.asarray(leaf, np.float64) for leaf in (bodies.q_BN, bodies.omega_BN_B))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    axes, half_angles = np.asarray(zones.axis_N, np.float64), np.asarray(zones.half_angle, np.float64)
    smallest = _margins(q, axes, half_angles)
    while np.linalg.norm(omega, axis=1).max() > 1e-6:
        torques = np.asarray(_brake(SHIELD, MODEL, RigidBodyState(jnp.float32(q), jnp.float32(omega))), np.float64)
        for _ in range(4):
            q, omega = oracle.propagate_many(q, omega, torques, oracle.DT / 4)
            smallest = np.minimum(smallest, _margins(q, axes, half_angles))
    return smallest


@pytest.mark.slow
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


@pytest.mark.slow
def test_the_states_of_these_tests_are_both_safe_and_not():
    shares = [np.asarray(_safe(*_states(seed, 0.2))).mean() for seed in range(5)]
    assert 0.2 < np.mean(shares) < 0.8


@pytest.mark.slow
@settings(max_examples=5, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_what_passes_leads_to_a_safe_state_or_is_the_brake(seed):
    bodies, zones = _states(seed, 0.3)
    rng = np.random.default_rng(seed)
    torques_B = jnp.asarray(rng.uniform(-2.0, 2.0, size=(STATES, 3)), jnp.float32)
    allowed_B = np.asarray(_filter(bodies, torques_B, zones))
    assert np.all(np.abs(allowed_B) <= 2.0 + 1e-6)
    brake_B = np.asarray(_brake(SHIELD, MODEL, bodies))
    braked = np.all(np.abs(allowed_B - brake_B) < 1e-5, axis=1)
    q, omega = (np.asarray(leaf, np.float64) for leaf in (bodies.q_BN, bodies.omega_BN_B))
    q, omega = oracle.propagate_many(q, omega, allowed_B, oracle.DT)
    after = RigidBodyState(jnp.float32(q), jnp.float32(omega))
    fast = np.linalg.norm(np.asarray(bodies.omega_BN_B) @ oracle.INERTIA.T, axis=1) > 2.1 * 2.0 * oracle.DT
    half = SHIELD.replace(margin=0.49 * SHIELD.margin)
    safe = _is_safe(half, MODEL, after, zones)
    # From inside a zone any way out is good.
    inside = _margins(np.asarray(bodies.q_BN), np.asarray(zones.axis_N), np.asarray(zones.half_angle)) <= 1e-5
    assert np.all(braked | np.asarray(safe) | ~fast | inside)


@pytest.mark.slow
def test_a_request_that_leads_to_a_safe_state_passes_to_the_last_bit():
    bodies, zones = _states(3, 0.02)
    far = zones.replace(axis_N=-zones.axis_N)
    torques_B = jnp.asarray(np.random.default_rng(0).uniform(-2.0, 2.0, size=(STATES, 3)), jnp.float32)
    clear = _margins(np.asarray(bodies.q_BN), np.asarray(far.axis_N), np.asarray(far.half_angle)) > 0.3
    assert clear.sum() > STATES / 2
    np.testing.assert_array_equal(_filter(bodies, torques_B, far)[clear], torques_B[clear])


def test_without_a_zone_everything_passes():
    bodies, zones = _states(4, 1.0)
    absent = zones.replace(half_angle=jnp.full_like(zones.half_angle, ABSENT_HALF_ANGLE))
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
    q, omega = (np.asarray(leaf, np.float64) for leaf in (bodies.q_BN, bodies.omega_BN_B))
    momentum = np.linalg.norm(omega @ oracle.INERTIA.T, axis=1)
    for _ in range(20):
        torques = np.asarray(_brake(SHIELD, MODEL, RigidBodyState(jnp.float32(q), jnp.float32(omega))), np.float64)
        assert np.all(np.abs(torques) <= 2.0 + 1e-6)
        q, omega = oracle.propagate_many(q, omega, torques, oracle.DT)
        after = np.linalg.norm(omega @ oracle.INERTIA.T, axis=1)
        np.testing.assert_allclose(after, np.maximum(momentum - 2.0 * oracle.DT, 0.0), atol=2e-3)
        momentum = after
    at_rest = RigidBodyState(jnp.float32(q), jnp.zeros_like(bodies.omega_BN_B))
    np.testing.assert_array_equal(_brake(SHIELD, MODEL, at_rest), 0.0)


@pytest.mark.slow
def test_a_start_is_flown_as_it_is_given_and_told_where_it_is_not_covered(env):
    bodies, zones = _states(7, 0.5)
    under = shield.under_shield(env, ShieldConfig())
    drawn = Scenario(bodies, jnp.tile(jnp.eye(4)[0], (STATES, 1)), zones)
    begun = jax.jit(jax.vmap(under.reset))(drawn)
    np.testing.assert_array_equal(begun.body.omega_BN_B, bodies.omega_BN_B)
    covered = np.asarray(jax.jit(jax.vmap(under.covers))(begun))
    np.testing.assert_array_equal(covered, np.asarray(_safe(bodies, zones)))
    assert 0.1 < covered.mean() < 0.9
    assert np.all(jax.vmap(env.covers)(begun))


FLOWN = TASK.with_rules(zones=2, max_rate_deg=5.0).model_copy(update={"episode_seconds": 40.0})
FREE = MonteCarloConfig(cases=40, substeps=2)
# With errors of zero, so that both are one program.
SHIELDED = MonteCarloConfig(cases=40, substeps=2, shield=ShieldConfig(), uncertainty=UncertaintyConfig())
ROBUST = MonteCarloConfig(cases=40, substeps=2, shield=ShieldConfig(error_bounds=ERRORS), uncertainty=ERRORS)


def _violations(name: str, config: MonteCarloConfig, flown: TaskConfig = FLOWN) -> int:
    """Of the cases whose start the shield covers, which are nearly all; without one, of all that start outside."""
    found = cases.fly_cases(AnyAdversary.named(name), flown, config)
    assert np.mean(found.unsafe_start) <= 0.2
    return int(np.sum(np.asarray(found.violated) & ~np.asarray(found.unsafe_start)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ADVERSARIAL)
def test_adversaries_enter_the_zone_and_with_the_shield_never(name):
    assert _violations(name, FREE) >= 8
    assert _violations(name, SHIELDED) == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ADVERSARIAL)
def test_the_guarantee_holds_for_the_errors_that_it_is_made_for(name):
    assert _violations(name, ROBUST) == 0


@pytest.mark.slow
def test_another_spacecraft_is_shielded_too():
    craft = SpacecraftConfig(
        inertia=((9.0, 0.5, 0.2), (0.5, 12.0, -0.3), (0.2, -0.3, 6.0)), boresight=(0.0, 0.6, 0.8), torque_limit=0.3
    )
    flown = FLOWN.model_copy(update={"spacecraft": craft})
    assert _violations("adversary", FREE, flown) >= 20
    assert _violations("adversary", SHIELDED, flown) == 0


@pytest.mark.slow
def test_the_shipped_agent_flies_under_the_shield_as_it_does_without():
    agent = load_agent("phase2")
    flown = agent.task.model_copy(update={"episode_seconds": 40.0})
    free, shielded = (
        cases.fly_cases(agent.controller, flown, MonteCarloConfig(cases=40, shield=config))
        for config in (None, ShieldConfig())
    )
    untouched = np.asarray(shielded.intervention_rate) == 0.0
    assert untouched.mean() > 0.9
    np.testing.assert_allclose(shielded.settling_time[untouched], free.settling_time[untouched], atol=0.11)
    assert not np.any(shielded.violated) and np.all(shielded.settled)


@pytest.mark.slow
@pytest.mark.parametrize("limit", [0.3, (0.3, 0.7, 1.9)])
def test_an_action_that_passes_comes_back_to_the_last_bit_for_any_torque_limit(limit):
    task = TASK.model_copy(update={"spacecraft": SpacecraftConfig(torque_limit=limit)})
    env = shield.under_shield(Reorientation.from_config(task), ShieldConfig())
    state = env.reset(scenario.paper_test())
    actions = jnp.asarray(np.random.default_rng(0).uniform(-1.5, 1.5, size=(200, 3)), jnp.float32)
    through, intervened = _ask(env, state, actions)
    np.testing.assert_array_equal(through.applied, jnp.clip(actions, -1.0, 1.0))
    assert not np.any(intervened)


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, None, 0))
def _ask(env: Reorientation, state: EnvState, action: jax.Array) -> tuple[Command, jax.Array]:
    command = env.filter(state, action)
    return command, command.intervened


def test_no_settings_mean_no_shield(env):
    assert shield.under_shield(env, None) is env


# --- unequal limits ---

UNEQUAL = (0.5, 2.0, 1.2)


@pytest.mark.slow
@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_what_is_let_through_is_inside_a_box_of_unequal_limits(seed):
    """Each component within its own limit, and where anything was changed, still a way to rest outside the zones."""
    model = states.model_with(torque_limit=UNEQUAL)
    made = shield.from_config(ShieldConfig(), model)
    bodies, zones = _states(seed, 0.3)
    torques = np.random.default_rng(seed).uniform(-1.0, 1.0, size=(STATES, 3)) * UNEQUAL
    allowed_B = np.asarray(_filter_with(made, model, bodies, jnp.float32(torques), zones))
    brake_B = np.asarray(_brake(made, model, bodies))
    assert np.all(np.abs(allowed_B) <= np.array(UNEQUAL) * (1 + 1e-6))
    assert np.all(np.linalg.norm(brake_B, axis=1) <= min(UNEQUAL) * (1 + 1e-6))
    braked = np.all(np.abs(allowed_B - brake_B) < 1e-5, axis=1)
    q, omega = (np.asarray(leaf, np.float64) for leaf in (bodies.q_BN, bodies.omega_BN_B))
    q, omega = oracle.propagate_many(q, omega, allowed_B, oracle.DT)
    after = RigidBodyState(jnp.float32(q), jnp.float32(omega))
    fast = np.linalg.norm(np.asarray(bodies.omega_BN_B) @ oracle.INERTIA.T, axis=1) > 2.1 * min(UNEQUAL) * oracle.DT
    half = made.replace(margin=0.49 * made.margin)
    safe = _is_safe(half, model, after, zones)
    # From inside a zone any way out is good.
    inside = _margins(np.asarray(bodies.q_BN), np.asarray(zones.axis_N), np.asarray(zones.half_angle)) <= 1e-5
    assert np.all(braked | np.asarray(safe) | ~fast | inside)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bang_bang", "adversary"])
def test_a_spacecraft_with_unequal_limits_is_shielded_too(name):
    flown = FLOWN.model_copy(update={"spacecraft": SpacecraftConfig(torque_limit=UNEQUAL)})
    assert _violations(name, FREE, flown) >= 8
    assert _violations(name, SHIELDED, flown) == 0


def test_the_shield_brakes_with_what_is_there_in_every_direction():
    errors = UncertaintyConfig(disturbance_torque=0.1)
    made = shield.from_config(ShieldConfig(error_bounds=errors), states.model_with(torque_limit=UNEQUAL))
    assert float(made.brake.torque) == pytest.approx(0.5 - 0.1, rel=1e-6)


# --- two instruments ---

STAR_TRACKER = np.array([0.0, 0.6, 0.8])
CASES = 24


@pytest.fixture(scope="module")
def two_instruments(env: Reorientation) -> Scenario:
    """Scenarios with a zone for the telescope, and one of another axis for a star tracker on another side.

    Its zone lies where it would look half-way, as large as start and target leave room for.
    """
    drawn = jax.jit(jax.vmap(env.sample))(jax.random.split(jax.random.key(0), CASES))
    q_start, q_end = np.asarray(drawn.initial.q_BN, float), np.asarray(drawn.q_DN, float)
    axes, half_angles = [], []
    for start, end in zip(q_start, q_end, strict=True):
        axis = oracle.half_way(start, end).apply(STAR_TRACKER)
        looks = [oracle.rotation(q).apply(STAR_TRACKER) for q in (start, end)]
        room = min(oracle.angle_between(look, axis) for look in looks) - np.deg2rad(2.0)
        axes.append(axis)
        half_angles.append(min(room, 0.4) if room > 0.05 else ABSENT_HALF_ANGLE)
    assert np.mean(np.array(half_angles) > 0) > 0.7
    tracker = PointingConstraint(
        boresight_B=jnp.tile(jnp.array(STAR_TRACKER, jnp.float32), (CASES, 1, 1)),
        axis_N=jnp.array(axes, jnp.float32)[:, None],
        half_angle=jnp.array(half_angles, jnp.float32)[:, None],
    )
    both = jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=1), drawn.constraints, tracker)
    return drawn.replace(constraints=both)


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0))
def _fly_all(env: Reorientation, drawn: Scenario) -> History:
    return rollout.fly(env, load_controller("adversary").controller, drawn)


def _both_margins(histories: History, drawn: Scenario) -> np.ndarray:
    """Margins (cases, instants, 2) of both pairs in double precision, in steps and half-way between them."""
    body, torques_B = histories.state.body, np.asarray(histories.torque_B, float).reshape(-1, 3)
    at_steps = np.asarray(body.q_BN, float)
    q, omega = (np.asarray(leaf, float).reshape(-1, leaf.shape[-1]) for leaf in (body.q_BN, body.omega_BN_B))
    between, _ = oracle.propagate_many(q, omega, torques_B, oracle.DT / 2)
    attitudes = np.concatenate([at_steps, between.reshape(at_steps.shape)], axis=1)
    zones = jax.tree.map(lambda leaf: np.asarray(leaf, float), drawn.constraints)
    return (
        np.stack(
            [
                [
                    oracle.angle_between(oracle.rotation(q).apply(look), axis)
                    for look, axis in zip(looks, axes, strict=True)
                ]
                for q, looks, axes in zip(attitudes, zones.boresight_B, zones.axis_N, strict=True)
            ]
        ).swapaxes(1, 2)
        - zones.half_angle[:, None]
    )


@pytest.mark.slow
@pytest.mark.parametrize("target", [0, 1], ids=["telescope", "star tracker"])
def test_two_instruments_are_both_kept_out_of_their_zones(env, two_instruments, target):
    """The adversary steers the first pair of the stack into its zone; the order of the pairs says which that is.

    Pair by pair, in double precision: neither instrument is kept out at the other's cost.
    """
    order = [target, 1 - target]
    drawn = two_instruments.replace(
        constraints=jax.tree.map(lambda leaf: leaf[:, jnp.array(order)], two_instruments.constraints)
    )
    short = env.replace(episode_steps=300)
    here = np.asarray(drawn.constraints.half_angle[:, 0]) > 0
    entered = _both_margins(_fly_all(short, drawn), drawn).min(axis=(1, 2)) <= 0.0
    assert np.mean(entered[here]) > 0.8
    under = shield.under_shield(short, ShieldConfig())
    assert np.all(_both_margins(_fly_all(under, drawn), drawn) > 0.0)


@pytest.mark.slow
def test_the_margin_of_a_flight_is_the_smaller_of_both_instruments(env, two_instruments):
    histories = _fly_all(env.replace(episode_steps=300), two_instruments)
    body = histories.state.body.q_BN
    each = jax.jit(jax.vmap(jax.vmap(pointing_constraints.margins, in_axes=(0, None))))(
        body, two_instruments.constraints
    )
    np.testing.assert_allclose(histories.zone_margin, np.min(each, axis=2), atol=1e-6)
    assert 0.05 < np.mean(np.argmin(each, axis=2)) < 0.95
