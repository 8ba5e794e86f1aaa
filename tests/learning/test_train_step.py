"""The jitted training loop, looked at step by step through its states, and checked from outside."""

import functools
import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from koz_jax.config.base import constant
from koz_jax.config.curriculum import CurriculumConfig, PhaseConfig
from koz_jax.config.presets.named import preset
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import RewardConfig, ScenarioConfig, TaskConfig
from koz_jax.config.training import NetworkConfig, SacConfig, TrainConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.learning import curriculum, learners, train_step
from koz_jax.runs import checkpoint
from koz_jax.sac import replay_buffer
from koz_jax.sac.learner import Sac
from koz_jax.task import observation
from koz_jax.task.environment import Reorientation
from koz_jax.task.scenario import SamplingRule
from koz_jax.task.state import Truth

pytestmark = pytest.mark.slow

# Everything small, and chosen so that within STEPS the ring wraps, episodes end and phase 2 begins.
CONFIG = TrainConfig(
    task=TaskConfig(
        scenario=ScenarioConfig(min_half_angle_deg=4.0, max_half_angle_deg=8.0),
        reward=RewardConfig(zone_decay=2.0, settled_angle_deg=60.0, no_progress_cost=0.7),
    ),
    network=NetworkConfig(hidden_sizes=(16, 16)),
    sac=SacConfig(batch_size=16, buffer_size=96, n_step=2, reward_scale=0.5, policy_average=0.1),
    curriculum=CurriculumConfig(
        phase1=PhaseConfig(
            updates=24,
            min_angle_deg=constant(40.0),
            max_angle_deg=((0.0, 45.0), (1.0, 70.0)),
            discount=constant(0.9),
            learning_rate=((0.0, 1e-3), (1.0, 5e-4)),
        ),
        phase2=PhaseConfig(
            updates=24,
            min_angle_deg=constant(100.0),
            max_angle_deg=constant(120.0),
            zone_weight=constant(2.0),
            zone_tightening_deg=constant(3.0),
            zone_steepness=constant(0.5),
            effort_weight=constant(0.4),
            discount=constant(0.8),
            learning_rate=constant(1e-3),
        ),
    ),
    num_envs=8,
    updates_per_step=2,
    prefill_steps=7,
    training_episode_seconds=0.5,
    eval_every=2,
    log_every=2,
)
EPISODE = 5
STEPS = 20
KEY = jax.random.key(7)


def to_host(tree):
    """A copy that donation cannot touch, with keys as plain numbers."""

    def copy(leaf):
        is_key = isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.array(jax.random.key_data(leaf) if is_key else leaf)

    return jax.tree.map(copy, tree)


def assert_same_bits(one, two):
    for (path, a), b in zip(jax.tree.leaves_with_path(one), jax.tree.leaves(two), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b, err_msg=jax.tree_util.keystr(path))


class Step(NamedTuple):
    """One training step: the states around it, the row that it stored, its metrics (all on the host)."""

    before: train_step.TrainState
    after: train_step.TrainState
    row: replay_buffer.Transition
    metrics: train_step.TrainMetrics
    ended: np.ndarray  # (environments,) bool


@pytest.fixture(scope="module")
def steps():
    """STEPS training steps, one chunk each."""
    state = train_step.init(CONFIG, KEY)
    found = []
    before = to_host(state)
    for _ in range(STEPS):
        state, metrics = train_step.train_chunk(CONFIG, state, jnp.int32(1))
        after = to_host(state)
        row = jax.tree.map(lambda leaf, at=before.buffer.head: leaf[at], after.buffer.rows)
        found.append(Step(before, after, row, to_host(metrics), before.env_states.steps + 1 >= EPISODE))
        before = after
    return found


@pytest.fixture(scope="module")
def flight():
    """Observe and step all environments, apart from the training loop."""
    env = train_step.training_environment(CONFIG)
    return jax.jit(jax.vmap(env.observe)), jax.jit(jax.vmap(env.step))


@functools.cache
def difficulty(updates):
    return to_host(_difficulty(jnp.int32(updates)))


