import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest

from koz_jax import keep_out
from koz_jax.keep_out import NO_ZONE_HALF_ANGLE, KeepOutZone

pytestmark = pytest.mark.usefixtures("strict_shapes")

angle_to_axis = jax.jit(keep_out.angle_to_axis)
margin = jax.jit(keep_out.margin)
smallest_margin = jax.jit(keep_out.smallest_margin)


def _zone(axis: np.ndarray, half_angle: float) -> KeepOutZone:
    return KeepOutZone(jnp.array(axis, jnp.float32), jnp.float32(half_angle))


def _directions(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([oracle.random_direction(rng) for _ in range(count)]).astype(np.float32)


@pytest.mark.parametrize("half_angle_deg", [15.0, 30.0, 89.0, 91.0, 150.0])
def test_margin_is_positive_outside_and_negative_inside_the_cone(half_angle_deg):
    half_angle = np.deg2rad(half_angle_deg)
    axis = np.array([0.0, 0.6, 0.8])
    across = np.array([1.0, 0.0, 0.0])
    zone = _zone(axis, half_angle)
    for offset in np.deg2rad([0.001, 0.1, 10.0]):
        for sign in (-1.0, 1.0):
            theta = half_angle + sign * offset
            direction = np.cos(theta) * axis + np.sin(theta) * across
            np.testing.assert_allclose(margin(direction.astype(np.float32), zone), sign * offset, atol=1e-6)


def test_margin_is_minus_the_half_angle_on_the_axis_and_largest_opposite_to_it():
    axis = np.array([0.0, 0.6, 0.8], np.float32)
    zone = _zone(axis, 0.4)
    assert margin(axis, zone) == -np.float32(0.4)
    np.testing.assert_allclose(margin(-axis, zone), np.pi - 0.4, rtol=1e-6)


def test_margin_is_the_angle_to_the_axis_less_the_half_angle():
    for direction, axis in zip(_directions(30, 0), _directions(30, 1), strict=True):
        theta = angle_to_axis(direction, _zone(axis, 0.3))
        np.testing.assert_allclose(theta, oracle.angle_between(direction, axis), atol=1e-6)
        np.testing.assert_allclose(margin(direction, _zone(axis, 0.3)), theta - 0.3, atol=1e-6)


def test_margin_outside_means_what_equation_5_of_the_paper_means():
    """r . n - cos(theta_F) < 0 exactly where theta_margin > 0."""
    axis = np.array([0.0, 0.6, 0.8], np.float32)
    for direction in _directions(200):
        outside = direction @ axis - np.cos(0.9) < 0
        assert bool(margin(direction, _zone(axis, 0.9)) > 0) == outside


def test_margin_to_several_zones_is_that_to_the_nearest():
    axes = _directions(4, 2)
    half_angles = np.array([0.2, 0.5, 0.4, 0.3], np.float32)
    zones = KeepOutZone(jnp.array(axes), jnp.array(half_angles))
    nearest = set()
    for direction in _directions(100, 3):
        each = oracle.angle_between(direction, axes) - half_angles
        nearest.add(int(np.argmin(each)))
        np.testing.assert_allclose(smallest_margin(direction, zones), each.min(), atol=1e-6)
    assert nearest == {0, 1, 2, 3}


def test_a_further_zone_never_makes_the_margin_larger():
    axes, half_angles = jnp.array(_directions(3, 4)), jnp.array([0.2, 0.3, 0.4])
    for direction in _directions(50, 5):
        found = [float(smallest_margin(direction, KeepOutZone(axes[:n], half_angles[:n]))) for n in (1, 2, 3)]
        assert found == sorted(found, reverse=True)


def test_no_zone_is_never_violated():
    axis = np.array([0.0, 0.6, 0.8], np.float32)
    for direction in [axis, -axis, *_directions(50)]:
        assert margin(direction, _zone(axis, NO_ZONE_HALF_ANGLE)) >= np.float32(np.pi)


def test_no_zone_leaves_the_others_in_force():
    axes = _directions(2, 6)
    alone = KeepOutZone(jnp.array(axes[:1]), jnp.array([0.3]))
    beside = KeepOutZone(jnp.array(axes), jnp.array([0.3, NO_ZONE_HALF_ANGLE]))
    for direction in _directions(50, 7):
        assert smallest_margin(direction, alone) == smallest_margin(direction, beside)
