"""The published feedback on the logarithmic barrier potential, against the potential in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import log_barrier
from support.log_barrier import YANG
from support.states import directions, state_of

from koz_jax.control.published.lee_mesbahi import LeeMesbahiBackstepping, LeeMesbahiPD
from koz_jax.control.published.log_barrier import LogBarrierPotential
from koz_jax.task.any_spacecraft import units
from koz_jax.task.pointing_constraints import keep_in

INERTIA_B = np.asarray(YANG.inertia_B, float)

# A low barrier, so that few torques are cut.
LOW = 0.1


@pytest.mark.slow
def test_slope_is_that_of_the_potential():
    at = log_barrier.several_instruments()
    found = jax.jit(jax.vmap(LogBarrierPotential(0.3, 0.7).slope))(at.body.q_BN, at.scenario)
    checked = 0
    for slope_B, one in zip(np.asarray(found), log_barrier.one_by_one(at), strict=True):
        q = np.asarray(one.body.q_BN, float)
        if log_barrier.is_clear(q, one.scenario):
            expected = log_barrier.slope(q, one.scenario, 0.3, 0.7)
            np.testing.assert_allclose(slope_B, expected, rtol=1e-3, atol=1e-4)
            checked += 1
    assert checked > 32


@pytest.mark.slow
def test_room_in_a_mandatory_zone_is_that_of_the_paper():
    """(r . n - cos(theta_M)) / 2, though the zone is kept as one to stay out of."""
    look_B, axis_N, upright = jnp.array([0.0, 0.6, 0.8]), jnp.array([0.6, 0.0, 0.8]), jnp.eye(4)[0]
    zone = jax.tree.map(lambda leaf: leaf[None], keep_in(look_B, axis_N, jnp.float32(1.2)))
    at = state_of(upright, jnp.zeros(3), jnp.eye(4)[1], zone.axis_N, zone.half_angle)
    found = LogBarrierPotential(0.0, 1.4).value(upright, at.scenario.replace(constraints=zone))
    np.testing.assert_allclose(found, 2.0 * -1.4 * np.log(0.5 * (0.64 - np.cos(1.2))), rtol=1e-5)


def test_gains_are_the_published_ones_on_the_published_spacecraft():
    unit, gains = units.of(YANG), LeeMesbahiBackstepping()
    found = [gains.stiffness * unit.torque, gains.damping * unit.torque * unit.time, gains.rate / unit.time]
    np.testing.assert_allclose(found, [1.0, 20.0, 1.0 / 20.0], rtol=1e-6)
    assert (LeeMesbahiPD().damping, LeeMesbahiPD().stiffness) == (gains.damping, gains.stiffness)


def test_energy_and_potential_together_fall_as_damping_takes():
    def lyapunov(q, w, scenario):
        return log_barrier.value(q, scenario, 0.0, LOW) + 0.5 * w @ INERTIA_B @ w, -20.0 * w @ w

    log_barrier.check_rates(LeeMesbahiPD(barrier=LOW), YANG, lyapunov)


@pytest.mark.slow
def test_backstepping_makes_its_function_fall_as_designed():
    def lyapunov(q, w, scenario):
        slope_B = log_barrier.slope(q, scenario, 0.0, LOW)
        z_B = w + slope_B / 20.0
        value = log_barrier.value(q, scenario, 0.0, LOW) + 0.5 * z_B @ INERTIA_B @ z_B
        return value, -slope_B @ slope_B / 40.0 - 20.0 * z_B @ z_B

    log_barrier.check_rates(LeeMesbahiBackstepping(barrier=LOW), YANG, lyapunov)


@pytest.mark.parametrize("kind", [LeeMesbahiPD, LeeMesbahiBackstepping])
def test_turning_the_inertial_frame_changes_nothing(kind):
    log_barrier.check_another_frame(kind(barrier=LOW), YANG)


@pytest.mark.parametrize("kind", [LeeMesbahiPD, LeeMesbahiBackstepping])
def test_the_published_maneuver_ends_on_the_target_past_all_zones(kind):
    angles_deg, margin_deg, _ = log_barrier.fly_published(kind())
    assert np.all(angles_deg[800:] < 0.25)
    assert margin_deg > 0.0


def test_a_single_zone_makes_a_minimum_where_the_instrument_looks_away_from_it():
    """There -log(room) is next to nothing, and multiplies all: V is higher everywhere around, and nowhere zero."""
    beside_N, upright = jnp.array([[0.0, 1.0, 0.0]]), jnp.eye(4)[0]
    at = state_of(upright, jnp.zeros(3), upright, beside_N, jnp.array([0.35]))
    away = log_barrier.turned(np.asarray(upright, float), np.array([0.0, 0.0, -0.5 * np.pi]))
    around = 0.7 * np.asarray(directions(200, 5), float)
    found = [log_barrier.value(log_barrier.turned(away, way), at.scenario, 0.0, 1.4) for way in around]
    assert min(found) > log_barrier.value(away, at.scenario, 0.0, 1.4) > 0.0
