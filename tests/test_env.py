import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest
from flax import struct

from koz_jax import env, observation, task
from koz_jax.dynamics import RigidBodyState, Spacecraft
from koz_jax.env import EnvParams, EnvState
from koz_jax.keep_out import KeepOutZone
from koz_jax.reward import Outcome
from koz_jax.scenario import Scenario
from koz_jax.task_config import TaskConfig

pytestmark = pytest.mark.usefixtures("strict_shapes")

STEPS = 200
SAMPLES = 3
# Rounding of 200 float32 steps at rates up to 0.1 rad/s.
ATOL = 3e-5


class Flight(struct.PyTreeNode):
    """Leaves (SAMPLES, STEPS + 1, ...) of states and observations, (SAMPLES, STEPS, ...) of outcomes."""

    states: EnvState
    observations: jax.Array
    outcomes: Outcome


class Setting:
    """Three samples that differ in everything: the first is the paper's spacecraft."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.inertia = np.stack([oracle.INERTIA, oracle.random_inertia(rng), oracle.random_inertia(rng)])
        self.boresight = np.stack([oracle.BORESIGHT, oracle.random_direction(rng), oracle.random_direction(rng)])
        self.torque_limit = np.array([2.0, 1.5, 3.0])
        self.dt = np.array([0.1, 0.1, 0.05])
        self.q = np.stack([oracle.random_attitude(rng) for _ in range(SAMPLES)])
        self.omega = rng.normal(scale=0.02, size=(SAMPLES, 3))
        self.q_target = np.stack([oracle.random_attitude(rng) for _ in range(SAMPLES)])
        self.axes = np.stack([[oracle.random_direction(rng) for _ in range(2)] for _ in range(SAMPLES)])
        self.half_angles = rng.uniform(0.2, 0.5, size=(SAMPLES, 2))
        # Some of the actions lie beyond the limits, and must be clipped.
        self.actions = rng.uniform(-1.5, 1.5, size=(SAMPLES, STEPS, 3))

    def params(self) -> EnvParams:
        craft = Spacecraft(*(jnp.array(x, jnp.float32) for x in (self.inertia, self.boresight, self.torque_limit)))
        shared = jax.tree.map(lambda leaf: jnp.full(SAMPLES, leaf), task.env_params(TaskConfig()).reward)
        return EnvParams(craft, shared, jnp.array(self.dt, jnp.float32), jnp.zeros((SAMPLES, 3)))

    def scenario(self) -> Scenario:
        return Scenario(
            RigidBodyState(jnp.array(self.q, jnp.float32), jnp.array(self.omega, jnp.float32)),
            jnp.array(self.q_target, jnp.float32),
            KeepOutZone(jnp.array(self.axes, jnp.float32), jnp.array(self.half_angles, jnp.float32)),
        )


@pytest.fixture(scope="module")
def setting() -> Setting:
    return Setting()


@pytest.fixture(scope="module")
def flight(strict_shapes, setting) -> Flight:
    def fly(scenario: Scenario, params: EnvParams, actions: jax.Array) -> Flight:
        def advance(state: EnvState, action: jax.Array) -> tuple[EnvState, tuple[EnvState, jax.Array, Outcome]]:
            state, outcome = env.step(state, action, params)
            return state, (state, observation.observe(state, params), outcome)

        start = env.reset(scenario)
        _, (states, observations, outcomes) = jax.lax.scan(advance, start, actions)
        first = start, observation.observe(start, params)
        states, observations = jax.tree.map(
            lambda one, rest: jnp.concatenate([one[None], rest]), first, (states, observations)
        )
        return Flight(states, observations, outcomes)

    flown = jax.jit(jax.vmap(fly))(setting.scenario(), setting.params(), jnp.array(setting.actions, jnp.float32))
    return jax.tree.map(np.asarray, flown)


@pytest.fixture(scope="module")
def twin(setting) -> dict[str, np.ndarray]:
    """The same flight by the oracle; (SAMPLES, STEPS + 1, ...), torque (SAMPLES, STEPS, 3)."""
    torque = setting.torque_limit[:, None, None] * np.clip(setting.actions, -1.0, 1.0)
    q, omega = [[q] for q in setting.q], [[w] for w in setting.omega]
    for i in range(SAMPLES):
        for t in range(STEPS):
            after = oracle.propagate(q[i][-1], omega[i][-1], torque[i, t], setting.dt[i], setting.inertia[i])
            q[i].append(after[0])
            omega[i].append(after[1])
    q, omega = np.array(q), np.array(omega)
    q_e = np.array(
        [
            [oracle.product(oracle.conjugate(target), at) for at in path]
            for target, path in zip(setting.q_target, q, strict=True)
        ]
    )
    margin = [
        [oracle.margins(at, setting.boresight[i], setting.axes[i], setting.half_angles[i]).min() for at in q[i]]
        for i in range(SAMPLES)
    ]
    return {
        "q": q,
        "omega": omega,
        "q_e": q_e,
        "torque": torque,
        "angle": oracle.rotation_angle(q_e),
        "margin": np.array(margin),
    }


def test_attitude_and_rate_follow_the_oracle(flight, twin):
    np.testing.assert_allclose(flight.states.body.q_BN, twin["q"], atol=ATOL)
    np.testing.assert_allclose(flight.states.body.omega_BN_B, twin["omega"], atol=1e-5)


def test_pointing_error_follows_the_oracle(flight, twin):
    np.testing.assert_allclose(flight.states.angle, twin["angle"], atol=2 * ATOL)
    np.testing.assert_allclose(flight.outcomes.angle, twin["angle"][:, 1:], atol=2 * ATOL)


def test_previous_values_are_those_of_the_step_before(flight, twin):
    np.testing.assert_array_equal(flight.outcomes.angle_previous, flight.states.angle[:, :-1])
    np.testing.assert_allclose(flight.states.q_e0_previous[:, 1:], twin["q_e"][:, :-1, 0], atol=ATOL)
    np.testing.assert_allclose(flight.states.q_e0_previous[:, 0], twin["q_e"][:, 0, 0], atol=ATOL)


def test_torque_is_the_clipped_action_times_the_limit(flight, twin, setting):
    assert np.any(np.abs(setting.actions) > 1.0)
    np.testing.assert_allclose(flight.states.torque_B[:, 1:], twin["torque"], rtol=1e-6)
    np.testing.assert_allclose(flight.outcomes.torque, np.linalg.norm(twin["torque"], axis=-1), rtol=1e-5)


def test_torque_change_is_zero_in_the_first_step_and_measured_afterwards(flight, twin):
    np.testing.assert_array_equal(flight.outcomes.torque_change[:, 0], 0.0)
    change = np.linalg.norm(np.diff(twin["torque"], axis=1), axis=-1)
    np.testing.assert_allclose(flight.outcomes.torque_change[:, 1:], change, rtol=1e-5, atol=1e-6)


def test_margin_is_that_to_the_nearest_of_two_zones_after_the_step(flight, twin):
    np.testing.assert_allclose(flight.outcomes.zone_margin, twin["margin"][:, 1:], atol=2 * ATOL)


def test_observations_along_the_flight_follow_the_oracle(flight, twin, setting):
    for i in range(SAMPLES):
        for t in range(0, STEPS + 1, 10):
            expected = oracle.observation(
                q=twin["q"][i, t],
                omega=twin["omega"][i, t],
                q_target=setting.q_target[i],
                axis=setting.axes[i, 0],
                half_angle=setting.half_angles[i, 0],
                q_e0_previous=twin["q_e"][i, max(t - 1, 0), 0],
                boresight=setting.boresight[i],
            )
            np.testing.assert_allclose(flight.observations[i, t], expected, atol=2 * ATOL)


def test_steps_are_counted_from_the_reset(flight):
    np.testing.assert_array_equal(flight.states.steps, np.tile(np.arange(STEPS + 1), (SAMPLES, 1)))


def test_the_scenario_stays_what_it_is(flight, setting):
    jax.tree.map(
        lambda along, start: np.testing.assert_array_equal(along, np.repeat(start[:, None], STEPS + 1, axis=1)),
        flight.states.scenario,
        jax.tree.map(np.asarray, setting.scenario()),
    )


def test_a_step_is_a_pure_function(setting, params):
    one = jax.tree.map(lambda leaf: leaf[0], setting.scenario())
    state = env.reset(one)
    step = jax.jit(env.step)
    action = jnp.array([0.5, -0.2, 0.1])
    first = step(state, action, params)
    step(first[0], -action, params)
    jax.tree.map(np.testing.assert_array_equal, first, step(state, action, params))


def test_one_trace_serves_every_spacecraft_and_scenario(setting):
    traces = []

    def counted(state: EnvState, action: jax.Array, params: EnvParams) -> tuple[EnvState, Outcome]:
        traces.append(1)
        return env.step(state, action, params)

    step = jax.jit(counted)
    for i in range(SAMPLES):
        one_scenario, one_params = jax.tree.map(lambda leaf, i=i: leaf[i], (setting.scenario(), setting.params()))
        state, _ = step(env.reset(one_scenario), jnp.zeros(3), one_params)
        step(state, jnp.ones(3), one_params)
    assert len(traces) == 1


def test_actions_beyond_the_limits_act_like_the_limits(setting, params):
    state = env.reset(jax.tree.map(lambda leaf: leaf[0], setting.scenario()))
    step = jax.jit(env.step)
    beyond, at = step(state, jnp.array([7.0, -3.0, 0.5]), params), step(state, jnp.array([1.0, -1.0, 0.5]), params)
    jax.tree.map(np.testing.assert_array_equal, beyond, at)