_difficulty = jax.jit(functools.partial(curriculum.difficulty, CONFIG.curriculum))


# --- the loop as a function of its state ---


def run(key, *chunks):
    state = train_step.init(CONFIG, key)
    for length in chunks:
        state, metrics = train_step.train_chunk(CONFIG, state, jnp.int32(length))
    return to_host(state), to_host(metrics)


def test_chunks_of_any_length_give_the_same_bits(steps):
    in_one, metrics = run(KEY, STEPS)
    in_two, _ = run(KEY, 13, STEPS - 13)
    assert_same_bits(in_one, in_two)
    assert_same_bits(in_one, steps[-1].after)
    means = jax.tree.map(lambda *values: np.mean(values), *(step.metrics for step in steps))
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6), metrics, means)


def compilations():
    return train_step.train_chunk._cache_size()  # pyright: ignore[reportAttributeAccessIssue]


def test_one_compilation_serves_chunks_of_any_length_and_states_from_anywhere(steps):
    compiled = compilations()
    state = train_step.init(CONFIG, jax.random.key(1))
    for length in (1, 2, 5):
        state, _ = train_step.train_chunk(CONFIG, state, jnp.int32(length))
    loaded = jax.tree.map(jnp.asarray, steps[3].after).replace(key=jax.random.wrap_key_data(steps[3].after.key))
    train_step.train_chunk(CONFIG, loaded, jnp.int32(1))
    assert compilations() == compiled


def test_a_state_from_the_host_goes_on_as_if_never_stopped(steps):
    at = STEPS // 2
    loaded = jax.tree.map(jnp.array, steps[at].before)
    loaded = loaded.replace(key=jax.random.wrap_key_data(loaded.key))
    state, _ = train_step.train_chunk(CONFIG, loaded, jnp.int32(STEPS - at))
    assert_same_bits(to_host(state), steps[-1].after)


def test_the_seed_decides(steps):
    same, _ = run(jax.random.key(7), 3)
    assert_same_bits(same, steps[2].after)
    other, _ = run(jax.random.key(8), 3)
    assert np.any(other.key != same.key)
    for part in ("policy", "critic"):
        one, two = (jax.tree.leaves(getattr(state.learner, part)) for state in (same, other))
        assert not any(np.array_equal(a, b) for a, b in zip(one, two, strict=True))
    for name in ("observation", "action"):
        one, two = (getattr(state.buffer.rows, name)[: 7 + 3] for state in (same, other))
        assert np.all(np.any(one != two, axis=-1))


def test_the_state_is_donated_and_the_buffer_written_in_place():
    state = train_step.init(CONFIG, jax.random.key(2))
    address = state.buffer.rows.observation.unsafe_buffer_pointer()
    after, _ = train_step.train_chunk(CONFIG, state, jnp.int32(2))
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves(state))
    assert after.buffer.rows.observation.unsafe_buffer_pointer() == address


def test_environments_are_the_leading_axis_of_all_their_leaves(steps):
    """So that one sharding over environments fits them all."""
    state = steps[0].before
    assert {leaf.shape[0] for leaf in jax.tree.leaves(state.env_states)} == {CONFIG.num_envs}
    assert {leaf.shape[:2] for leaf in jax.tree.leaves(state.buffer.rows)} == {(CONFIG.buffer_steps, CONFIG.num_envs)}


def test_updates_are_counted(steps):
    assert [int(step.after.updates) for step in steps] == [2 * (i + 1) for i in range(STEPS)]
    assert [int(step.after.buffer.size) for step in steps] == [min(7 + i + 1, 12) for i in range(STEPS)]


# --- what the environments do ---


def test_a_stored_row_is_what_the_environments_did(steps, flight):
    observe, step_all = flight
    for step in steps:
        flown = step_all(step.before.env_states, step.row.action)
        states, outcome = flown.state, flown.outcome
        close = functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=2e-6)
        close(step.row.observation, observe(step.before.env_states))
        close(step.row.next_observation, observe(states))
        jax.tree.map(close, step.row.outcome, outcome)
        going_on = ~step.ended
        jax.tree.map(lambda a, b: close(a[going_on], b[going_on]), step.after.env_states, states)  # noqa: B023
        np.testing.assert_array_equal(step.row.truncated, step.ended)
        assert not np.any(step.row.terminated)


