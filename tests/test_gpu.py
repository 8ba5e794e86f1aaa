"""What a GPU computes, beside what the CPU does: ``KOZ_JAX_TEST_PLATFORM=cuda,cpu pytest -m gpu``.

Tolerances are those of float32 and of another order of sums.  TF32, which is what a GPU takes for products of matrices
unless it is told otherwise, would miss them by far.
"""

import jax
import numpy as np
import pytest
from support import tiny

from koz_jax import devices
from koz_jax.agents.agent import load_agent
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.evaluation import cases
from koz_jax.evaluation.monte_carlo import monte_carlo
from koz_jax.learning import refinement, train_step
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.trainer import train

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not devices.on_gpu(), reason="there is no GPU")]

AGENT = load_agent("phase2")


def test_actions_are_those_of_numpy_in_float32():
    observed = np.random.default_rng(0).normal(size=(1000, 16)).astype(np.float32)
    np.testing.assert_allclose(AGENT.predict(observed), AGENT.to_numpy().predict(observed), atol=2e-5)


def test_a_case_flies_alone_as_in_a_chunk():
    config = MonteCarloConfig(cases=300, seed=5)
    together = cases.fly_cases(AGENT.controller, AGENT.task, config)
    alone = cases.fly_cases(AGENT.controller, AGENT.task, config.model_copy(update={"cases": 1, "first": 123}))
    np.testing.assert_array_equal(alone.settled[0], together.settled[123])
    np.testing.assert_allclose(alone.control_effort[0], together.control_effort[123], rtol=1e-3)
    np.testing.assert_allclose(alone.settling_time[0], together.settling_time[123], atol=0.1 + 1e-3)


def test_the_table_is_that_of_the_cpu():
    flown = {}
    for platform in ("cpu", "gpu"):
        with jax.default_device(jax.local_devices(backend=platform)[0]):
            flown[platform] = _flown()
    np.testing.assert_array_equal(flown["gpu"].violated, flown["cpu"].violated)
    np.testing.assert_array_equal(flown["gpu"].settled, flown["cpu"].settled)
    np.testing.assert_allclose(flown["gpu"].control_effort, flown["cpu"].control_effort, rtol=5e-3)


def _flown():
    """Fly some cases one after the other, on the device that is the default."""
    config = MonteCarloConfig(cases=20, seed=3)
    flown = [cases.fly_case(AGENT, case, config)[1] for case in range(20)]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get(flown))


def test_many_cases_succeed():
    results = monte_carlo(AGENT, 20_000, seed=1).results
    assert results.success.mean() > 0.999


def test_a_run_that_goes_on_equals_the_undisturbed_one(tmp_path):
    whole, stopped = RunFolder(tmp_path / "whole"), RunFolder(tmp_path / "stopped")
    first = train(tiny.CONFIG, whole.path, progress=False)
    again = train(tiny.CONFIG, stopped.path, progress=False)
    stopped.checkpoints()[0].rename(tmp_path / "lost")  # the last one
    resumed = train(tiny.CONFIG, stopped.path, resume=True, progress=False)
    assert first is not None and again is not None and resumed is not None
    for one, two in zip(jax.tree.leaves(first.controller), jax.tree.leaves(resumed.controller), strict=True):
        np.testing.assert_array_equal(one, two)


def test_refinement_takes_the_steps_of_the_cpu():
    config = tiny.changed({"refine": {"max_maneuver_gradient": 0.1}})
    policy = train_step.init(config, jax.random.key(0)).learner.policy
    changes = {}
    for platform in ("cpu", "gpu"):
        with jax.default_device(jax.local_devices(backend=platform)[0]):
            there = jax.device_put(policy, jax.local_devices(backend=platform)[0])
            refined, _ = refinement.refine_chunk(config, refinement.init(config, there), np.int32(1))
            changes[platform] = jax.device_get(refined.policy)
    for one, two in zip(*map(jax.tree.leaves, changes.values()), strict=True):
        np.testing.assert_allclose(one, two, atol=2e-4)
