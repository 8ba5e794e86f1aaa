import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from support import oracle

from koz_jax.config.task import ScenarioConfig, TaskConfig
from koz_jax.errors import SettingsError
from koz_jax.task import environment, reward, scenario
from koz_jax.task.actuators import TorqueBox
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.environment import Reorientation
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.scenario import SamplingRule, Scenario
from koz_jax.task.state import Allowed, EnvState, Model, Step, Truth

STEPS = 200
SAMPLES = 3
# Rounding of 200 float32 steps at rates up to 0.1 rad/s.
ATOL = 3e-5


class Flight(struct.PyTreeNode):
    """Leaves (SAMPLES, STEPS + 1, ...) of states and observations, (SAMPLES, STEPS, ...) of steps."""

    states: EnvState
    observations: jax.Array
    steps: Step


class Setting:
    """Three samples that differ in everything: the first is the paper's spacecraft, the last has two instruments."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.inertia = np.stack([oracle.INERTIA, oracle.random_inertia(rng), oracle.random_inertia(rng)])
        first = np.stack([oracle.BORESIGHT, oracle.random_direction(rng), oracle.random_direction(rng)])
        self.torque_limit = np.array([[2.0, 2.0, 2.0], [1.5, 1.5, 1.5], [3.0, 0.5, 1.0]])
        self.dt = np.array([0.1, 0.1, 0.05])
        self.q = np.stack([oracle.random_attitude(rng) for _ in range(SAMPLES)])
        self.omega = rng.normal(scale=0.02, size=(SAMPLES, 3))
        self.q_target = np.stack([oracle.random_attitude(rng) for _ in range(SAMPLES)])
        self.axes = np.stack([[oracle.random_direction(rng) for _ in range(2)] for _ in range(SAMPLES)])
        self.half_angles = rng.uniform(0.2, 0.5, size=(SAMPLES, 2))
        # Some of the actions lie beyond the limits, and must be clipped.
        self.actions = rng.uniform(-1.5, 1.5, size=(SAMPLES, STEPS, 3))
        self.boresights = np.stack([first, first], axis=1)
        self.boresights[2, 1] = oracle.random_direction(rng)

    def env(self) -> Reorientation:
        """Leaves (SAMPLES, ...)."""
        shared = jax.tree.map(lambda leaf: jnp.stack([leaf] * SAMPLES), Reorientation.from_config())
        inertia, limit, dt = (jnp.array(x, jnp.float32) for x in (self.inertia, self.torque_limit, self.dt))
        return shared.replace(model=Model(inertia, TorqueBox(limit), dt))

    def scenario(self) -> Scenario:
        zones = (jnp.array(x, jnp.float32) for x in (self.boresights, self.axes, self.half_angles))
        return Scenario(
            RigidBodyState(jnp.array(self.q, jnp.float32), jnp.array(self.omega, jnp.float32)),
            jnp.array(self.q_target, jnp.float32),
            PointingConstraint(*zones),
        )


@pytest.fixture(scope="module")
def setting() -> Setting:
    return Setting()


@pytest.fixture(scope="module")
def flight(setting: Setting) -> Flight:
    def fly(env: Reorientation, drawn: Scenario, actions: jax.Array) -> Flight:
        def advance(state: EnvState, action: jax.Array) -> tuple[EnvState, Step]:
            stepped = env.step(state, action)
            return stepped.state, stepped

        start = env.reset(drawn)
        _, steps = jax.lax.scan(advance, start, actions)
        states, observations = jax.tree.map(
            lambda one, rest: jnp.concatenate([one[None], rest]),
            (start, env.observe(start)),
            (steps.state, steps.observation),
        )
        return Flight(states, observations, steps)

    flown = jax.jit(jax.vmap(fly))(setting.env(), setting.scenario(), jnp.array(setting.actions, jnp.float32))
    return jax.tree.map(np.asarray, flown)


@pytest.fixture(scope="module")
def twin(setting: Setting) -> dict[str, np.ndarray]:
    """The same flight by the oracle; (SAMPLES, STEPS + 1, ...), torque (SAMPLES, STEPS, 3)."""
    torque = setting.torque_limit[:, None] * np.clip(setting.actions, -1.0, 1.0)
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
    margins = [
        [oracle.margins(at, setting.boresights[i], setting.axes[i], setting.half_angles[i]) for at in q[i]]
        for i in range(SAMPLES)
    ]
    return {
        "q": q,
        "omega": omega,
        "q_e": q_e,
        "torque": torque,
        "angle": oracle.rotation_angle(q_e),
        "margins": np.array(margins),
    }


@pytest.mark.slow
def test_attitude_and_rate_follow_the_oracle(flight, twin):
    np.testing.assert_allclose(flight.states.body.q_BN, twin["q"], atol=ATOL)
    np.testing.assert_allclose(flight.states.body.omega_BN_B, twin["omega"], atol=1e-5)


def test_pointing_error_follows_the_oracle(flight, twin):
    np.testing.assert_allclose(flight.states.angle, twin["angle"], atol=2 * ATOL)
    np.testing.assert_allclose(flight.steps.outcome.angle, twin["angle"][:, 1:], atol=2 * ATOL)


def test_previous_values_are_those_of_the_step_before(flight, twin):
    np.testing.assert_array_equal(flight.steps.outcome.angle_previous, flight.states.angle[:, :-1])
    np.testing.assert_allclose(flight.states.q_e0_previous[:, 1:], twin["q_e"][:, :-1, 0], atol=ATOL)
    np.testing.assert_allclose(flight.states.q_e0_previous[:, 0], twin["q_e"][:, 0, 0], atol=ATOL)


def test_torque_is_the_clipped_action_times_the_limit_of_each_axis(flight, twin, setting):
    assert np.any(np.abs(setting.actions) > 1.0)
    np.testing.assert_allclose(flight.states.torque_B[:, 1:], twin["torque"], rtol=1e-6)
    np.testing.assert_allclose(flight.steps.outcome.torque, np.linalg.norm(twin["torque"], axis=-1), rtol=1e-5)


def test_torque_change_is_zero_in_the_first_step_and_measured_afterwards(flight, twin):
    np.testing.assert_array_equal(flight.steps.outcome.torque_change[:, 0], 0.0)
    change = np.linalg.norm(np.diff(twin["torque"], axis=1), axis=-1)
    np.testing.assert_allclose(flight.steps.outcome.torque_change[:, 1:], change, rtol=1e-5, atol=1e-6)


def test_margin_is_that_of_the_nearest_of_two_pairs_after_the_step(flight, twin):
    smallest = twin["margins"].min(axis=-1)
    np.testing.assert_allclose(flight.steps.outcome.zone_margin, smallest[:, 1:], atol=2 * ATOL)


def test_observations_along_the_flight_follow_the_oracle(flight, twin, setting):
    for i in range(SAMPLES):
        for t in range(0, STEPS + 1, 10):
            nearest = int(np.argmin(twin["margins"][i, t]))
            expected = oracle.observation(
                q=twin["q"][i, t],
                omega=twin["omega"][i, t],
                q_target=setting.q_target[i],
                axis=setting.axes[i, nearest],
                half_angle=setting.half_angles[i, nearest],
                q_e0_previous=twin["q_e"][i, max(t - 1, 0), 0],
                boresight=setting.boresights[i, nearest],
            )
            np.testing.assert_allclose(flight.observations[i, t], expected, atol=2 * ATOL)


def test_rewards_along_the_flight_follow_the_oracle(flight, twin, setting):
    for i in range(SAMPLES):
        # |tau_max| of a box is the norm of its corner; for equal limits u that is the paper's sqrt(3) u.
        scale = 2.0 * np.sqrt(3.0) / np.linalg.norm(setting.torque_limit[i])
        for t in range(0, STEPS, 7):
            expected = oracle.reward_terms(
                twin["angle"][i, t + 1],
                twin["angle"][i, t],
                twin["torque"][i, t],
                twin["torque"][i, t - 1] if t else None,
                twin["margins"][i, t + 1].min(),
            )
            expected["torque"] *= scale
            for name, value in expected.items():
                found = getattr(flight.steps.terms, name)[i, t]
                np.testing.assert_allclose(found, value, rtol=5e-3, atol=2e-3, err_msg=name)


def test_steps_are_counted_from_the_reset(flight):
    np.testing.assert_array_equal(flight.states.steps, np.tile(np.arange(STEPS + 1), (SAMPLES, 1)))


def test_the_scenario_stays_what_it_is(flight, setting):
    jax.tree.map(
        lambda along, start: np.testing.assert_array_equal(along, np.repeat(start[:, None], STEPS + 1, axis=1)),
        flight.states.scenario,
        jax.tree.map(np.asarray, setting.scenario()),
    )


def test_without_a_filter_what_is_applied_is_what_is_asked(flight, setting):
    np.testing.assert_array_equal(flight.steps.command.requested, np.float32(np.clip(setting.actions, -1.0, 1.0)))
    np.testing.assert_array_equal(flight.steps.command.applied, flight.steps.command.requested)
    np.testing.assert_array_equal(flight.steps.outcome.intervention, 0.0)
    np.testing.assert_array_equal(flight.steps.terms.intervention, 0.0)


def test_nothing_but_time_ends_a_maneuver(flight):
    assert not np.any(flight.steps.terminated)
    assert not np.any(flight.steps.truncated)  # 200 steps of 1,000
    np.testing.assert_array_equal(flight.steps.final_observation, flight.steps.observation)


# --- one step ---


@pytest.fixture(scope="module")
def start(setting, env) -> EnvState:
    return env.reset(jax.tree.map(lambda leaf: leaf[0], setting.scenario()))


@jax.jit
def step(env: Reorientation, state: EnvState, action: jax.Array) -> Step:
    return env.step(state, action)


@pytest.mark.slow
def test_a_step_is_a_pure_function(start, env):
    action = jnp.array([0.5, -0.2, 0.1])
    first = step(env, start, action)
    step(env, first.state, -action)
    jax.tree.map(np.testing.assert_array_equal, first, step(env, start, action))


def test_actions_beyond_the_limits_act_like_the_limits(start, env):
    beyond, at = (step(env, start, jnp.array(action)) for action in ([7.0, -3.0, 0.5], [1.0, -1.0, 0.5]))
    jax.tree.map(np.testing.assert_array_equal, beyond, at)


def test_the_last_step_of_an_episode_is_truncated(start, env):
    late = start.replace(steps=jnp.int32(env.episode_steps - 2))
    before = step(env, late, jnp.zeros(3))
    assert not before.truncated
    assert step(env, before.state, jnp.zeros(3)).truncated


def test_the_truth_flies_and_the_model_does_not_know(start, env):
    """Another inertia and a disturbance change the motion, as the oracle has it, and not what is asked for."""
    action = jnp.array([0.5, -0.2, 0.1])
    inertia, disturbance = 1.3 * oracle.INERTIA, np.array([0.2, -0.4, 0.3])
    truth = Truth(jnp.array(inertia, jnp.float32), jnp.array(disturbance, jnp.float32))
    flown = jax.jit(lambda state: env.step(state, action, truth=truth))(start)
    expected = oracle.propagate(
        np.asarray(start.body.q_BN, float),
        np.asarray(start.body.omega_BN_B, float),
        2.0 * np.asarray(action, float) + disturbance,
        oracle.DT,
        inertia,
    )
    np.testing.assert_allclose(flown.state.body.q_BN, expected[0], atol=1e-6)
    np.testing.assert_allclose(flown.state.body.omega_BN_B, expected[1], atol=1e-6)
    np.testing.assert_allclose(flown.outcome.torque, 2.0 * np.linalg.norm(action), rtol=1e-6)
    plain = step(env, start, action)
    assert np.max(np.abs(flown.state.body.omega_BN_B - plain.state.body.omega_BN_B)) > 1e-4


@pytest.mark.slow
def test_one_trace_serves_every_spacecraft_and_scenario(setting):
    traces = []

    def counted(env: Reorientation, state: EnvState, action: jax.Array) -> Step:
        traces.append(1)
        return env.step(state, action)

    traced = jax.jit(counted)
    for i in range(SAMPLES):
        one_scenario, one_env = jax.tree.map(lambda leaf, i=i: leaf[i], (setting.scenario(), setting.env()))
        stepped = traced(one_env, one_env.reset(one_scenario), jnp.zeros(3))
        traced(one_env, stepped.state, jnp.ones(3))
    assert len(traces) == 1


# --- the filter ---


class Halving(struct.PyTreeNode):
    """A filter that lets half of every action through, by a computation without a gradient."""

    def covers(self, at: EnvState, model: Model) -> jax.Array:
        return at.steps == 0

    def allow(self, measured: EnvState, action: jax.Array, model: Model) -> Allowed:
        halved = jax.lax.while_loop(lambda x: jnp.any(jnp.abs(x) > 0.5), lambda x: 0.5 * x, action)
        return Allowed(halved, jnp.array(True))


@pytest.fixture(scope="module")
def filtered(env) -> Reorientation:
    return env.replace(action_filter=Halving())


def test_the_filter_stands_between_action_and_torque(start, filtered):
    action = jnp.array([0.8, -0.4, 0.2])
    stepped = step(filtered, start, action)
    np.testing.assert_allclose(stepped.state.torque_B, action, rtol=1e-6)  # half of 2 N m times the action
    np.testing.assert_array_equal(stepped.command.requested, action)
    assert stepped.command.intervened
    np.testing.assert_allclose(stepped.outcome.intervention, 0.5 * np.linalg.norm(action), rtol=1e-6)
    passed = step(filtered, start, 0.5 * action)
    assert not passed.command.intervened
    assert passed.outcome.intervention == 0.0
    np.testing.assert_allclose(passed.state.torque_B, action, rtol=1e-6)


def test_the_filter_says_from_which_states_on_it_guarantees_something(start, filtered, env):
    assert filtered.covers(start) and not filtered.covers(start.replace(steps=jnp.int32(1)))
    assert env.covers(start.replace(steps=jnp.int32(1)))


def test_the_gradient_passes_the_filter_as_if_it_were_not_there(start, filtered):
    action, weights = jnp.array([0.8, -0.4, 0.2]), jnp.array([1.0, -2.0, 3.0])

    def applied(env: Reorientation, action: jax.Array) -> jax.Array:
        return env.filter(start, action).applied @ weights

    np.testing.assert_array_equal(jax.jit(jax.grad(functools.partial(applied, filtered)))(action), weights)
    # Forward too, and where the action is clipped there is none.
    _, slope = jax.jvp(functools.partial(applied, filtered), (action,), (jnp.array([0.1, 0.0, 0.0]),))
    np.testing.assert_allclose(slope, 0.1, rtol=1e-6)
    clipped = jax.grad(functools.partial(applied, filtered))(jnp.array([1.5, -0.4, 0.2]))
    np.testing.assert_array_equal(clipped, [0.0, -2.0, 3.0])


@pytest.mark.slow
def test_the_gradient_of_a_step_is_that_of_the_torque_that_was_let_through(start, filtered, env):
    """A filter that halves the action: the step's slope is the one that the free step has at the halved action."""

    def rate(env: Reorientation, action: jax.Array) -> jax.Array:
        return env.step(start, action).state.body.omega_BN_B

    action = jnp.array([0.8, -0.4, 0.2])
    slopes = jax.jit(jax.jacobian(rate, argnums=1))
    found, expected = slopes(filtered, action), slopes(env, 0.5 * action)
    assert np.max(np.abs(expected)) > 1e-3
    np.testing.assert_allclose(found, expected, atol=1e-8)


