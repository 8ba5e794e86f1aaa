import functools
import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax import envs
from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper

from koz_jax.adapters.brax_env import ENV_NAME, ReorientationEnv, wrap_for_training
from koz_jax.config.task import TaskConfig
from koz_jax.errors import SettingsError
from koz_jax.task import reward
from koz_jax.task.environment import Reorientation

TASK = TaskConfig(episode_seconds=2.0)
ENV = ReorientationEnv(TASK)


@functools.cache
def jitted(wrapped):
    return jax.jit(wrapped.step)


@pytest.mark.slow
def test_import_is_silent():
    done = subprocess.run(
        [sys.executable, "-c", "import koz_jax.adapters.brax_env"], capture_output=True, text=True, check=True
    )
    assert done.stdout == ""


@pytest.mark.slow
def test_rewards_and_observations_are_those_of_the_core():
    env = Reorientation.from_config(TASK)
    step, observe = jax.jit(env.step), jax.jit(env.observe)
    state: Any = jax.jit(ENV.reset)(jax.random.key(3))
    core: Any = state.pipeline_state
    for key in jax.random.split(jax.random.key(4), 10):
        action = jax.random.uniform(key, (ENV.action_size,), minval=-1.0, maxval=1.0)
        state = jitted(ENV)(state, action)
        stepped = step(core, action)
        core = stepped.state
        np.testing.assert_allclose(state.reward, reward.total(stepped.terms, reward.PAPER_WEIGHTS), rtol=1e-5)
        np.testing.assert_allclose(jnp.asarray(state.obs), observe(core), rtol=1e-5, atol=1e-6)
    assert jnp.shape(state.obs) == (ENV.observation_size,)


@pytest.mark.slow
def test_typed_and_raw_keys_draw_the_same_scenario():
    key = jax.random.key(5)
    np.testing.assert_array_equal(ENV.reset(key).obs, ENV.reset(jax.random.key_data(key)).obs)


@pytest.mark.slow
def test_every_key_draws_another_scenario():
    observed = jax.jit(jax.vmap(lambda key: ENV.reset(key).obs))(jax.random.split(jax.random.key(6), 16))
    assert len(np.unique(np.asarray(observed), axis=0)) == 16


@pytest.mark.slow
def test_time_up_is_a_truncation_in_the_wrappers_of_brax_too():
    wrapped = EpisodeWrapper(VmapWrapper(ENV), ENV.episode_steps, action_repeat=1)
    state: Any = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(7), 2))
    for done in range(1, 21):
        state = jitted(wrapped)(state, jnp.zeros((2, ENV.action_size)))
        np.testing.assert_array_equal(state.done, [done == 20] * 2)
        np.testing.assert_array_equal(state.info["truncation"], state.done)


def test_it_is_registered():
    made: Any = envs.get_environment(ENV_NAME, task=TASK)
    assert isinstance(made, ReorientationEnv) and made.episode_steps == 20


@pytest.mark.slow
def test_episodes_shorter_than_the_maneuver_are_counted_from_each_reset():
    wrapped = wrap_for_training(ENV, episode_length=6, action_repeat=2)
    state: Any = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(8), 2))
    done, steps = [], []
    for _ in range(7):
        state = jitted(wrapped)(state, jnp.zeros((2, ENV.action_size)))
        done.append(float(state.done[0]))
        steps.append(float(state.info["steps"][0]))
    assert done == [0, 0, 1, 0, 0, 1, 0]
    assert steps == [2, 4, 6, 2, 4, 6, 2]
    np.testing.assert_array_equal(state.info["episode"], [2, 2])


def test_randomisation_of_a_brax_system_is_refused():
    with pytest.raises(SettingsError, match="randomization_fn: "):
        wrap_for_training(ENV, randomization_fn=lambda system: system)
    with pytest.raises(SettingsError, match="episode_length: must be 1 or more, got 0"):
        wrap_for_training(ENV, 0)
