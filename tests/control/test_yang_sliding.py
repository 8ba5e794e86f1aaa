"""The published sliding mode, against its potential in float64."""

import numpy as np
import pytest
from support import log_barrier
from support.log_barrier import YANG

from koz_jax.control.published.yang_sliding import YangSliding
from koz_jax.task.any_spacecraft import units


def test_gains_are_the_published_ones_on_the_published_spacecraft():
    unit, gains = units.of(YANG), YangSliding()
    torques = [gains.switching * unit.torque, gains.reach * unit.torque * unit.time]
    found = [gains.away, gains.barrier, gains.slide / unit.time, gains.layer / unit.time, *torques]
    np.testing.assert_allclose(found, [0.05, 0.01, 2.0, 1e-4, 0.35, 4.0], rtol=1e-6)


@pytest.mark.slow
def test_its_function_falls_as_published():
    """V + s' I s / 2, at a rate that is below zero as 8 alpha k > 1.  So the law has the right derivative."""
    inertia_B = np.asarray(YANG.inertia_B, float)

    def lyapunov(q, w, scenario):
        slope_B = log_barrier.slope(q, scenario, 0.05, 0.01)
        s_B = w + 2.0 * slope_B
        value = log_barrier.value(q, scenario, 0.05, 0.01) + 0.5 * s_B @ inertia_B @ s_B
        reaching = 0.35 * s_B @ np.clip(s_B / 1e-4, -1.0, 1.0) + 4.0 * s_B @ s_B
        return value, 0.5 * s_B @ slope_B - slope_B @ slope_B - reaching

    log_barrier.check_rates(YangSliding(), YANG, lyapunov)


def test_turning_the_inertial_frame_changes_nothing():
    log_barrier.check_another_frame(YangSliding(), YANG)


@pytest.mark.slow
def test_the_published_maneuver_takes_the_published_time_and_effort():
    """Within a tenth of 70 s and 113.42 N^2 m^2 s."""
    angles_deg, margin_deg, effort = log_barrier.fly_published(YangSliding())
    settled = 0.1 * (np.flatnonzero(angles_deg > 0.25)[-1] + 2)
    assert abs(settled / 70.0 - 1.0) < 0.1
    assert abs(effort / 113.42 - 1.0) < 0.1
    assert margin_deg > 0.0
