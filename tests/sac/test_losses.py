"""The three losses and the Bellman target, against NumPy in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from koz_jax.sac import losses
from koz_jax.sac.losses import Batch

COUNT = 40


@pytest.fixture(params=[0, 1, 2])
def numbers(request):
    """Random float32 inputs of every loss."""
    draw = np.random.default_rng(request.param)
    return {
        "q": draw.normal(0.0, 5.0, (2, COUNT)).astype(np.float32),
        "target": draw.normal(0.0, 5.0, COUNT).astype(np.float32),
        "log_prob": draw.normal(0.0, 3.0, COUNT).astype(np.float32),
        "alpha": np.float32(draw.uniform(0.01, 2.0)),
        "reward": draw.normal(0.0, 2.0, COUNT).astype(np.float32),
        "discount": (0.9 * draw.integers(0, 2, COUNT)).astype(np.float32),
    }


def make_batch(reward, discount):
    unused = jnp.zeros((COUNT, 2))
    return Batch(unused, unused, jnp.asarray(reward), jnp.asarray(discount), unused)


def float64(*arrays):
    return tuple(np.asarray(array, np.float64) for array in arrays)


def test_critic_target(numbers):
    n = numbers
    found = losses.critic_target(n["q"], n["log_prob"], n["alpha"], make_batch(n["reward"], n["discount"]))
    q, log_prob, alpha, reward, discount = float64(n["q"], n["log_prob"], n["alpha"], n["reward"], n["discount"])
    expected = [reward[i] + discount[i] * (min(q[0, i], q[1, i]) - alpha * log_prob[i]) for i in range(COUNT)]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(found[n["discount"] == 0.0], n["reward"][n["discount"] == 0.0])


def test_critic_loss_and_its_gradient(numbers):
    q, target = float64(numbers["q"], numbers["target"])
    loss, gradient = jax.value_and_grad(losses.critic_loss)(numbers["q"], numbers["target"])
    expected = sum(0.5 * (q[k, i] - target[i]) ** 2 / COUNT for k in range(2) for i in range(COUNT))
    assert loss == pytest.approx(expected, rel=1e-5)
    np.testing.assert_allclose(gradient, (q - target) / COUNT, rtol=1e-4, atol=1e-5)


def test_critic_loss_does_not_pull_at_its_target(numbers):
    gradient = jax.grad(losses.critic_loss, argnums=1)(numbers["q"], numbers["target"])
    np.testing.assert_array_equal(gradient, 0.0)


def test_actor_loss_and_its_gradient(numbers):
    q, log_prob, alpha = float64(numbers["q"], numbers["log_prob"], numbers["alpha"])
    loss, (for_q, for_log_prob) = jax.value_and_grad(losses.actor_loss, argnums=(0, 1))(
        numbers["q"], numbers["log_prob"], numbers["alpha"]
    )
    expected = sum(alpha * log_prob[i] - min(q[0, i], q[1, i]) for i in range(COUNT)) / COUNT
    assert loss == pytest.approx(expected, rel=1e-4, abs=1e-4)
    np.testing.assert_allclose(for_log_prob, np.full(COUNT, alpha / COUNT), rtol=1e-5)
    np.testing.assert_allclose(for_q, np.where(q == q.min(axis=0), -1.0 / COUNT, 0.0), rtol=1e-6)


@pytest.mark.parametrize("target_entropy", [-3.0, -0.5])
def test_alpha_loss_and_its_gradient(numbers, target_entropy):
    log_alpha = jnp.float32(-1.3)
    loss, (for_log_alpha, for_log_prob) = jax.value_and_grad(losses.alpha_loss, argnums=(0, 1))(
        log_alpha, numbers["log_prob"], target_entropy
    )
    surplus = float64(numbers["log_prob"])[0].mean() + target_entropy
    assert loss == pytest.approx(1.3 * surplus, rel=1e-4, abs=1e-5)
    assert for_log_alpha == pytest.approx(-surplus, rel=1e-4, abs=1e-5)
    np.testing.assert_array_equal(for_log_prob, 0.0)


def test_alpha_grows_exactly_when_the_entropy_is_too_small():
    def slope(entropy):
        return float(jax.grad(losses.alpha_loss)(jnp.float32(0.0), jnp.full(8, -entropy), -3.0))

    assert slope(-4.0) < 0.0 < slope(-2.0)  # descent raises log alpha where the slope is negative
    assert slope(-3.0) == pytest.approx(0.0, abs=1e-6)
