"""Laws of the policy's distribution, the input encoding and the networks."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from koz_jax.sac.networks import DIAL_FEATURES, Critics, Policy, SquashedGaussian, dial_features, encode


def log_prob_float64(mean, log_std, noise):
    """Change of variables in float64: log N(noise) - log std - log(1 - tanh(raw)^2), summed over the actions."""
    mean, log_std, noise = (np.asarray(x, np.float64) for x in (mean, log_std, noise))
    raw = mean + np.exp(log_std) * noise
    log_slope = -2.0 * (np.logaddexp(raw, -raw) - np.log(2.0))  # 1 - tanh^2 = 1 / cosh^2
    return np.sum(stats.norm.logpdf(noise) - log_std - log_slope, axis=-1)


@pytest.mark.parametrize(("mean", "log_std"), [(0.0, 0.0), (0.7, -1.0), (-1.5, -0.5), (0.0, -3.0)])
def test_density_integrates_to_one_and_is_the_samples_own(mean, log_std):
    count = 50_000
    distribution = SquashedGaussian(jnp.full((count, 1), mean), jnp.full((count, 1), log_std))
    action, log_prob = distribution.sample(jax.random.key(3))
    order = np.argsort(action[:, 0])
    x = np.asarray(action[:, 0], np.float64)[order]
    density = np.exp(np.asarray(log_prob, np.float64))[order]
    assert x[0] > -1.0 and x[-1] < 1.0

    cumulative = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(x))])
    assert cumulative[-1] == pytest.approx(1.0, abs=2e-3)
    empirical = np.arange(count) / count
    # Kolmogorov-Smirnov: 1.95 / sqrt(n) is exceeded once in a thousand draws.
    assert np.max(np.abs(cumulative - empirical)) < 1.95 / np.sqrt(count) + 2e-3


def test_log_prob_is_the_change_of_variables():
    key_mean, key_std, key_sample = jax.random.split(jax.random.key(0), 3)
    mean = 3.0 * jax.random.normal(key_mean, (500, 3))
    log_std = jax.random.uniform(key_std, (500, 3), minval=-4.0, maxval=2.0)
    action, log_prob = SquashedGaussian(mean, log_std).sample(key_sample)
    noise = jax.random.normal(key_sample, (500, 3))
    assert log_prob.shape == (500,)
    np.testing.assert_allclose(log_prob, log_prob_float64(mean, log_std, noise), rtol=1e-5, atol=1e-4)
    expected = np.tanh(np.asarray(mean, np.float64) + np.exp(np.asarray(log_std, np.float64)) * np.asarray(noise))
    np.testing.assert_allclose(action, expected, atol=1e-6)


@jax.jit
def _sampled(mean, log_std, key):
    """A sample, and the gradient of its logarithmic density in the mean."""

    def log_density(mean):
        action, log_prob = SquashedGaussian(mean, log_std).sample(key)
        return jnp.sum(log_prob), (action, log_prob)

    slope, (action, log_prob) = jax.grad(log_density, has_aux=True)(mean)
    return action, log_prob, slope


@pytest.mark.parametrize("raw", [-80.0, -15.0, 15.0, 80.0])
def test_log_prob_and_its_gradient_where_the_action_saturates(raw):
    key = jax.random.key(5)
    log_std = jnp.full((4, 3), -6.0)
    mean = jnp.full((4, 3), raw)
    action, log_prob, slope = _sampled(mean, log_std, key)
    # In float32 the action itself has lost all of raw.
    np.testing.assert_allclose(np.abs(action), 1.0, rtol=0, atol=2.5e-7)
    expected = log_prob_float64(mean, log_std, jax.random.normal(key, (4, 3)))
    np.testing.assert_allclose(log_prob, expected, rtol=1e-5)
    # d/draw of -log(1 - tanh(raw)^2) is 2 tanh(raw).
    np.testing.assert_allclose(slope, 2.0 * np.sign(raw), rtol=1e-5)


def test_mode_is_tanh_of_the_mean_whatever_the_deviation():
    mean = jnp.linspace(-3.0, 3.0, 7)
    for log_std in (-20.0, 0.0, 2.0):
        np.testing.assert_allclose(SquashedGaussian(mean, jnp.full(7, log_std)).mode(), np.tanh(mean), rtol=1e-6)


def test_sample_is_reproducible_and_differs_between_keys():
    distribution = SquashedGaussian(jnp.zeros(3), jnp.zeros(3))
    one, again, other = (distribution.sample(jax.random.key(seed))[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert not np.any(np.asarray(one) == np.asarray(other))


def test_encode_appends_finer_views_of_the_named_slices():
    observation = jax.random.normal(jax.random.key(0), (5, 6))
    encoded = encode(observation, ((1, 3, 0.01), (1, 3, 0.5), (5, 6, 2.0)))
    x = np.asarray(observation, np.float64)
    expected = np.concatenate([x, np.tanh(x[:, 1:3] / 0.01), np.tanh(x[:, 1:3] / 0.5), np.tanh(x[:, 5:6] / 2.0)], 1)
    np.testing.assert_allclose(encoded, expected, atol=1e-6)
    np.testing.assert_array_equal(encoded[:, :6], observation)
    np.testing.assert_array_equal(encode(observation, ()), observation)


@pytest.fixture(scope="module")
def policy():
    network = Policy(hidden_sizes=(64, 48), encoding=((0, 2, 0.1),), action_size=3)
    return network, jax.jit(network.init)(jax.random.key(0), jnp.zeros(4))


@pytest.fixture(scope="module")
def critic():
    network = Critics(hidden_sizes=(64, 48), encoding=((0, 2, 0.1),))
    return network, jax.jit(network.init)(jax.random.key(1), jnp.zeros(4), jnp.zeros(3))


def kernels(params):
    return [leaf for path, leaf in jax.tree.leaves_with_path(params) if "kernel" in jax.tree_util.keystr(path)]


@pytest.mark.slow
def test_initial_parameters_are_bounded_as_in_torch_linear(policy, critic):
    for _, params in (policy, critic):
        for path, layer in jax.tree.leaves_with_path(params, is_leaf=lambda node: "kernel" in node):
            bound = 1.0 / np.sqrt(layer["kernel"].shape[0])
            assert np.all(np.abs(layer["kernel"]) <= bound), path
            assert np.all(np.abs(layer["bias"]) <= bound), path
        for kernel in kernels(params):
            # Uniform over the whole interval: nearly reaches the bound, variance bound^2 / 3.
            bound = 1.0 / np.sqrt(kernel.shape[0])
            if kernel.size > 300:
                assert np.max(np.abs(kernel)) > 0.97 * bound
                assert np.var(kernel) == pytest.approx(bound**2 / 3.0, rel=0.15)


def test_networks_have_the_layers_asked_for(policy, critic):
    # Inputs: 4 observed + 2 encoded (+ 3 actions); two outputs per action; two critics.
    assert sorted(k.shape for k in kernels(policy[1])) == sorted([(6, 64), (64, 48), (48, 6)])
    assert sorted(k.shape for k in kernels(critic[1])) == sorted(2 * [(9, 64), (64, 48), (48, 1)])


def test_policy_is_pointwise_in_the_batch(policy):
    network, params = policy
    observations = jax.random.normal(jax.random.key(2), (7, 4))
    together = network.apply(params, observations)
    one_by_one = jax.lax.map(lambda x: network.apply(params, x), observations)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), together, one_by_one)
    assert together.mean.shape == together.log_std.shape == (7, 3)


def test_policy_bounds_its_deviation(policy):
    network, params = policy
    observations = 1e4 * jax.random.normal(jax.random.key(2), (200, 4))
    log_std = network.apply(params, observations).log_std
    assert np.min(log_std) == -20.0 and np.max(log_std) == 2.0


def test_twin_critics_start_different(critic):
    network, params = critic
    first, second = network.apply(params, jax.random.normal(jax.random.key(3), (50, 4)), jnp.zeros((50, 3)))
    assert np.min(np.abs(first - second)) > 0.0
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.99
    one, other = params["params"].values()
    for first_kernel, second_kernel in zip(kernels(one), kernels(other), strict=True):
        assert not np.any(first_kernel == second_kernel)


def test_gradient_of_one_critic_does_not_touch_the_other(critic):
    network, params = critic
    observations, actions = jax.random.normal(jax.random.key(3), (50, 4)), jnp.zeros((50, 3))
    sums = jax.jit(jax.jacobian(lambda p: jnp.sum(network.apply(p, observations, actions), axis=1)))(params)
    touched = np.array(
        [
            [any(np.any(leaf[i] != 0.0) for leaf in jax.tree.leaves(net)) for net in sums["params"].values()]
            for i in (0, 1)
        ]
    )
    assert touched.sum(axis=0).tolist() == touched.sum(axis=1).tolist() == [1, 1]


def test_critic_sees_observation_and_action(critic):
    network, params = critic
    gradient = jax.jit(jax.jacobian(network.apply, argnums=(1, 2)))(params, jnp.ones(4), 0.5 * jnp.ones(3))
    for part in gradient:
        assert np.all(np.abs(part) > 0.0)


DIALS = ((3, -1.0, 1.0),)


def test_dials_modulate_every_layer_and_begin_as_none():
    """Weights of gains are zero at first: the layers then are those of a network that sees the features beside."""
    policy = Policy((8, 8), (), 2, DIALS)
    observed = jax.random.normal(jax.random.key(1), (5, 4))
    params: Any = jax.jit(policy.init)(jax.random.key(0), observed)
    layers = params["params"]["Mlp_0"]
    gains = {name: np.asarray(layer["kernel"]) for name, layer in layers.items() if name.startswith("Gain")}
    assert set(gains) == {"Gain_0", "Gain_1"} and not any(gain.any() for gain in gains.values())

    @jax.jit
    def mean(opened: Any) -> jax.Array:
        found: Any = policy.apply(opened, observed)
        return found.mean

    opened = jax.tree_util.tree_map_with_path(lambda path, leaf: leaf + 0.3 if "Gain" in str(path) else leaf, params)
    assert not np.allclose(mean(params), mean(opened))


def test_features_of_a_dial_are_bells_over_its_range():
    observed = jnp.array([[0.0, 0.0, 0.0, -1.0], [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    features = np.asarray(dial_features(observed, DIALS))
    assert features.shape == (3, DIAL_FEATURES)
    np.testing.assert_array_equal(features.argmax(axis=1), [0, 2, 4])
    np.testing.assert_allclose(features.max(axis=1), 1.0)
    np.testing.assert_allclose(features[0, 1], np.exp(-0.5), rtol=1e-6)
    assert dial_features(observed, ()).shape == (3, 0)
