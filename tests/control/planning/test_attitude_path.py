"""Attitude paths and their timing."""

import jax.numpy as jnp
import numpy as np
import pytest

from koz_jax.control.planning import attitude_path
from koz_jax.control.planning.attitude_path import AttitudePath

MOMENTS = (60.0, 50.0, 70.0)


@pytest.mark.slow
@pytest.mark.parametrize("limits", [(2.0, 2.0, 2.0), (0.5, 1.0, 3.0)])
def test_straight_turn_about_a_principal_axis_is_timed_as_bang_bang(limits):
    """Each axis by its own limit."""
    inertia_B = jnp.diag(jnp.array(MOMENTS))
    for axis, moment in enumerate(MOMENTS):
        path = AttitudePath(jnp.eye(4)[0], 2.0 * jnp.eye(3)[axis], jnp.zeros((2, 3)))
        timing = attitude_path.fastest_timing(attitude_path.sample(path, 65), inertia_B, jnp.array(limits))
        assert float(timing.duration) == pytest.approx(2.0 * np.sqrt(2.0 * moment / limits[axis]), rel=1e-3)
