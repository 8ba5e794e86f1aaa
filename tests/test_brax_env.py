import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from koz_jax import env, observation, reward, task
from koz_jax.brax_env import ReorientationEnv
from koz_jax.task_config import TaskConfig

TASK = TaskConfig(episode_seconds=2.0)
ENV = ReorientationEnv(TASK)


def test_import_is_silent():
    done = subprocess.run([sys.executable, "-c", "import koz_jax.brax_env"], capture_output=True, text=True, check=True)
    assert done.stdout == ""


def test_rewards_and_observations_are_those_of_the_core():
    params = task.env_params(TASK)
    state: Any = ENV.reset(jax.random.key(3))
    core: Any = state.pipeline_state
    for key in jax.random.split(jax.random.key(4), 10):
        action = jax.random.uniform(key, (ENV.action_size,), minval=-1.0, maxval=1.0)
        state = ENV.step(state, action)
        core, outcome = env.step(core, action, params)
        terms = reward.terms(outcome, params.reward, params.spacecraft.torque_limit)
        np.testing.assert_allclose(state.reward, reward.total(terms, reward.PAPER_WEIGHTS), rtol=1e-6)
        np.testing.assert_allclose(jnp.asarray(state.obs), observation.observe(core, params), rtol=1e-6)
    assert jnp.shape(state.obs) == (ENV.observation_size,)


def test_typed_and_raw_keys_draw_the_same_scenario():
    key = jax.random.key(5)
    np.testing.assert_array_equal(ENV.reset(key).obs, ENV.reset(jax.random.key_data(key)).obs)


def test_every_key_draws_another_scenario():
    observed = jax.vmap(lambda key: ENV.reset(key).obs)(jax.random.split(jax.random.key(6), 16))
    assert len(np.unique(np.asarray(observed), axis=0)) == 16


@pytest.mark.parametrize("steps", [19, 20])
def test_an_episode_is_truncated_at_its_length_and_not_before(steps):
    def advance(state, _):
        return ENV.step(state, jnp.zeros(ENV.action_size)), None

    state, _ = jax.lax.scan(advance, ENV.reset(jax.random.key(7)), None, length=steps)
    assert float(state.done) == float(state.info["truncation"]) == float(steps == 20)