def test_rows_of_one_episode_follow_each_other(steps):
    for first, second in itertools.pairwise(steps):
        follows = np.max(np.abs(first.row.next_observation - second.row.observation), axis=-1) < 2e-6
        np.testing.assert_array_equal(follows, ~first.row.truncated)


def test_an_ended_episode_is_followed_by_a_new_scenario(steps):
    starts = [steps[0].before.env_states.scenario.initial.q_BN]
    for step in steps:
        old, new, ended = step.before.env_states, step.after.env_states, step.ended
        np.testing.assert_array_equal(new.steps, np.where(ended, 0, old.steps + 1))
        jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[~ended], b[~ended]), new.scenario, old.scenario)  # noqa: B023
        np.testing.assert_array_equal(new.body.q_BN[ended], new.scenario.initial.q_BN[ended])
        np.testing.assert_array_equal(new.torque_B[ended], 0.0)
        starts.append(new.scenario.initial.q_BN[ended])
    starts = np.concatenate(starts)
    assert len(starts) >= CONFIG.num_envs * (STEPS // EPISODE)
    assert len(np.unique(starts, axis=0)) == len(starts)


def test_the_transition_at_a_cut_keeps_the_observation_before_the_reset(steps, flight):
    observe, step_all = flight
    cuts = [step for step in steps if step.ended.any()]
    assert len(cuts) > 5
    for step in cuts:
        last = step_all(step.before.env_states, step.row.action).state
        after_reset = observe(step.after.env_states)[step.ended]
        np.testing.assert_allclose(step.row.next_observation[step.ended], observe(last)[step.ended], atol=2e-6)
        assert np.all(np.max(np.abs(step.row.next_observation[step.ended] - after_reset), axis=1) > 0.01)


def test_new_deviations_lie_in_the_range_of_the_curriculum(steps):
    def assert_in_range(angles, at):
        assert np.all(angles >= at.min_angle - 1e-5) and np.all(angles <= at.max_angle + 1e-5)

    assert_in_range(steps[0].before.env_states.angle[steps[0].before.env_states.steps == 0], difficulty(0))
    drawn = {1: [], 2: []}
    for step in steps:
        at = difficulty(int(step.before.updates))
        angles = step.after.env_states.angle[step.ended]
        assert_in_range(angles, at)
        drawn[int(at.phase)].extend(angles)
    assert len(drawn[1]) > 10 and len(drawn[2]) > 10
    assert max(drawn[1]) > np.deg2rad(45.0)  # the ramp is followed, not only its start
    assert max(drawn[1]) < min(drawn[2])


@pytest.mark.parametrize("phase", [1, 2])
def test_deviations_in_training_have_the_distribution_of_the_curriculum(phase):
    """angle = min + (max - min) u^p, as PhaseConfig.angle_bias says."""
    config = preset("fast").model_copy(update={"num_envs": 2000})
    updates = 0.9 * config.curriculum.phase1.updates if phase == 1 else config.curriculum.updates - 1
    at = curriculum.difficulty(config.curriculum, jnp.int32(updates))
    angles = _fresh_angles(config, at, jax.random.key(phase))
    u = ((angles - at.min_angle) / (at.max_angle - at.min_angle)) ** (1.0 / at.angle_bias)
    assert stats.kstest(np.asarray(u, np.float64), "uniform").statistic < 1.95 / np.sqrt(len(u))


@functools.partial(jax.jit, static_argnums=0)
def _fresh_angles(config, at, key):
    env = train_step.at_difficulty(train_step.training_environment(config), at)
    return jax.vmap(env.reset)(jax.random.split(key, config.num_envs)).angle


def test_first_episodes_are_spread_over_time(steps):
    """Or all environments would be in the same part of their episode for ever."""
    ends = np.stack([step.ended for step in steps])
    np.testing.assert_array_equal(ends.sum(axis=0), STEPS // EPISODE)
    assert np.max(ends.mean(axis=1)) <= 0.5


def test_torque_change_is_zero_in_the_first_step_of_every_episode(steps):
    prefill = jax.tree.map(lambda leaf: leaf[0], steps[0].before.buffer.rows)
    np.testing.assert_array_equal(prefill.outcome.torque_change, 0.0)
    for step in steps:
        first = step.before.env_states.steps == 0
        np.testing.assert_array_equal(step.row.outcome.torque_change[first], 0.0)
        assert np.all(step.row.outcome.torque_change[~first] > 0.0)


# --- actions, rewards, learning ---


@functools.partial(jax.jit, static_argnums=0)
def _act(sac, policy, observed, key):
    return sac.act(policy, observed).sample(key)[0]


def step_keys(step):
    """The keys of one step: next, action, reset, batch, updates."""
    return jax.random.split(jax.random.wrap_key_data(step.before.key), 5)


def test_prefill_acts_uniformly_and_training_acts_by_its_policy(steps, flight):
    prefill = steps[0].before.buffer.rows.action[:7].ravel()
    assert stats.kstest(prefill, "uniform", args=(-1.0, 2.0)).statistic < 1.95 / np.sqrt(prefill.size)
    observe, _ = flight
    for step in steps:
        observed = observe(step.before.env_states)
        expected = _act(learners.make_sac(CONFIG), step.before.learner.policy, observed, step_keys(step)[1])
        np.testing.assert_allclose(step.row.action, expected, atol=1e-5)
    actions = np.concatenate([step.row.action for step in steps])
    assert len(np.unique(actions[:, 0])) == len(actions)


def test_no_key_is_used_twice():
    """By jax's own checker, which looks at the traced program: a start and two steps."""
    env = train_step.training_environment(CONFIG)

    def program(key):
        state = train_step.init(CONFIG, key)
        for _ in range(2):
            state, _ = train_step.train_step(CONFIG, env, state)
        return state

    with jax.debug_key_reuse(True):
        jax.jit(program).trace(KEY)
        with pytest.raises(jax.errors.KeyReuseError):  # it does look
            jax.jit(lambda key: jax.random.normal(key) + jax.random.uniform(key)).trace(KEY)


@jax.jit
def _rewarded(buffer, at, key):
    return train_step._rewarded_batch(CONFIG, train_step.training_environment(CONFIG), buffer, at, key)


_windows = jax.jit(replay_buffer.sample_windows, static_argnames=("count", "length"))


def reward_by_hand(outcome, at):
    """The reward of the paper under a curriculum, in NumPy float64, with the constants of CONFIG.  Any shape."""
    o = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), outcome)
    reward = np.exp(-o.angle / (0.14 * 2.0 * np.pi)) + 9.0 * (o.angle <= np.deg2rad(60.0))
    reward -= 0.05 * o.torque / (2.0 * np.sqrt(3.0)) + 0.005 * o.torque_change
    reward -= 0.7 * ~(outcome.angle < outcome.angle_previous)
    margin = o.zone_margin - at.zone_tightening
    reward -= at.zone_weight * np.where(margin <= 0.0, 10.0, 10.0 * np.exp(-2.0 * at.zone_steepness * margin))
    return reward - at.effort_weight * (o.torque / 2.0) ** 2


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"zone_weight": 1.0},
        {"zone_weight": 3.0},
        {"zone_weight": 3.0, "zone_tightening": 0.1},
        {"zone_weight": 3.0, "zone_steepness": 2.0},
        {"effort_weight": 0.5},
        {"discount": 0.7},
    ],
    ids=str,
)
def test_reward_is_that_of_the_present_curriculum(steps, change):
    """One and the same buffer, other weights: other rewards, and everything else the same."""
    buffer, key = steps[-1].after.buffer, jax.random.key(4)
    plain = difficulty(0)
    at = plain.replace(**{name: np.float32(value) for name, value in change.items()})
    batch = to_host(_rewarded(buffer, at, key))
    window = to_host(_windows(buffer, key, 32, 2))
    reward = 0.5 * reward_by_hand(window.outcome, at)
    ended, gamma = window.truncated[0], at.discount
    assert ended.any() and not ended.all()
    expected = np.where(ended, reward[0], reward[0] + gamma * reward[1])
    np.testing.assert_allclose(batch.reward, expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(batch.discount, np.where(ended, gamma, gamma**2), rtol=1e-5)
    np.testing.assert_array_equal(batch.observation, window.observation[0])
    np.testing.assert_array_equal(batch.action, window.action[0])
    last = np.where(ended[:, None], window.next_observation[0], window.next_observation[1])
    np.testing.assert_array_equal(batch.next_observation, last)
    if change:
        assert np.max(np.abs(batch.reward - to_host(_rewarded(buffer, plain, key)).reward)) > 0.05


@functools.partial(jax.jit, static_argnums=0)
def _learn(sac, learner, batch, key, rate):
    return sac.update(learner, batch, key, rate)


@pytest.mark.parametrize("index", [5, STEPS - 2])
def test_a_step_learns_from_the_buffer_with_the_new_row_in_it(steps, index):
    step = steps[index]
    _, _, _, key_batch, key_updates = step_keys(step)
    at = difficulty(int(step.before.updates))
    batch = _rewarded(step.after.buffer, at, key_batch)
    learner = step.before.learner
    for i, key in enumerate(jax.random.split(key_updates, 2)):
        part = jax.tree.map(lambda leaf, i=i: leaf[16 * i : 16 * (i + 1)], batch)
        learner, _ = _learn(learners.make_sac(CONFIG), learner, part, key, at.learning_rate)
    moved = jax.tree.map(
        lambda new, old: np.max(np.abs(new - old)), step.after.learner.policy, step.before.learner.policy
    )
    assert 1e-4 < max(jax.tree.leaves(moved)) < 1e-2
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), step.after.learner, learner)