@pytest.mark.slow
def test_the_filter_knows_what_is_measured_and_not_what_is(start, env):
    class Turn(struct.PyTreeNode):
        """Asks for the rate that it is shown."""

        def start(self, drawn: Scenario, model: Model) -> Scenario:
            return drawn

        def allow(self, measured: EnvState, action: jax.Array, model: Model) -> Allowed:
            return Allowed(measured.body.omega_BN_B, jnp.array(True))

    shown = start.replace(body=start.body.replace(omega_BN_B=jnp.array([0.1, 0.2, 0.3])))
    turning = env.replace(action_filter=Turn())
    stepped = jax.jit(lambda measured: turning.step(start, jnp.zeros(3), measured=measured))(shown)
    np.testing.assert_allclose(stepped.command.applied, [0.1, 0.2, 0.3], rtol=1e-6)


# --- resets ---

SHORT = TaskConfig(episode_seconds=0.5)  # 5 steps
ENVS = 4


@pytest.fixture(scope="module")
def short() -> Reorientation:
    return Reorientation.from_config(SHORT)


@pytest.mark.slow
def test_a_reset_by_key_is_the_reset_of_what_the_key_draws(short):
    key = jax.random.key(3)
    by_key, by_scenario = jax.jit(lambda env: (env.reset(key), env.reset(env.sample(key))))(short)
    jax.tree.map(np.testing.assert_array_equal, by_key, by_scenario)


