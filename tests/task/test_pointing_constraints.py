import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import oracle

from koz_jax.task import pointing_constraints
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE
from koz_jax.task.pointing_constraints import PointingConstraint

angle_to_axis = jax.jit(pointing_constraints.angle_to_axis)
margin = jax.jit(pointing_constraints.margin)
margins = jax.jit(pointing_constraints.margins)
smallest_margin = jax.jit(pointing_constraints.smallest_margin)

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0], np.float32)


def _cone(looks: np.ndarray, axis: np.ndarray, half_angle: float) -> PointingConstraint:
    """A cone for an instrument that looks somewhere while the body is upright."""
    looks_B, axis_N = jnp.array(looks, jnp.float32), jnp.array(axis, jnp.float32)
    return pointing_constraints.keep_out(looks_B, axis_N, jnp.float32(half_angle))


def _stack(looks: np.ndarray, axes: np.ndarray, half_angles: np.ndarray) -> PointingConstraint:
    """Several cones for one instrument (3,), or one for each instrument (n, 3)."""
    looks_B = jnp.broadcast_to(jnp.array(looks, jnp.float32), axes.shape)
    return PointingConstraint(looks_B, jnp.array(axes, jnp.float32), jnp.array(half_angles, jnp.float32))


def _directions(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([oracle.random_direction(rng) for _ in range(count)]).astype(np.float32)


def _attitudes(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([oracle.random_attitude(rng) for _ in range(count)]).astype(np.float32)


@pytest.mark.parametrize("half_angle_deg", [15.0, 30.0, 89.0, 91.0, 150.0])
def test_margin_is_positive_outside_and_negative_inside_the_cone(half_angle_deg):
    half_angle = np.deg2rad(half_angle_deg)
    axis = np.array([0.0, 0.6, 0.8])
    across = np.array([1.0, 0.0, 0.0])
    for offset in np.deg2rad([0.001, 0.1, 10.0]):
        for sign in (-1.0, 1.0):
            theta = half_angle + sign * offset
            direction = np.cos(theta) * axis + np.sin(theta) * across
            np.testing.assert_allclose(margin(UPRIGHT, _cone(direction, axis, half_angle)), sign * offset, atol=1e-6)


def test_margin_is_minus_the_half_angle_on_the_axis_and_largest_opposite_to_it():
    axis = np.array([0.0, 0.6, 0.8], np.float32)
    assert margin(UPRIGHT, _cone(axis, axis, 0.4)) == -np.float32(0.4)
    np.testing.assert_allclose(margin(UPRIGHT, _cone(-axis, axis, 0.4)), np.pi - 0.4, rtol=1e-6)


def test_margin_is_the_angle_to_the_axis_less_the_half_angle():
    for q, look, axis in zip(_attitudes(30), _directions(30, 0), _directions(30, 1), strict=True):
        cone = _cone(look, axis, 0.3)
        theta = angle_to_axis(q, cone)
        np.testing.assert_allclose(theta, oracle.angle_between(oracle.rotation(q).apply(look), axis), atol=1e-6)
        np.testing.assert_allclose(margin(q, cone), theta - 0.3, atol=1e-6)


def test_margin_outside_means_what_equation_5_of_the_paper_means():
    """r . n - cos(theta_F) < 0 exactly where theta_margin > 0."""
    axis = np.array([0.0, 0.6, 0.8], np.float32)
    for direction in _directions(200):
        outside = direction @ axis - np.cos(0.9) < 0
        assert bool(margin(UPRIGHT, _cone(direction, axis, 0.9)) > 0) == outside


def test_where_an_instrument_looks_and_where_a_cone_is_seen_are_the_same_rotation():
    for q, look, axis in zip(_attitudes(20), _directions(20, 2), _directions(20, 3), strict=True):
        cone = _cone(look, axis, 0.3)
        turn = oracle.rotation(q)
        np.testing.assert_allclose(pointing_constraints.boresight_N(q, cone), turn.apply(look), atol=1e-6)
        np.testing.assert_allclose(pointing_constraints.axis_B(q, cone), turn.inv().apply(axis), atol=1e-6)


def test_margin_to_several_zones_is_that_to_the_nearest():
    axes = _directions(4, 2)
    half_angles = np.array([0.2, 0.5, 0.4, 0.3], np.float32)
    nearest = set()
    for direction in _directions(100, 3):
        each = oracle.angle_between(direction, axes) - half_angles
        nearest.add(int(np.argmin(each)))
        np.testing.assert_allclose(
            smallest_margin(UPRIGHT, _stack(direction, axes, half_angles)), each.min(), atol=1e-6
        )
    assert nearest == {0, 1, 2, 3}


def test_margins_of_two_instruments_in_one_stack_are_those_of_each_pair():
    """A star tracker and a telescope, each with its own cone: neither sees the other's."""
    looks, axes, half_angles = _directions(2, 8), _directions(2, 9), np.array([0.4, 0.9], np.float32)
    stack = _stack(looks, axes, half_angles)
    assert stack.count == 2
    nearest = set()
    for q in _attitudes(50, 10):
        found = margins(q, stack)
        turned = oracle.rotation(q).apply(looks)
        np.testing.assert_allclose(found, oracle.angle_between(turned, axes) - half_angles, atol=1e-6)
        np.testing.assert_allclose(found, oracle.margins(q, looks, axes, half_angles), atol=1e-6)
        pairs = [margin(q, _cone(looks[i], axes[i], half_angles[i])) for i in range(2)]
        np.testing.assert_allclose(found, pairs, atol=1e-6)
        np.testing.assert_allclose(smallest_margin(q, stack), jnp.min(found), atol=1e-6)
        nearest.add(int(np.argmin(found)))
    assert nearest == {0, 1}


def test_a_further_zone_never_makes_the_margin_larger():
    axes, half_angles = _directions(3, 4), np.array([0.2, 0.3, 0.4])
    for direction in _directions(50, 5):
        found = [float(smallest_margin(UPRIGHT, _stack(direction, axes[:n], half_angles[:n]))) for n in (1, 2, 3)]
        assert found == sorted(found, reverse=True)


def test_an_absent_zone_is_never_violated():
    axis = np.array([0.0, 0.6, 0.8], np.float32)
    for direction in [axis, -axis, *_directions(50)]:
        assert margin(UPRIGHT, _cone(direction, axis, ABSENT_HALF_ANGLE)) >= np.float32(np.pi)
    filling = pointing_constraints.absent(3, jnp.array([0.0, 0.0, 1.0]))
    assert filling.count == 3
    assert not np.any(filling.is_present)
    for q in _attitudes(20):
        assert np.all(margins(q, filling) >= np.float32(np.pi))


def test_an_absent_zone_leaves_the_others_in_force():
    axes = _directions(2, 6)
    for direction in _directions(50, 7):
        alone, beside = (
            _stack(direction, axes[:1], np.array([0.3])),
            _stack(direction, axes, np.array([0.3, ABSENT_HALF_ANGLE])),
        )
        np.testing.assert_array_equal(beside.is_present, [True, False])
        np.testing.assert_allclose(smallest_margin(UPRIGHT, alone), smallest_margin(UPRIGHT, beside), atol=1e-6)


def test_to_be_kept_in_a_cone_leaves_what_is_missing_to_its_edge():
    for q, look, axis in zip(_attitudes(30, 20), _directions(30, 21), _directions(30, 22), strict=True):
        kept = pointing_constraints.keep_in(jnp.array(look), jnp.array(axis), jnp.float32(0.7))
        angle = angle_to_axis(q, _cone(look, axis, 0.7))
        np.testing.assert_allclose(margin(q, kept), 0.7 - angle, atol=2e-6)


def _turning(count: int) -> PointingConstraint:
    rates = jnp.array(0.3 * _directions(count, 31)).at[0].set(0.0)
    return _stack(_directions(1)[0], _directions(count, 30), np.full(count, 0.3)).replace(axis_rate_N=rates)


def test_axes_turn_as_the_oracle_turns_them():
    zones = _turning(6)
    later = pointing_constraints.later(zones, 7.0)
    turned = oracle.Rotation.from_rotvec(7.0 * np.asarray(zones.axis_rate_N, np.float64)).apply(zones.axis_N)
    np.testing.assert_allclose(later.axis_N, turned, atol=2e-6)
    np.testing.assert_array_equal(later.axis_N[0], zones.axis_N[0])
    np.testing.assert_array_equal(later.half_angle, zones.half_angle)


def test_axes_turn_in_parts_as_they_do_at_once():
    zones = _turning(6)
    parts = pointing_constraints.later(pointing_constraints.later(zones, 2.5), 4.5)
    np.testing.assert_allclose(parts.axis_N, pointing_constraints.later(zones, 7.0).axis_N, atol=2e-6)


def test_where_no_axis_turns_nothing_does():
    zones = _stack(_directions(1)[0], _directions(3), np.full(3, 0.3))
    assert pointing_constraints.later(zones, 7.0) is zones


def test_a_stack_of_turning_axes_is_filled_up_with_one_that_is_absent():
    filled = pointing_constraints.filled_up(_turning(2), 4)
    np.testing.assert_array_equal(filled.is_present, [True, True, False, False])
    assert filled.axis_rate_N is not None and filled.axis_rate_N.shape == (4, 3)