def test_metrics_are_means_over_the_environments(steps):
    for step in steps:
        outcome, terms = step.row.outcome, step.metrics.reward
        assert terms.attitude == pytest.approx(np.mean(np.exp(-outcome.angle / (0.28 * np.pi))), rel=1e-4)
        # The paper's own penalty: what is logged does not depend on the curriculum.
        penalty = np.where(outcome.zone_margin <= 0.0, 10.0, 10.0 * np.exp(-2.0 * outcome.zone_margin))
        assert terms.zone == pytest.approx(-np.mean(penalty), rel=1e-4)
        assert terms.effort == pytest.approx(-np.mean((outcome.torque / 2.0) ** 2), rel=1e-4)
        assert np.all(np.isfinite(jax.tree.leaves(step.metrics.learner)))


def test_a_loaded_buffer_is_not_joined_to_new_episodes(steps):
    """Else a window would run from the last step of the old run into the first one of the new."""
    source = jax.tree.map(jnp.array, steps[0].after)
    source = source.replace(key=jax.random.wrap_key_data(source.key))
    source = checkpoint.begin(CONFIG, None).replace(train=source)
    begun = to_host(checkpoint.begin(CONFIG, source).train)
    newest = jax.tree.map(lambda leaf: leaf[begun.buffer.head - 1], begun.buffer.rows)
    observed = jax.jit(jax.vmap(observation.observe))(begun.env_states)
    goes_on = np.all(np.isclose(newest.next_observation, observed, atol=1e-5), axis=-1)
    np.testing.assert_array_equal(newest.truncated | newest.terminated | goes_on, True)


