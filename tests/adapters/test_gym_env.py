import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from test_adapters import TASK, random_actions

from koz_jax.adapters.gym_env import ENV_ID, ReorientationEnv, ReorientationVectorEnv
from koz_jax.errors import SettingsError


@pytest.mark.slow
def test_gymnasium_finds_no_fault():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(ENV_ID).unwrapped)


def same(ours, theirs, where="info"):
    """Nested infos of vector environments: same keys, same values where the mask holds."""
    assert ours.keys() == theirs.keys(), where
    for name in ours:
        if isinstance(ours[name], dict):
            same(ours[name], theirs[name], f"{where}/{name}")
        elif ours[name].dtype == object:
            for one, other in zip(ours[name], theirs[name], strict=True):
                assert (one is None) == (other is None)
                if one is not None:
                    np.testing.assert_allclose(one, other, rtol=1e-5, atol=2e-6)
        else:
            np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-5, atol=2e-6, err_msg=f"{where}/{name}")


@pytest.mark.slow
def test_the_vector_environment_is_as_gymnasium_would_make_one_of_single_ones():
    ours = gymnasium.make_vec(ENV_ID, num_envs=3, task=TASK)
    singles = [lambda: gymnasium.make(ENV_ID, task=TASK, disable_env_checker=True)] * 3
    theirs = SyncVectorEnv(singles, autoreset_mode=AutoresetMode.SAME_STEP)
    assert ours.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)
    np.testing.assert_array_equal(ours.reset(seed=4)[0], theirs.reset(seed=4)[0])
    for action in np.clip(random_actions(), -1, 1):
        *values, info = ours.step(action)
        *expected, expected_info = theirs.step(action)
        for one, other in zip(values, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=2e-6)
        same(info, expected_info)


def test_a_sequence_of_seeds_gives_each_environment_its_own():
    envs = ReorientationVectorEnv(3, TASK)
    first, _ = envs.reset(seed=[9, 4, 0])
    again, _ = envs.reset(seed=4)
    np.testing.assert_array_equal(first[1], again[0])
    mixed, _ = envs.reset(seed=[None, 4, None])
    np.testing.assert_array_equal(mixed[1], first[1])
    assert np.all(np.abs(mixed[[0, 2]] - first[[0, 2]]).max(axis=1) > 1e-2)


def test_seeds_may_be_numbers_of_numpy_but_no_fractions():
    env, envs = ReorientationEnv(TASK), ReorientationVectorEnv(3, TASK)
    numpy_seed: Any = np.int64(4)
    fraction: Any = 1.5
    np.testing.assert_array_equal(envs.reset(seed=numpy_seed)[0][0], env.reset(seed=4)[0])
    for which in (env, envs):
        with pytest.raises(SettingsError, match=r"seed: must be a whole number .*, got 1\.5"):
            which.reset(seed=fraction)


def test_a_step_after_the_end_of_an_episode_is_refused():
    env = ReorientationEnv(TASK)
    env.reset(seed=0)
    still = np.zeros(3, np.float32)
    while not env.step(still)[3]:
        pass
    with pytest.raises(SettingsError, match="step: must come after a reset"):
        env.step(still)
    env.reset(seed=0)
    env.step(still)


@pytest.mark.slow
def test_observations_belong_to_the_caller():
    envs = ReorientationVectorEnv(3, TASK)
    seen, _ = envs.reset(seed=0)
    seen[:] = 7.0
    after, rewards, *_ = envs.step(np.zeros((3, 3), np.float32))
    assert not np.any(after == 7.0)
    after[:], rewards[:] = 0.0, 0.0