def test_a_reset_begins_where_its_scenario_says(short):
    drawn = scenario.paper_test()
    state = short.reset(drawn)
    jax.tree.map(np.testing.assert_array_equal, state.body, drawn.initial)
    assert state.steps == 0
    np.testing.assert_array_equal(state.torque_B, 0.0)
    np.testing.assert_allclose(np.rad2deg(state.angle), 100.0, atol=0.01)
    np.testing.assert_allclose(state.q_e0_previous, 0.6428, atol=1e-4)


@pytest.mark.slow
def test_a_reset_draws_what_the_environment_says():
    task = TaskConfig(scenario=ScenarioConfig(max_zones=3, min_half_angle_deg=5.0, max_half_angle_deg=6.0))
    env = Reorientation.from_config(task, 100.0, 110.0)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 50))
    degrees = np.rad2deg(np.asarray(states.angle))
    assert np.all((degrees > 99.99) & (degrees < 110.01)) and np.ptp(degrees) > 5.0
    half_angles = np.rad2deg(np.asarray(states.scenario.constraints.half_angle))
    assert half_angles.shape == (50, 3)
    assert np.all((half_angles < 0.0) | ((half_angles > 4.99) & (half_angles < 6.01)))
    assert env.observe(jax.tree.map(lambda leaf: leaf[0], states)).shape == (26,)


