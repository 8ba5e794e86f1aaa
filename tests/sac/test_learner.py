"""A whole update against an independent one in NumPy float64.

The reference shares no code with the learner: its own forward passes, gradients by central differences, its own Adam
and averages, in the order of Stable-Baselines3.  It draws the same noise, so both must agree number by number.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from support.reference import COUNT, adam, as_float64, assert_close, encoded, make_batch, mlp, norm, slopes, values

from koz_jax.sac.learner import Sac, SacState

SAC = Sac(
    hidden_sizes=(6, 5),
    encoding=((0, 2, 0.3),),
    observation_size=3,
    action_size=2,
    target_entropy=-2.0,
    soft_update=0.05,
    policy_average=0.1,
    initial_entropy_coefficient=0.5,
)
RATE = 0.02  # large: the order of the steps must show

_init = jax.jit(Sac.init, static_argnums=0)
_update = jax.jit(Sac.update, static_argnums=0)


def in_midst_of_training(seed):
    """A learner none of whose parts is at its initial value, so that no part can be mixed up unnoticed."""
    draw = np.random.default_rng(seed)
    learner = _init(SAC, jax.random.key(seed))

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
        critic=noisy(learner.critic, 0.1),
        target_critic=noisy(learner.critic, 0.2),
        log_alpha=jnp.float32(-0.4),
        policy_optimizer=optimizer(learner.policy, 7),
        critic_optimizer=optimizer(learner.critic, 9),
        alpha_optimizer=optimizer(learner.log_alpha, 3),
    )


def act(policy, observation, noise):
    """Squashed action and log probability for given noise."""
    output = mlp(policy["params"]["Mlp_0"], encoded(observation))
    mean, log_std = output[:, :2], np.clip(output[:, 2:], -20.0, 2.0)
    raw = mean + np.exp(log_std) * noise
    log_density = -0.5 * noise**2 - log_std - 0.5 * np.log(2 * np.pi)
    log_slope = 2.0 * (np.log(2.0) - np.logaddexp(raw, -raw))
    return np.tanh(raw), np.sum(log_density - log_slope, axis=1)


def reference_update(learner, batch, key, rate):
    """One update of SAC in float64.  Returns the new learner and its metrics by name."""
    old, batch = as_float64(learner), as_float64(batch)
    key_policy, key_next = jax.random.split(key)
    noise, next_noise = (as_float64(jax.random.normal(k, (COUNT, 2))) for k in (key_policy, key_next))
    alpha = np.exp(old.log_alpha)

    # Entropy coefficient: moved by the entropy of the old policy, and used only from the next update on.
    _, log_prob = act(old.policy, batch.observation, noise)
    surplus = np.mean(log_prob) + SAC.target_entropy
    log_alpha, alpha_optimizer = adam(old.log_alpha, -surplus, old.alpha_optimizer, rate)

    next_action, next_log_prob = act(old.policy, batch.next_observation, next_noise)
    next_q = values(old.target_critic, batch.next_observation, next_action).min(axis=0) - alpha * next_log_prob
    target = batch.reward + batch.discount * next_q

    def critic_loss(critic):
        return sum(0.5 * np.mean((q - target) ** 2) for q in values(critic, batch.observation, batch.action))

    critic_gradient = slopes(critic_loss, old.critic)
    critic, critic_optimizer = adam(old.critic, critic_gradient, old.critic_optimizer, rate)

    def actor_loss(policy):
        action, log_prob = act(policy, batch.observation, noise)
        return np.mean(alpha * log_prob - values(critic, batch.observation, action).min(axis=0))

    policy_gradient = slopes(actor_loss, old.policy)
    policy, policy_optimizer = adam(old.policy, policy_gradient, old.policy_optimizer, rate)

    def average(share, new, before):
        return jax.tree.map(lambda n, b: share * n + (1 - share) * b, new, before)

    new = SacState(
        policy=policy,
        averaged_policy=average(SAC.policy_average, policy, old.averaged_policy),
        critic=critic,
        target_critic=average(SAC.soft_update, critic, old.target_critic),
        log_alpha=log_alpha,
        policy_optimizer=policy_optimizer,
        critic_optimizer=critic_optimizer,
        alpha_optimizer=alpha_optimizer,
    )
    return new, {
        "critic_loss": critic_loss(old.critic),
        "actor_loss": actor_loss(old.policy),
        "alpha": alpha,
        "entropy": -np.mean(log_prob),
        "q_mean": np.mean(values(old.critic, batch.observation, batch.action)),
        "critic_gradient": norm(critic_gradient),
        "policy_gradient": norm(policy_gradient),
    }


@functools.cache
def both_updates(seed):
    learner, batch, key = in_midst_of_training(seed), make_batch(seed), jax.random.key(100 + seed)
    return learner, _update(SAC, learner, batch, key, RATE), reference_update(learner, batch, key, RATE)


SEEDS = (0, 1, 2)
PARTS = list(SacState.__dataclass_fields__)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("part", PARTS)
def test_update_is_that_of_the_reference(part, seed):
    _, (found, _), (expected, _) = both_updates(seed)
    assert_close(getattr(found, part), getattr(expected, part), rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("seed", SEEDS)
def test_metrics_are_those_of_the_reference(seed):
    _, (_, found), (_, expected) = both_updates(seed)
    assert set(found.__dataclass_fields__) == set(expected)
    for name, value in expected.items():
        assert getattr(found, name) == pytest.approx(value, rel=1e-4, abs=1e-5), name


@pytest.mark.parametrize("part", PARTS)
def test_update_moves_every_part(part):
    learner, (found, _), _ = both_updates(0)
    moved = jax.tree.map(lambda old, new: np.any(old != new), getattr(learner, part), getattr(found, part))
    assert all(jax.tree.leaves(moved))


def test_a_chain_of_updates_follows_the_reference():
    found = in_midst_of_training(3)
    expected = as_float64(found)
    for i in range(5):
        key = jax.random.key(i)
        found, _ = _update(SAC, found, make_batch(i), key, RATE)
        expected, _ = reference_update(expected, make_batch(i), key, RATE)
    assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_a_fresh_learner():
    learner = _init(SAC, jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, learner.policy, learner.averaged_policy)
    jax.tree.map(np.testing.assert_array_equal, learner.critic, learner.target_critic)
    assert np.exp(learner.log_alpha) == pytest.approx(SAC.initial_entropy_coefficient)
    for optimizer in (learner.policy_optimizer, learner.critic_optimizer, learner.alpha_optimizer):
        assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(optimizer))
    other = _init(SAC, jax.random.key(1))
    for part in ("policy", "critic"):
        leaves = zip(jax.tree.leaves(getattr(learner, part)), jax.tree.leaves(getattr(other, part)), strict=True)
        assert not any(np.any(one == two) for one, two in leaves if one.ndim == 2)


def test_learning_rate_zero_moves_no_network_and_no_coefficient():
    learner = _init(SAC, jax.random.key(0))
    after, _ = _update(SAC, learner, make_batch(0), jax.random.key(0), 0.0)
    for part in ("policy", "critic", "log_alpha"):
        jax.tree.map(np.testing.assert_array_equal, getattr(after, part), getattr(learner, part))


def test_nothing_in_a_batch_leaks_past_a_termination():
    """Where the discount is 0, what comes next must not matter, however wild."""
    learner, batch = in_midst_of_training(0), make_batch(0)
    ended = batch.replace(discount=jnp.zeros(COUNT))
    wild = ended.replace(next_observation=1e3 * batch.next_observation)
    one, _ = _update(SAC, learner, ended, jax.random.key(0), RATE)
    two, _ = _update(SAC, learner, wild, jax.random.key(0), RATE)
    jax.tree.map(np.testing.assert_array_equal, one, two)


def test_policy_noise_is_not_shared_between_the_two_samples():
    """With the same observation on both sides, the two draws of an update must still differ."""
    learner, batch = in_midst_of_training(0), make_batch(0)
    batch = batch.replace(observation=batch.next_observation)
    _, metrics = _update(SAC, learner, batch, jax.random.key(0), RATE)
    entropies = []
    for key in jax.random.split(jax.random.key(0)):
        noise = as_float64(jax.random.normal(key, (COUNT, 2)))
        entropies.append(-np.mean(act(as_float64(learner.policy), as_float64(batch.observation), noise)[1]))
    assert entropies[0] == pytest.approx(float(metrics.entropy), rel=1e-4)
    assert abs(entropies[0] - entropies[1]) > 1e-3
