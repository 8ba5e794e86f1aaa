"""Splines along attitudes, shortcuts, and less bend."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import states

from koz_jax.control.planning import attitude_path, smoothing, spline_path
from koz_jax.task import rotations
from koz_jax.task.pointing_constraints import PointingConstraint

POINTS = 65
ZONE = PointingConstraint(states.LOOK[None], jnp.array([[0.0, 1.0, 0.0]]), jnp.array([0.5]))
MARGIN = 0.05


def looking(azimuth, elevation):
    about_z = rotations.from_axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.float32(azimuth))
    return rotations.multiply(about_z, rotations.from_axis_angle(jnp.array([0.0, 1.0, 0.0]), jnp.float32(-elevation)))


# From x over a corner far above the zone, whose axis is y, to -x.
CORNERS = jnp.stack([looking(0.0, 0.0), looking(0.5, 0.9), looking(0.5 * jnp.pi, 1.2), looking(jnp.pi, 0.0)])


@jax.jit
def _smoothed():
    way = spline_path.evenly(CORNERS, POINTS)
    short = spline_path.evenly(smoothing.shortcut(way, ZONE, MARGIN), POINTS)
    eased = smoothing.eased(short, ZONE, MARGIN, 24)[-1]
    return [(one, smoothing.margins_along(one, ZONE), attitude_path.sample(spline_path.along(one), 129))
            for one in (way, short, eased)]  # fmt: skip


@pytest.fixture(scope="module")
def smoothed():
    return jax.tree.map(lambda leaf: np.asarray(leaf, float), _smoothed())


def angles(way):
    return 2.0 * np.arccos(np.clip(np.sum(way[1:] * way[:-1], axis=1), -1.0, 1.0))


@pytest.mark.slow
def test_attitudes_are_even_in_angle_and_keep_the_ends(smoothed):
    way = smoothed[0][0]
    found = angles(way)
    # Less where a corner is cut.
    assert np.median(found) == pytest.approx(found.max(), rel=1e-3)
    np.testing.assert_array_equal(way[[0, -1]], np.asarray(CORNERS[jnp.array([0, -1])], float))


def test_splines_begin_and_end_at_the_ends_with_their_sign_and_turn_without_a_jump(smoothed):
    for way, _, samples in smoothed:
        np.testing.assert_allclose(samples.q_BN[[0, -1]], way[[0, -1]], atol=2e-6)
        between = angles(samples.q_BN)
        # The rate is the derivative of the attitude.
        rates = np.linalg.norm(samples.slope_B, axis=1)
        np.testing.assert_allclose(128 * between, 0.5 * (rates[1:] + rates[:-1]), rtol=0.02, atol=0.02)
        assert np.abs(np.diff(samples.slope_B, axis=0)).max() < 0.5 * rates.max()


def test_shortcuts_shorten_and_easing_takes_the_bend_out_outside_the_zone(smoothed):
    lengths = [angles(way).sum() for way, _, _ in smoothed]
    assert lengths[1] < 0.95 * lengths[0]
    sharpest = [np.linalg.norm(np.diff(samples.slope_B, axis=0), axis=1).max() for _, _, samples in smoothed]
    assert sharpest[2] < 0.5 * sharpest[1]
    assert all(margins.min() >= MARGIN - 0.01 for _, margins, _ in smoothed)
