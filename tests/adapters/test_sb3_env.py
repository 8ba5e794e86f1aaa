import warnings
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from test_adapters import TASK

from koz_jax.adapters.gym_env import ReorientationEnv
from koz_jax.adapters.sb3_env import ReorientationVecEnv
from koz_jax.errors import SettingsError

STILL = np.zeros((3, 3), np.float32)


@pytest.mark.slow
def test_stable_baselines_finds_no_fault():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(ReorientationEnv(TASK))


def learner(env, **settings):
    return SAC("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [16, 16]}, batch_size=32, device="cpu", **settings)


@pytest.mark.slow
def test_sac_learns_from_true_final_observations():
    env = ReorientationVecEnv(3, TASK)
    model = learner(env, learning_starts=60, gradient_steps=2, buffer_size=1000)
    model.learn(240)  # 80 steps of three environments, so four episodes each
    buffer: Any = model.replay_buffer
    assert buffer.pos == 80 and model._n_updates == 2 * (80 - 20)
    ends = np.zeros(80)
    ends[[19, 39, 59, 79]] = 1.0
    np.testing.assert_array_equal(buffer.dones[:80], np.tile(ends[:, None], 3))
    np.testing.assert_array_equal(buffer.timeouts[:80], buffer.dones[:80])
    # Within an episode a transition leads to where the next begins; at its end it must not.
    gap = np.abs(buffer.next_observations[:79] - buffer.observations[1:80]).max(axis=2)
    np.testing.assert_array_equal(gap > 1e-2, buffer.dones[:79] > 0)
    np.testing.assert_array_equal(gap[buffer.dones[:79] == 0], 0.0)


def test_the_usual_wrappers_and_the_evaluation_work_on_it():
    env = VecNormalize(VecMonitor(ReorientationVecEnv(3, TASK), info_keywords=("is_success",)))
    judged: Any = evaluate_policy(learner(env), env, n_eval_episodes=6, return_episode_rewards=True, warn=False)
    rewards, lengths = judged
    assert lengths == [20] * 6
    assert len(set(rewards)) == 6


def test_a_wrapper_may_write_into_the_info_of_one_environment():
    env = ReorientationVecEnv(3, TASK)
    env.seed(3)
    env.reset()
    infos = env.step(STILL)[3]
    assert infos == [{}, {}, {}]
    infos[0].update(mine=1)
    assert infos == [{"mine": 1}, {}, {}]
    assert env.step(STILL)[3] == [{}, {}, {}]


def test_infos_of_ended_episodes_say_what_happened():
    env = ReorientationVecEnv(3, TASK)
    env.seed(3)
    env.reset()
    for _ in range(20):
        _, _, dones, infos = env.step(STILL)
    last: Any = env.last_step
    assert dones.all()
    for i, info in enumerate(infos):
        assert info.keys() == {"terminal_observation", "TimeLimit.truncated", "is_success"}
        assert info["TimeLimit.truncated"] is True
        assert info["is_success"] == (last.settled[i] and not last.violated[i])
        np.testing.assert_array_equal(info["terminal_observation"], last.final_observation[i])


def test_a_seed_counts_for_one_reset():
    env = ReorientationVecEnv(3, TASK)
    env.seed(3)
    first, second = env.reset(), env.reset()
    assert np.abs(first - second).max() > 1e-2
    env.seed(3)
    np.testing.assert_array_equal(env.reset(), first)


def test_what_makes_no_sense_here_is_refused():
    env = ReorientationVecEnv(3, TASK)
    with pytest.raises(SettingsError, match="set_attr"):
        env.set_attr("speed", 3)
    with pytest.raises(SettingsError, match="env_method"):
        env.env_method("render")
    seeds: list[Any] = [-1, 1.5, 2**32 - 1]
    for seed in seeds:
        with pytest.raises(SettingsError, match=f"seed: must be .*, got {seed}"):
            env.seed(seed)
    env.set_options({"scenario": 3})
    with pytest.raises(SettingsError, match="scenario: must be a Scenario"):
        env.reset()
    assert env.env_is_wrapped(VecMonitor, indices=[0]) == [False]
    assert env.get_attr("num_envs") == [3, 3, 3]
