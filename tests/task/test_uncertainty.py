import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import oracle

from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.task import scenario, uncertainty
from koz_jax.task.environment import Reorientation
from koz_jax.task.state import EnvState, Truth
from koz_jax.task.uncertainty import Uncertainty

CONFIG = UncertaintyConfig(inertia_error=0.1, disturbance_torque=0.05, attitude_noise_deg=0.5, rate_noise_deg=0.2)
KEYS = jax.random.split(jax.random.key(0), 2000)


@pytest.fixture(scope="module")
def errors() -> Uncertainty:
    return uncertainty.from_config(CONFIG)


@pytest.fixture(scope="module")
def truths(errors, env) -> Truth:
    """A truth for each key, leaves (keys, ...)."""
    return jax.jit(jax.vmap(lambda key: uncertainty.sample_truth(errors, env.model, key)))(KEYS)


@jax.jit
def step(env: Reorientation, state: EnvState, action: jax.Array) -> EnvState:
    return env.step(state, action, truth=env.sample_truth(KEYS[0])).state


def test_the_true_inertia_is_off_by_the_whole_bound_about_some_axis(truths):
    root = np.linalg.inv(np.linalg.cholesky(oracle.INERTIA))
    for inertia in np.asarray(truths.inertia_B[:50], np.float64):
        relative = np.linalg.eigvalsh(root @ inertia @ root.T) - 1.0
        assert np.max(np.abs(relative)) == pytest.approx(0.1, rel=1e-3)
        np.testing.assert_allclose(inertia, inertia.T, atol=1e-4)


def test_the_disturbance_has_its_norm_and_any_direction(truths):
    disturbance = np.asarray(truths.disturbance_B)
    np.testing.assert_allclose(np.linalg.norm(disturbance, axis=1), 0.05, rtol=1e-5)
    # The mean of 2,000 random directions is 0.58 / sqrt(2000) per axis.
    assert np.max(np.abs(disturbance.mean(axis=0))) < 0.05 * 4 * 0.58 / np.sqrt(2000)


@pytest.mark.slow
def test_noise_has_its_size_and_its_bound_and_spares_the_rest(errors, env):
    state = env.reset(scenario.paper_test())
    seen = jax.jit(jax.vmap(lambda key: uncertainty.add_sensor_errors(errors, state, key)))(KEYS)
    turned = (oracle.rotation(state.body.q_BN).inv() * oracle.rotation(seen.body.q_BN)).as_rotvec(degrees=True)
    rate = np.rad2deg(np.asarray(seen.body.omega_BN_B) - np.asarray(state.body.omega_BN_B))
    for noise, deviation in ((turned, 0.5), (rate, 0.2)):
        assert np.max(np.abs(noise)) <= 3.0 * deviation * 1.001
        # Cut at 3 standard deviations, a normal distribution has 0.987 of its standard deviation left.
        np.testing.assert_allclose(noise.std(axis=0), 0.987 * deviation, rtol=0.08)
        assert np.max(np.abs(noise.mean(axis=0))) < 4 * deviation / np.sqrt(len(KEYS))
    np.testing.assert_array_equal(seen.angle, jnp.full(len(KEYS), state.angle))
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(a[0], b), seen.scenario.constraints, state.scenario.constraints
    )


@pytest.mark.slow
def test_an_environment_flies_its_uncertainty_and_measures_anew_at_every_step(errors, env):
    """A maneuver's truth is that of its key, and its noise that of its key and step."""
    uncertain = env.replace(uncertainty=errors)
    key, other = jax.random.split(jax.random.key(0))
    jax.tree.map(
        np.testing.assert_array_equal,
        uncertain.sample_truth(key),
        uncertainty.sample_truth(errors, env.model, key),
    )
    state = env.reset(scenario.paper_test())
    later = state.replace(steps=state.steps + 1)
    first, again, next_step, elsewhere = (
        np.asarray(uncertain.measure(at, noise).body.omega_BN_B)
        for at, noise in ((state, key), (state, key), (later, key), (state, other))
    )
    np.testing.assert_array_equal(first, again)
    assert len({tuple(first), tuple(next_step), tuple(elsewhere), tuple(np.asarray(state.body.omega_BN_B))}) == 4


def test_a_bias_has_its_norm_stays_for_the_maneuver_and_is_another_in_the_next(env):
    biased = env.replace(
        uncertainty=uncertainty.from_config(UncertaintyConfig(attitude_bias_deg=0.5, rate_bias_deg=0.2))
    )
    state = env.reset(scenario.paper_test())

    def errors_of(at, key):
        seen = biased.measure(at, key)
        turn = (oracle.rotation(at.body.q_BN).inv() * oracle.rotation(seen.body.q_BN)).as_rotvec(degrees=True)
        return turn, np.rad2deg(np.asarray(seen.body.omega_BN_B) - np.asarray(at.body.omega_BN_B))

    first, later = (errors_of(state.replace(steps=jnp.int32(step)), KEYS[0]) for step in (0, 7))
    other = errors_of(state, KEYS[1])
    for one, same, another, norm in zip(first, later, other, (0.5, 0.2), strict=True):
        np.testing.assert_allclose(one, same, rtol=1e-3, atol=1e-4)
        assert np.linalg.norm(one) == pytest.approx(norm, rel=1e-3)
        assert np.linalg.norm(one - another) > 0.01 * norm


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_late_torque_is_that_of_an_earlier_step(env, delay):
    """Every command comes ``delay`` steps late, and before the first arrives there is none."""
    late = env.replace(uncertainty=uncertainty.from_config(UncertaintyConfig()).replace(delay=jnp.int32(delay)))
    actions = jax.random.uniform(jax.random.key(1), (8, 3), minval=-1.0, maxval=1.0)
    state, torques = late.reset(scenario.paper_test()), []
    for action in actions:
        state = step(late, state, action)
        torques.append(np.asarray(state.torque_B))
    expected = np.concatenate([np.zeros((delay, 3)), 2.0 * np.asarray(actions)])[: len(actions)]
    np.testing.assert_allclose(torques, expected, rtol=1e-6)
