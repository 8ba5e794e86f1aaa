"""What holds for every adapter alike; what only one of them has is tested beside it."""

import ast
import functools
import importlib
import sys
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax import envs
from test_architecture import MODULES

from koz_jax.adapters.brax_env import ENV_NAME, wrap_for_training
from koz_jax.adapters.gym_env import ENV_ID, ReorientationEnv, ReorientationVectorEnv
from koz_jax.adapters.sb3_env import ReorientationVecEnv
from koz_jax.adapters.vector_env import NumpyVectorEnv
from koz_jax.config.task import ScenarioConfig, TaskConfig
from koz_jax.errors import MissingExtraError, SettingsError
from koz_jax.task import observation_layout, reward
from koz_jax.task.environment import Reorientation

TASK = TaskConfig(episode_seconds=2.0)
ENVS, STEPS, EPISODE = 3, 45, 20
SEED = 11


class Flight(NamedTuple):
    rewards: np.ndarray  # (steps, envs)
    led_to: np.ndarray  # (steps, envs, 16) observation that each step led to
    acted_on: np.ndarray  # (steps + 1, envs, 16) observation for each action, and for the next one
    over: np.ndarray  # (steps, envs) whether the episode ended


def random_actions(seed=0):
    # Beyond the limits too, which clips.
    return np.random.default_rng(seed).uniform(-1.2, 1.2, (STEPS, ENVS, 3)).astype(np.float32)


def gathered(start, steps):
    """A flight from rows of (reward, observation led to, observation to act on, over)."""
    rewards, led_to, acted_on, over = (np.stack([np.asarray(row[i]) for row in steps]) for i in range(4))
    return Flight(rewards, led_to, np.concatenate([np.asarray(start)[None], acted_on]), over)


@functools.cache
def oracle(seed):
    """The core, one environment and one episode at a time."""
    env = Reorientation.from_config(TASK)
    actions = jnp.array(random_actions())

    @jax.jit
    def episode(key, taken):
        def advance(state, action):
            stepped = env.step(state, action)
            return stepped.state, (reward.total(stepped.terms, reward.PAPER_WEIGHTS), env.observe(stepped.state))

        start = env.reset(key)
        _, (rewards, led_to) = jax.lax.scan(advance, start, taken)
        return env.observe(start), rewards, led_to

    rewards, led_to, starts = [], [], []
    for i in range(ENVS):
        key = jax.random.key(seed + i)
        flown = [
            episode(jax.random.fold_in(key, k), jnp.resize(actions[k * EPISODE :, i], (EPISODE, 3))) for k in range(3)
        ]
        starts.append([start for start, _, _ in flown])
        rewards.append(np.concatenate([values for _, values, _ in flown])[:STEPS])
        led_to.append(np.concatenate([seen for _, _, seen in flown])[:STEPS])
    rewards, led_to, starts = (np.swapaxes(np.array(values), 0, 1) for values in (rewards, led_to, starts))
    acted_on = np.concatenate([starts[:1], led_to])
    acted_on[[EPISODE, 2 * EPISODE]] = starts[1:]
    over = np.zeros((STEPS, ENVS), bool)
    over[[EPISODE - 1, 2 * EPISODE - 1]] = True
    return Flight(rewards, led_to, acted_on, over)


def by_numpy(seed, actions):
    made = NumpyVectorEnv(ENVS, TASK)
    start, rows = made.reset(range(seed, seed + ENVS)), []
    for action in actions:
        done: Any = made.step(action)
        assert not done.terminated.any()
        rows.append((done.reward, done.final_observation, done.observation, done.truncated))
    return gathered(start, rows)


def by_gymnasium(seed, actions):
    made = [gymnasium.make(ENV_ID, task=TASK) for _ in range(ENVS)]
    start = [one.reset(seed=seed + i)[0] for i, one in enumerate(made)]
    rows = []
    for action in actions:
        row = []
        for one, own in zip(made, np.clip(action, -1, 1), strict=True):
            led_to, value, terminated, truncated, _ = one.step(own)
            assert not terminated
            row.append((value, led_to, one.reset()[0] if truncated else led_to, truncated))
        rows.append([np.stack(column) for column in zip(*row, strict=True)])
    return gathered(start, rows)


def by_gymnasium_vector(seed, actions):
    made = gymnasium.make_vec(ENV_ID, num_envs=ENVS, task=TASK)
    start, _ = made.reset(seed=seed)
    rows = []
    for action in actions:
        seen, value, terminated, truncated, info = made.step(action)
        assert not terminated.any()
        final = info.get("final_obs", [None] * ENVS)
        rows.append((value, [seen[i] if final[i] is None else final[i] for i in range(ENVS)], seen, truncated))
    return gathered(start, rows)


def by_sb3(seed, actions):
    made = ReorientationVecEnv(ENVS, TASK)
    made.seed(seed)
    start, rows = made.reset(), []
    for action in actions:
        seen, value, done, infos = made.step(action)
        seen = np.asarray(seen)
        rows.append((value, [infos[i].get("terminal_observation", seen[i]) for i in range(ENVS)], seen, done))
    return gathered(start, rows)


@functools.cache
def brax_functions():
    bare: Any = envs.get_environment(ENV_NAME, task=TASK)
    made = wrap_for_training(bare, episode_length=bare.episode_steps)
    return jax.jit(made.reset), jax.jit(made.step)