@pytest.mark.parametrize(
    ("angles", "message"),
    [
        ((-1.0, 90.0), r"min_angle_deg: must be in \[0, 180\], got -1"),
        ((100.0, 90.0), r"max_angle_deg: must be in \[min_angle_deg = 100.0, 180\], got 90"),
        ((0.0, 181.0), r"max_angle_deg: must be in \[min_angle_deg = 0.0, 180\], got 181"),
        ((float("nan"), 90.0), "min_angle_deg: must be"),
        ((0.0, 34.0), "max_angle_deg: must be above 34 deg, .* got 34"),
    ],
)
def test_deviations_that_cannot_be_are_refused(angles, message):
    with pytest.raises(SettingsError, match=message):
        Reorientation.from_config(TaskConfig(), *angles)


def test_a_rule_of_ones_own_may_draw_where_no_zone_fits():
    rule = SamplingRule("resample", max_draws=2)
    state = jax.jit(Reorientation.from_config(TaskConfig(), 0.0, 20.0, rule=rule).reset)(jax.random.key(0))
    assert state.scenario.constraints.half_angle[0] < 0.0


@jax.jit
def step_autoreset(env: Reorientation, states: EnvState, actions: jax.Array, keys: jax.Array) -> Step:
    return env.step_autoreset(states, actions, lambda: keys)


