"""The comparison with other libraries flies their policies, not something like them."""

import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stable_baselines3
from support.tiny import ROOT

from koz_jax.adapters.sb3_env import ReorientationVecEnv
from koz_jax.task import observation_layout

SEEN = np.random.default_rng(0).normal(size=(50, observation_layout.SIZE)).astype(np.float32)


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    return importlib.import_module


def acts(controller):
    return np.asarray(jax.jit(jax.vmap(controller.act))(SEEN))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["SAC", "TD3", "DDPG"])
def test_a_policy_of_stable_baselines_acts_as_it_predicts(benchmark, name):
    settings: Any = {"policy_kwargs": {"net_arch": [32, 24]}, "buffer_size": 10, "device": "cpu"}
    model = getattr(stable_baselines3, name)("MlpPolicy", ReorientationVecEnv(2), seed=3, **settings)
    expected, _ = model.predict(SEEN, deterministic=True)
    np.testing.assert_allclose(acts(benchmark("peer_runs")._torch_policy(model)), expected, rtol=1e-4, atol=1e-5)
    assert np.ptp(expected, axis=0).min() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_a_policy_of_brax_acts_as_its_inference_does(benchmark, algorithm):
    brax_training = benchmark("brax_training")
    networks = importlib.import_module(f"brax.training.agents.{algorithm}.networks")
    statistics = importlib.import_module("brax.training.acme.running_statistics")
    make = getattr(networks, f"make_{algorithm}_networks")
    network = make(observation_layout.SIZE, 3, preprocess_observations_fn=statistics.normalize)
    normalizer = statistics.init_state(jax.ShapeDtypeStruct((observation_layout.SIZE,), jnp.float32))
    normalizer = statistics.update(normalizer, jnp.array(3.0 * SEEN + 1.0))
    policy = network.policy_network.init(jax.random.PRNGKey(2))
    infer = networks.make_inference_fn(network)((normalizer, policy), deterministic=True)
    expected, _ = infer(jnp.array(SEEN), jax.random.PRNGKey(0))
    activation = jax.nn.swish if algorithm == "ppo" else jax.nn.relu
    controller = brax_training.controller(normalizer, policy, activation)
    np.testing.assert_allclose(acts(controller), expected, rtol=1e-4, atol=1e-5)
    assert np.ptp(np.asarray(expected), axis=0).min() > 1e-3


def test_what_brax_asks_of_jax_is_lent_and_taken_back(benchmark):
    had = hasattr(jax, "device_put_replicated")
    with benchmark("brax_training").replication():
        lent: Any = jax.device_put_replicated  # pyright: ignore[reportAttributeAccessIssue]
        replicated = lent({"a": jnp.arange(3), "b": 2}, jax.local_devices()[:1])
    assert hasattr(jax, "device_put_replicated") == had
    np.testing.assert_array_equal(replicated["a"], [[0, 1, 2]])
    np.testing.assert_array_equal(replicated["b"], [2])


def test_the_update_rate_is_that_of_the_best_stretch_between_two_evaluations(benchmark):
    record = benchmark("peer_record")

    def point(seconds, updates):
        return record.Point(seconds=seconds, env_steps=1, updates=updates, success_rate=0.0, mean_reward=0.0)

    # What comes before the first evaluation that shows updates holds the compilation too.
    assert record.rate([point(1, 0), point(2, 1000), point(12, 1300), point(17, 1500), point(37, 1600)]) == 40.0
    assert record.rate([point(10, 0), point(20, 100)]) is None