def by_brax(seed, actions):
    reset, step = brax_functions()
    state: Any = reset(jax.vmap(jax.random.PRNGKey)(jnp.arange(seed, seed + ENVS)))
    start, rows = state.obs, []
    for action in actions:
        state = step(state, action)
        np.testing.assert_array_equal(state.done, state.info["truncation"])
        rows.append((state.reward, state.info["final_observation"], state.obs, state.done > 0))
    return gathered(start, rows)


ADAPTERS = (by_numpy, by_gymnasium, by_gymnasium_vector, by_sb3, by_brax)


@functools.cache
def flight(adapter, seed=SEED):
    return adapter(seed, random_actions())


@pytest.mark.slow
@pytest.mark.parametrize("adapter", ADAPTERS)
def test_the_same_actions_give_what_the_core_gives(adapter):
    """Rewards, true final observations, first observations of the next episodes, and where episodes end."""
    for name, ours, expected in zip(Flight._fields, flight(adapter), oracle(SEED), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-5, atol=2e-6, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("adapter", ADAPTERS)
def test_every_episode_of_every_environment_has_a_new_scenario(adapter):
    starts = flight(adapter).acted_on[[0, EPISODE, 2 * EPISODE]].reshape(-1, observation_layout.SIZE)
    gaps = np.abs(starts[:, None] - starts[None]).max(axis=2) + np.eye(len(starts))
    assert gaps.min() > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("adapter", ADAPTERS)
def test_the_final_observation_is_not_that_of_the_reset(adapter):
    flown = flight(adapter)
    ends = flown.over.nonzero()
    assert flown.over.sum() == 2 * ENVS
    assert np.abs(flown.led_to - flown.acted_on[1:])[ends].max(axis=1).min() > 1e-2
    np.testing.assert_array_equal(flown.led_to[~flown.over], flown.acted_on[1:][~flown.over])


@pytest.mark.parametrize("adapter", ADAPTERS)
def test_a_seed_gives_the_same_flight_again_and_another_seed_another(adapter):
    again = adapter(SEED, random_actions())
    for ours, expected in zip(again, flight(adapter), strict=True):
        np.testing.assert_array_equal(ours, expected)
    moved = adapter(SEED + 1, random_actions())
    # One seed further, environment i flies what environment i + 1 flew.
    np.testing.assert_array_equal(moved.acted_on[0][:-1], flight(adapter).acted_on[0][1:])
    assert np.abs(moved.rewards - flight(adapter).rewards).max() > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("make", [ReorientationEnv, ReorientationVectorEnv, lambda: ReorientationVecEnv(ENVS)])
def test_without_a_seed_every_environment_object_flies_something_else(make):
    def first(made):
        begun = made.reset()
        return begun[0] if isinstance(begun, tuple) else begun

    assert np.abs(first(make()) - first(make())).max() > 1e-3


@pytest.mark.parametrize(
    "options",
    [
        {"min_angle_deg": -1.0},
        {"max_angle_deg": 181.0},
        {"min_angle_deg": 120.0, "max_angle_deg": 100.0},
        {"min_angle_deg": 0.0, "max_angle_deg": 30.0},  # no zone fits
    ],
)
@pytest.mark.parametrize("make", [ReorientationEnv, ReorientationVectorEnv, functools.partial(ReorientationVecEnv, 2)])
def test_deviations_that_cannot_be_are_refused(make, options):
    with pytest.raises(SettingsError, match="angle_deg: must be"):
        make(**options)


@pytest.mark.slow
def test_every_adapter_shows_all_the_zones_that_a_scenario_can_have():
    several = TaskConfig(scenario=ScenarioConfig(max_zones=3))
    size = observation_layout.size(3)
    assert ReorientationEnv(several).observation_space.shape == (size,)
    assert ReorientationVectorEnv(2, several).observation_space.shape == (2, size)
    assert ReorientationVecEnv(2, several).observation_space.shape == (size,)
    assert envs.get_environment(ENV_NAME, task=several).observation_size == size
    assert NumpyVectorEnv(1, several).reset([0]).shape == (1, size)


def imports_of(path):
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.split(".")[0])
    return found


def test_only_the_adapters_need_packages_of_other_environments():
    optional = {"gymnasium", "stable_baselines3", "sbx", "torch"}
    users = {module for module, path in MODULES.items() if imports_of(path) & optional}
    assert users == {"koz_jax.adapters.gym_env", "koz_jax.adapters.sb3_env", "koz_jax.agents.sb3"}


@pytest.mark.parametrize(
    ("module", "package", "extra"), [("gym_env", "gymnasium", "gym"), ("sb3_env", "stable_baselines3", "sb3")]
)
def test_a_missing_package_is_named_with_what_installs_it(monkeypatch, module, package, extra):
    for name in list(sys.modules):
        if name.split(".")[0] == package:
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, f"koz_jax.adapters.{module}")
    with pytest.raises(
        MissingExtraError, match=rf"{package}: cannot be imported.*pip install 'koz_jax\[{extra}\]'"
    ) as caught:
        importlib.import_module(f"koz_jax.adapters.{module}")
    assert isinstance(caught.value, ImportError)