# --- the environment of training ---


def test_the_environment_of_training_is_the_public_one_with_shorter_episodes():
    env = train_step.training_environment(CONFIG)
    assert isinstance(env, Reorientation)
    assert env.episode_steps == EPISODE
    assert env.rule == SamplingRule("resample", train_step.MAX_DRAWS, keep_angle=True)
    assert env.observed_zones == CONFIG.network.observed_zones


def test_the_curriculum_sets_the_deviations_and_nothing_else_of_the_environment():
    env, at = train_step.training_environment(CONFIG), difficulty(10)
    found = train_step.at_difficulty(env, at)
    assert float(found.ranges.max_angle) == float(at.max_angle) != float(env.ranges.max_angle)
    same = found.replace(
        ranges=found.ranges.replace(
            min_angle=env.ranges.min_angle, max_angle=env.ranges.max_angle, angle_bias=env.ranges.angle_bias
        )
    )
    jax.tree.map(np.testing.assert_array_equal, same, env)


def test_what_an_episode_meets_is_the_same_through_it_and_another_in_each():
    """Training flies the errors that evaluation does: truth, biases and delay are of an episode."""
    errors = UncertaintyConfig(inertia_error=0.1, disturbance_torque=0.02, attitude_noise_deg=0.1, rate_noise_deg=0.1)
    spread = CONFIG.task.model_copy(update={"spread": SpreadConfig(errors=errors, delay_steps=(0, 2))})
    config = CONFIG.model_copy(update={"task": spread, "training_episode_seconds": 2.0, "num_envs": 32})
    env = train_step.training_environment(config)
    now, again = (train_step.episodes_at(config, env, jnp.int32(step)) for step in (0, 1))
    assert isinstance(now.truth, Truth) and isinstance(again.truth, Truth)
    same = np.asarray(now.noise == again.noise)
    np.testing.assert_array_equal(np.all(np.asarray(now.truth.inertia_B == again.truth.inertia_B), axis=(1, 2)), same)
    assert len(np.unique(np.asarray(now.truth.inertia_B)[:, 0, 0])) == config.num_envs
    assert set(np.asarray(now.truth.delay).tolist()) == {0, 1, 2}
    np.testing.assert_allclose(np.linalg.norm(now.truth.disturbance_B, axis=1), 0.02, rtol=1e-5)
    # The first torques are on the way, and none has come.
    state = train_step.init(config, jax.random.key(0)).env_states
    assert state.on_the_way is not None and state.on_the_way.shape == (config.num_envs, 3, 3)


