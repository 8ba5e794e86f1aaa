"""TD3 and DDPG: whole updates against NumPy float64, and the known answers of toy problems."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from support import probes
from support.reference import COUNT, adam, as_float64, assert_close, encoded, make_batch, mlp, norm, slopes, values

from koz_jax.learners.td3 import Td3, Td3State

SHARED: dict[str, Any] = {
    "observation_size": 3,
    "action_size": 2,
    "hidden_sizes": (6, 5),
    "encoding": ((0, 2, 0.3),),
    "soft_update": 0.05,
    "policy_average": 0.1,
    "exploration_noise": 0.1,
}
TD3 = Td3(**SHARED, target_noise=0.3, target_noise_clip=0.4, policy_delay=2)
DDPG = Td3(**SHARED, critics=1)
RATE = 0.02  # large: the order of the steps must show

_update = jax.jit(Td3.update, static_argnums=0)


def in_midst_of_training(algorithm, seed):
    """A state none of whose parts is at its initial value."""
    draw = np.random.default_rng(seed)
    learner = algorithm.init(jax.random.key(seed))

    def noisy(tree, scale):
        return jax.tree.map(lambda x: jnp.asarray(x + scale * draw.normal(size=x.shape), jnp.float32), tree)

    def optimizer(params, count):
        return optax.ScaleByAdamState(
            count=jnp.int32(count),
            mu=noisy(jax.tree.map(jnp.zeros_like, params), 0.1),
            nu=jax.tree.map(lambda x: jnp.asarray(draw.uniform(0.001, 0.1, x.shape), jnp.float32), params),
        )

    return learner.replace(
        policy=noisy(learner.policy, 0.1),
        averaged_policy=noisy(learner.policy, 0.2),
        target_policy=noisy(learner.policy, 0.3),
        critic=noisy(learner.critic, 0.1),
        target_critic=noisy(learner.critic, 0.2),
        policy_optimizer=optimizer(learner.policy, 7),
        critic_optimizer=optimizer(learner.critic, 9),
    )


def act(policy, observation):
    return np.tanh(mlp(policy["params"]["Mlp_0"], encoded(observation))[:, :2])


def average(share, new, before):
    return jax.tree.map(lambda n, b: share * n + (1 - share) * b, new, before)


def reference_update(algorithm, learner, batch, key, rate):
    """One update in float64.  Returns the new state and its metrics by name."""
    old, batch = as_float64(learner), as_float64(batch)
    clip = algorithm.target_noise_clip
    noise = np.clip(algorithm.target_noise * as_float64(jax.random.normal(key, (COUNT, 2))), -clip, clip)
    next_action = np.clip(act(old.target_policy, batch.next_observation) + noise, -1.0, 1.0)
    next_q = values(old.target_critic, batch.next_observation, next_action).min(axis=0)
    target = batch.reward + batch.discount * next_q

    def critic_loss(critic):
        return sum(0.5 * np.mean((q - target) ** 2) for q in values(critic, batch.observation, batch.action))

    critic_gradient = slopes(critic_loss, old.critic)
    critic, critic_optimizer = adam(old.critic, critic_gradient, old.critic_optimizer, rate)
    new = old.replace(critic=critic, critic_optimizer=critic_optimizer, updates=old.updates + 1)
    metrics = {
        "critic_loss": critic_loss(old.critic),
        "q_mean": np.mean(values(old.critic, batch.observation, batch.action)),
        "critic_gradient": norm(critic_gradient),
        **dict.fromkeys(("alpha", "entropy", "actor_loss", "policy_gradient"), 0.0),
    }
    if int(new.updates) % algorithm.policy_delay:
        return new, metrics

    def actor_loss(policy):
        return -np.mean(values(critic, batch.observation, act(policy, batch.observation))[0])

    gradient = slopes(actor_loss, old.policy)
    policy, policy_optimizer = adam(old.policy, gradient, old.policy_optimizer, rate)
    return new.replace(
        policy=policy,
        averaged_policy=average(algorithm.policy_average, policy, old.averaged_policy),
        target_policy=average(algorithm.soft_update, policy, old.target_policy),
        target_critic=average(algorithm.soft_update, critic, old.target_critic),
        policy_optimizer=policy_optimizer,
    ), metrics | {"actor_loss": actor_loss(old.policy), "policy_gradient": norm(gradient)}


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [TD3, DDPG], ids=["td3", "ddpg"])
def test_a_chain_of_updates_is_that_of_the_reference(algorithm):
    found = in_midst_of_training(algorithm, 0)
    expected = as_float64(found)
    improved = []
    for i in range(4):
        before, key = found, jax.random.key(i)
        found, metrics = _update(algorithm, found, make_batch(i), key, RATE)
        expected, wanted = reference_update(algorithm, expected, make_batch(i), key, RATE)
        assert_close(found, expected, rtol=1e-4, atol=1e-5)
        assert set(wanted) == set(metrics.__dataclass_fields__)
        for name, value in wanted.items():
            assert getattr(metrics, name) == pytest.approx(value, rel=1e-3, abs=1e-5), name
        improved.append(not np.array_equal(*(jax.tree.leaves(state.policy)[0] for state in (before, found))))
    assert improved == [i % algorithm.policy_delay == algorithm.policy_delay - 1 for i in range(4)]
    assert isinstance(found, Td3State) and int(found.updates) == 4


@pytest.mark.slow
def test_exploration_is_the_policy_with_noise_and_stays_within_bounds():
    learner = in_midst_of_training(TD3, 1)
    observation = jnp.tile(make_batch(0).observation, (500, 1))
    action = jax.jit(Td3.explore, static_argnums=0)(TD3, learner, observation, jax.random.key(0))
    mean = act(as_float64(learner.policy), as_float64(observation))
    inner = np.abs(mean) < 0.5
    assert np.std((action - mean)[inner]) == pytest.approx(0.1, rel=0.05)
    assert np.mean((action - mean)[inner]) == pytest.approx(0.0, abs=0.01)
    assert np.max(np.abs(action)) <= 1.0


@pytest.mark.slow
def test_policy_acts_for_a_reward_that_comes_later():
    sizes = {name: getattr(probes.SAC, name) for name in SHARED.keys() - {"exploration_noise"}}
    algorithm = Td3(**SHARED | sizes, target_noise=0.1, target_noise_clip=0.2, policy_delay=2)
    learner = probes.learn_with(algorithm, probes.delayed_choice())
    observation, action = probes.grid()
    first = observation.at[:, 0].set(-1.0)
    found = algorithm.value(learner.critic, first, action)
    np.testing.assert_allclose(found, np.stack(2 * [0.9 * action[:, 0]]), atol=0.15)
    assert np.min(probes.mode(learner, first)) > 0.9