@jax.jit
def reset_all(env: Reorientation, keys: jax.Array) -> EnvState:
    return jax.vmap(env.reset)(keys)


@jax.jit
def step_all(env: Reorientation, states: EnvState, actions: jax.Array) -> Step:
    return jax.vmap(env.step)(states, actions)


@pytest.mark.slow
def test_a_step_with_autoreset_is_a_step_and_a_reset_where_time_is_up(short):
    keys = jax.random.split(jax.random.key(1), ENVS)
    states = reset_all(short, jax.random.split(jax.random.key(0), ENVS))
    states = states.replace(steps=jnp.array([0, 4, 2, 4]))  # the second and the last end their episode
    actions = jnp.array(np.random.default_rng(0).uniform(-1, 1, (ENVS, 3)), jnp.float32)
    found, plain, fresh = (
        step_autoreset(short, states, actions, keys),
        step_all(short, states, actions),
        reset_all(short, keys),
    )
    over = np.array([False, True, False, True])
    np.testing.assert_array_equal(found.truncated, over)
    for name in ("outcome", "terms", "command", "final_observation"):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6),
            *(getattr(x, name) for x in (found, plain)),
        )

    def chosen(ended, going_on):
        return np.where(over.reshape((-1,) + (1,) * (ended.ndim - 1)), ended, going_on)

    expected = jax.tree.map(chosen, fresh, plain.state)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6), found.state, expected)
    observed = chosen(np.asarray(jax.jit(jax.vmap(short.observe))(fresh)), np.asarray(plain.observation))
    np.testing.assert_allclose(found.observation, observed, atol=1e-6)
    assert np.all(np.abs(found.observation - found.final_observation)[over].max(axis=1) > 0.01)