def _without_learning(sac, learner, *arguments):
    """In place of an update: the same learner.  The gradients are what takes long to compile."""
    metrics = jax.eval_shape(functools.partial(_UPDATE, sac), learner, *arguments)[1]
    return learner, jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), metrics)


_UPDATE = Sac.update


def test_every_episode_has_a_spacecraft_of_its_own(monkeypatch):
    """Environments are drawn anew exactly where their episode ends, and each differently."""
    monkeypatch.setattr(Sac, "update", _without_learning)
    spread = CONFIG.task.model_copy(update={"spread": SpreadConfig(spacecraft=True, urgency=(0.0, 1.0))})
    network = CONFIG.network.model_copy(update={"scaled": True})
    config = CONFIG.model_copy(update={"task": spread, "network": network, "training_episode_seconds": 2.0})
    env = train_step.training_environment(config)
    state = train_step.init(config, jax.random.key(0))
    step = jax.jit(functools.partial(train_step.train_step, config, env))
    drawn = jax.jit(functools.partial(train_step.episodes_at, config, env))
    changes = 0
    for number in range(8):
        now, then = (drawn(jnp.int32(config.prefill_steps + number + later)).env for later in (0, 1))
        state, _ = step(state)
        ended = np.asarray(state.env_states.steps) == 0
        for leaf in (lambda e: e.model.inertia_B, lambda e: e.ranges.boresight_B):
            changed = np.any((np.asarray(leaf(now)) != np.asarray(leaf(then))).reshape(config.num_envs, -1), axis=1)
            np.testing.assert_array_equal(changed, ended)
        # Two draws in a row may both be at the same end.
        assert np.all((np.asarray(now.urgency) == np.asarray(then.urgency))[~ended])
        changes += ended.sum()
    assert changes > 0
    assert len(np.unique(np.asarray(now.model.inertia_B)[:, 0, 0])) == config.num_envs
    assert len(np.unique(np.asarray(now.urgency))) > config.num_envs // 2
    # What a step is worth is the same for all: the time step is the task's.
    np.testing.assert_allclose(now.model.dt, config.task.step_seconds, rtol=1e-5)
