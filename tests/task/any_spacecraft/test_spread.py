"""What is drawn for every maneuver: bodies that can be, within what the settings say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from koz_jax.config.base import checked
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import TaskConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.errors import SettingsError
from koz_jax.task.any_spacecraft import spread, units
from koz_jax.task.environment import Reorientation, model_from_config

TASK = TaskConfig(spread=SpreadConfig(spacecraft=True, max_rate_deg=(2.0, 20.0), urgency=(0.2, 0.8)))
COUNT = 2000


@pytest.fixture(scope="module")
def drawn() -> Reorientation:
    """Environments of many maneuvers, stacked."""
    env = Reorientation.from_config(TASK)
    return jax.jit(jax.vmap(env.drawn))(jax.random.split(jax.random.key(1), COUNT))


@pytest.mark.slow
def test_every_body_can_be_and_is_no_thinner_than_stated(drawn):
    inertia = np.asarray(drawn.model.inertia_B, np.float64)
    np.testing.assert_allclose(inertia, inertia.transpose(0, 2, 1), atol=1e-3)
    moments = np.linalg.eigvalsh(inertia)
    second = 0.5 * moments.sum(axis=1, keepdims=True) - moments
    assert second.min() > 0.0
    ratio = second.min(axis=1) / second.max(axis=1)
    assert ratio.min() >= 0.05 * (1 - 1e-4) and np.quantile(ratio, 0.1) < 0.2 and ratio.max() > 0.8


def test_trace_and_strength_are_the_tasks(drawn):
    own = jax.vmap(units.of)(drawn.model)
    task = units.of(model_from_config(TASK))
    for name in ("time", "inertia", "torque"):
        np.testing.assert_allclose(getattr(own, name), getattr(task, name), rtol=1e-4, err_msg=name)


def test_torque_limits_steps_rates_and_urgencies_stay_in_their_ranges(drawn):
    limits = np.asarray(drawn.model.actuators.limit_B)
    assert 1.5 < (limits.max(axis=1) / limits.min(axis=1)).max() <= 2.0 * (1 + 1e-5)
    shares = np.asarray(drawn.model.dt) / 30.0**0.5
    rates = np.rad2deg(np.asarray(drawn.model.max_rate))
    for values, low, high in ((shares, 0.009, 0.05), (rates, 2.0, 20.0), (np.asarray(drawn.urgency), 0.2, 0.8)):
        assert low * (1 - 1e-5) <= values.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < values.max() <= high * (1 + 1e-5)
    assert abs(np.median(np.log(rates)) - np.log(40.0) / 2) < 0.1  # even over the logarithm


def test_a_seventh_of_the_maneuvers_is_at_either_end_of_the_urgencies(drawn):
    urgency = np.asarray(drawn.urgency)
    for end in (0.2, 0.8):
        assert abs(np.mean(np.isclose(urgency, end)) - 1.0 / 7.0) < 4.0 * np.sqrt(6.0 / 49.0 / COUNT)
    between = urgency[(urgency > 0.2001) & (urgency < 0.7999)]
    np.testing.assert_allclose(np.quantile(between, (0.25, 0.5, 0.75)), (0.35, 0.5, 0.65), atol=0.03)


def test_instruments_and_principal_axes_point_anywhere(drawn):
    boresights = np.asarray(drawn.ranges.boresight_B)
    np.testing.assert_allclose(np.linalg.norm(boresights, axis=1), 1.0, rtol=1e-5)
    assert np.abs(boresights.mean(axis=0)).max() < 4.0 / np.sqrt(3 * COUNT)
    longest = np.linalg.eigh(np.asarray(drawn.model.inertia_B, np.float64))[1][:, :, 2]
    np.testing.assert_allclose((longest**2).mean(axis=0), 1 / 3, atol=0.03)


@pytest.mark.slow
def test_scenarios_are_for_the_instrument_that_was_drawn():
    env = Reorientation.from_config(TASK).drawn(jax.random.key(4))
    assert jnp.array_equal(env.sample(jax.random.key(2)).constraints.boresight_B[0], env.ranges.boresight_B)


def test_what_is_not_spread_stays():
    only_urgency = Reorientation.from_config(TaskConfig(spread=SpreadConfig(urgency=(1.0, 1.0))))
    found = only_urgency.drawn(jax.random.key(0))
    assert float(found.urgency) == 1.0 and found.model.max_rate is None
    np.testing.assert_array_equal(found.model.inertia_B, only_urgency.model.inertia_B)
    plain = Reorientation.from_config(TaskConfig())
    assert plain.spread is None and plain.drawn(jax.random.key(0)) is plain


def test_ranges_out_of_order_are_refused_by_name():
    for name in ("step_shares", "max_rate_deg", "urgency"):
        with pytest.raises(SettingsError, match=name):
            checked(SpreadConfig, **{name: (0.9, 0.1)})


def test_draws_do_not_depend_on_each_other():
    """The body of a key is the same whether a rate limit is drawn beside it or not."""
    with_rates, without = (
        Reorientation.from_config(TaskConfig(spread=SpreadConfig(spacecraft=True, max_rate_deg=rates)))
        for rates in ((2.0, 20.0), None)
    )
    key = jax.random.key(8)
    np.testing.assert_array_equal(with_rates.drawn(key).model.inertia_B, without.drawn(key).model.inertia_B)
    assert isinstance(spread.from_config(TASK), spread.Spread)


def test_slender_bodies_are_as_slender_as_asked_for():
    """Smallest over largest second moment of mass, from the principal moments."""
    spread = TaskConfig(spread=SpreadConfig(spacecraft=True, slenderness=(0.05, 0.1)))
    env = Reorientation.from_config(spread)
    inertias = jax.jit(jax.vmap(lambda key: env.drawn(key).model.inertia_B))(jax.random.split(jax.random.key(3), 200))
    moments = np.linalg.eigvalsh(np.asarray(inertias, np.float64))
    second = 0.5 * moments.sum(axis=1, keepdims=True) - moments
    shares = second.min(axis=1) / second.max(axis=1)
    assert np.all((shares > 0.0499) & (shares < 0.1001))
    assert np.ptp(shares) > 0.04


@pytest.mark.slow
@pytest.mark.parametrize(("wheels", "count"), [("three", 3), ("pyramid", 4)])
def test_wheels_have_the_strength_of_the_spacecraft_and_a_bias(wheels, count):
    task = TaskConfig(spread=SpreadConfig(spacecraft=True, wheels=wheels, wheel_momentum=(1.0, 4.0)))
    env = Reorientation.from_config(task)
    model = jax.jit(jax.vmap(env.drawn))(jax.random.split(jax.random.key(1), 500)).model
    own, expected = jax.vmap(units.of)(model), units.of(model_from_config(task))
    np.testing.assert_allclose(own.torque, expected.torque, rtol=1e-5)
    found = model.actuators
    assert found.axes_B.shape == (500, count, 3)
    size = np.asarray(found.max_momentum)[:, 0] / float(expected.torque * expected.time)
    assert 1.0 <= size.min() < 1.1 and 3.9 < size.max() <= 4.0
    bias = np.abs(np.asarray(found.momentum) / np.asarray(found.max_momentum))
    assert 0.29 < bias.max() <= 0.3 * (1 + 1e-5)


def test_wheels_without_spacecraft_are_refused():
    with pytest.raises(SettingsError, match="wheels: are drawn with spacecraft = true"):
        checked(SpreadConfig, wheels="three")


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_nominal_maneuvers_have_no_errors_fewest_zones_and_the_largest_rate_limit(share):
    errors = UncertaintyConfig(inertia_error=0.1, rate_noise_deg=0.001, delay_steps=1)
    drawing = SpreadConfig(
        spacecraft=True, zones=(1, 4), max_rate_deg=(2.0, 20.0), errors=errors, delay_steps=(1, 2), nominal=share
    )
    env = Reorientation.from_config(TaskConfig(spread=drawing))
    envs = jax.jit(jax.vmap(env.drawn))(jax.random.split(jax.random.key(2), COUNT))
    nominal = np.asarray(envs.uncertainty.inertia_error) == 0.0
    assert abs(np.mean(nominal) - share) <= 4.0 * np.sqrt(share * (1.0 - share) / COUNT)
    fewest, most = np.asarray(envs.ranges.zone_counts).T
    assert np.all(fewest == 1) and np.all(most == np.where(nominal, 1, 4))
    assert np.all((np.asarray(envs.uncertainty.delay) == 0) == nominal)
    assert np.all((np.asarray(envs.uncertainty.rate_noise) == 0.0) == nominal)
    fastest = np.isclose(np.asarray(envs.model.max_rate), np.deg2rad(20.0), rtol=1e-5)
    assert np.all(fastest[nominal]) and np.sum(fastest[~nominal]) < 0.01 * COUNT
