import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest

from koz_jax import env, scenario, uncertainty
from koz_jax.shield_config import UncertaintyConfig
from koz_jax.uncertainty import Uncertainty

CONFIG = UncertaintyConfig(inertia_error=0.1, disturbance_torque=0.05, attitude_noise_deg=0.5, rate_noise_deg=0.2)
KEYS = jax.random.split(jax.random.key(0), 2000)


@pytest.fixture(scope="module")
def errors() -> Uncertainty:
    return uncertainty.from_config(CONFIG)


def test_the_true_inertia_is_off_by_the_whole_bound_about_some_axis(errors, params):
    truth = jax.vmap(lambda key: uncertainty.draw_truth(errors, params, key))(KEYS[:50])
    root = np.linalg.inv(np.linalg.cholesky(oracle.INERTIA))
    for inertia in np.asarray(truth.spacecraft.inertia_B, np.float64):
        relative = np.linalg.eigvalsh(root @ inertia @ root.T) - 1.0
        assert np.max(np.abs(relative)) == pytest.approx(0.1, rel=1e-3)
        np.testing.assert_allclose(inertia, inertia.T, atol=1e-4)


def test_the_disturbance_has_its_norm_and_any_direction(errors, params):
    truth = jax.vmap(lambda key: uncertainty.draw_truth(errors, params, key))(KEYS)
    disturbance = np.asarray(truth.disturbance_B)
    np.testing.assert_allclose(np.linalg.norm(disturbance, axis=1), 0.05, rtol=1e-5)
    # The mean of 2,000 random directions is 0.58 / sqrt(2000) per axis.
    assert np.max(np.abs(disturbance.mean(axis=0))) < 0.05 * 4 * 0.58 / np.sqrt(2000)


def test_noise_has_its_size_and_its_bound_and_spares_the_rest(errors):
    state = env.reset(scenario.paper_test())
    seen = jax.vmap(lambda key: uncertainty.measure(errors, state, key))(KEYS)
    turned = (oracle.rotation(state.body.q_BN).inv() * oracle.rotation(seen.body.q_BN)).as_rotvec(degrees=True)
    rate = np.rad2deg(np.asarray(seen.body.omega_BN_B) - np.asarray(state.body.omega_BN_B))
    for noise, deviation in ((turned, 0.5), (rate, 0.2)):
        assert np.max(np.abs(noise)) <= 3.0 * deviation * 1.001
        # Cut at 3 standard deviations, a normal distribution has 0.987 of its standard deviation left.
        np.testing.assert_allclose(noise.std(axis=0), 0.987 * deviation, rtol=0.08)
        assert np.max(np.abs(noise.mean(axis=0))) < 4 * deviation / np.sqrt(len(KEYS))
    np.testing.assert_array_equal(seen.angle, jnp.full(len(KEYS), state.angle))
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[0], b), seen.scenario.zones, state.scenario.zones)