@pytest.mark.slow
def test_where_no_episode_ends_nothing_is_drawn(short):
    states = reset_all(short, jax.random.split(jax.random.key(0), ENVS))
    found = step_autoreset(short, states, jnp.zeros((ENVS, 3)), jax.random.split(jax.random.key(1), ENVS))
    np.testing.assert_array_equal(found.state.steps, 1)
    np.testing.assert_array_equal(found.observation, found.final_observation)
    jax.tree.map(np.testing.assert_array_equal, found.state.scenario, states.scenario)


@pytest.mark.slow
def test_autoreset_brings_fresh_scenarios_of_the_range_for_ever(short):
    """Twelve episodes of four environments: 48 starts, no two alike, all as the ranges say."""
    states, rows = reset_all(short, jax.random.split(jax.random.key(0), ENVS)), []
    for key in jax.random.split(jax.random.key(2), 55):
        stepped = step_autoreset(short, states, jnp.ones((ENVS, 3)), jax.random.split(key, ENVS))
        states = stepped.state
        rows.append((states.scenario.initial.q_BN, stepped.truncated))
    starts, over = map(np.array, zip(*rows, strict=True))
    np.testing.assert_array_equal(np.flatnonzero(over[:, 0]), np.arange(4, 55, 5))
    fresh = starts[over]
    assert len(fresh) == 44 and len(np.unique(fresh, axis=0)) == 44
    degrees = np.rad2deg(oracle.rotation_angle(fresh))
    assert np.all((degrees > 80 - 1e-3) & (degrees < 180 + 1e-3))
    np.testing.assert_array_equal(starts[1:][~over[1:]], starts[:-1][~over[1:]])


# --- what controllers know ---


def test_the_model_has_nothing_of_the_truth():
    """What is uncertain is in ``Truth`` alone: whoever is given a ``Model`` cannot be told a disturbance."""
    assert set(Model.__dataclass_fields__) == {"inertia_B", "actuators", "dt", "max_rate"}
    assert set(Truth.__dataclass_fields__) == {"inertia_B", "disturbance_B", "delay"}


def test_the_model_is_that_of_the_settings():
    task = TaskConfig.model_validate({"spacecraft": {"torque_limit": (1.0, 2.0, 3.0)}, "step_seconds": 0.25})
    model = environment.model_from_config(task)
    np.testing.assert_array_equal(model.inertia_B, np.array(task.spacecraft.inertia, np.float32))
    np.testing.assert_array_equal(model.actuators.limits(None, jnp.zeros(3)).box_B, [1.0, 2.0, 3.0])
    assert model.dt == 0.25


def test_without_uncertainty_the_truth_is_the_model_and_measured_exactly(start, env):
    truth = env.sample_truth(jax.random.key(0))
    np.testing.assert_array_equal(truth.inertia_B, env.model.inertia_B)
    np.testing.assert_array_equal(truth.disturbance_B, 0.0)
    jax.tree.map(np.testing.assert_array_equal, env.measure(start, jax.random.key(0)), start)


@pytest.mark.slow
def test_the_reward_of_a_step_is_that_of_its_outcome(start, env):
    stepped = step(env, start, jnp.array([0.5, -0.2, 0.1]))
    expected = reward.terms(stepped.outcome, env.reward, env.nominal_limits)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), stepped.terms, expected)
