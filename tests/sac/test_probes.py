"""Soft Actor-Critic finds the known answers of toy problems; each isolates one thing that can be wrong."""

import jax.numpy as jnp
import numpy as np
import pytest
from support import probes

pytestmark = pytest.mark.slow


def test_constant_reward_is_worth_a_geometric_series():
    learner, _ = probes.learn(probes.constant_reward())
    np.testing.assert_allclose(probes.value(learner, *probes.grid()), 10.0, atol=0.5)


def test_n_step_returns_leave_the_value_alone_also_where_episodes_are_cut():
    learner, _ = probes.learn(probes.constant_reward_in_windows(3, "truncated"))
    np.testing.assert_allclose(probes.value(learner, *probes.grid()), 10.0, atol=0.5)


def test_termination_takes_its_share_of_the_value():
    learner, _ = probes.learn(probes.constant_reward_in_windows(3, "terminated"))
    np.testing.assert_allclose(np.mean(probes.value(learner, *probes.grid())), 1.0 / (1.0 - 0.9 * 0.8), atol=0.15)


def test_the_last_step_is_worth_its_reward():
    learner, _ = probes.learn(probes.one_step_reward_by_observation())
    observation, action = probes.grid()
    expected = np.broadcast_to(2.0 * observation[:, 0] - observation[:, 1], (2, len(action)))
    np.testing.assert_allclose(probes.value(learner, observation, action), expected, atol=0.1)


def test_value_is_discounted_over_two_steps():
    learner, _ = probes.learn(probes.two_steps())
    observation, action = probes.grid()
    for x, expected in ((-1.0, probes.GAMMA), (1.0, 1.0)):
        found = probes.value(learner, observation.at[:, 0].set(x), action)
        np.testing.assert_allclose(found, expected, atol=0.05)


def test_policy_finds_the_best_action():
    learner, _ = probes.learn(probes.one_step_bandit(slope=0.0))
    np.testing.assert_allclose(probes.mode(learner, probes.grid()[0]), 0.5, atol=0.1)


def test_policy_finds_the_best_action_for_each_observation():
    learner, _ = probes.learn(probes.one_step_bandit(slope=0.3))
    observation, _ = probes.grid()
    np.testing.assert_allclose(probes.mode(learner, observation), 0.5 + 0.3 * observation[:, 0], atol=0.1)


def test_policy_acts_for_a_reward_that_comes_later():
    learner, _ = probes.learn(probes.delayed_choice())
    observation, action = probes.grid()
    first = observation.at[:, 0].set(-1.0)
    np.testing.assert_allclose(probes.value(learner, first, action), np.stack(2 * [0.9 * action[:, 0]]), atol=0.1)
    assert np.min(probes.mode(learner, first)) > 0.9


@pytest.mark.parametrize("alpha", [0.03, 0.5])
def test_entropy_reaches_its_target_and_counts_in_the_value(alpha):
    learner, metrics = probes.learn(probes.endless_bandit(), alpha)
    assert np.mean(metrics.entropy[-200:]) == pytest.approx(-1.0, abs=0.1)
    best_alpha = 10.0 / (np.pi * np.e**3)
    assert np.mean(metrics.alpha[-200:]) == pytest.approx(best_alpha, rel=0.3)
    # The best action costs nothing now; the smaller of two critics errs on the low side.  Without entropy: -0.7.
    observation, _ = probes.grid()
    found = np.mean(probes.value(learner, observation, jnp.full((len(observation), 1), 0.5)))
    assert found == pytest.approx(-1.5 * best_alpha * probes.GAMMA / (1.0 - probes.GAMMA), abs=0.7)
