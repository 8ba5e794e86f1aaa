"""What is drawn on the sphere is where it should be."""

import jax.numpy as jnp
import numpy as np
import pytest
from support.drawn import angle_deg, flown

from koz_jax.figures import geometry
from koz_jax.figures.geometry import Zone
from koz_jax.task import rotations, scenario

BORESIGHT_B = np.array([1.0, 0.0, 0.0])


@pytest.mark.parametrize("half_angle_deg", [1.0, 15.2, 30.0, 90.0, 120.0])
def test_every_point_of_the_zone_circle_is_at_the_half_angle(half_angle_deg):
    axis_N = np.array([0.703, 0.263, 0.661])
    axis_N /= np.linalg.norm(axis_N)
    circle = geometry.zone_circle(Zone(axis_N, np.deg2rad(half_angle_deg)))
    np.testing.assert_allclose(np.linalg.norm(circle, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(angle_deg(circle, axis_N), half_angle_deg, atol=1e-6)
    np.testing.assert_allclose(circle[0], circle[-1], atol=1e-12)
    np.testing.assert_allclose(circle[:-1].mean(axis=0), axis_N * np.cos(np.deg2rad(half_angle_deg)), atol=1e-9)


def test_the_shortest_path_of_the_paper_leads_through_the_middle_of_the_zone():
    drawn = scenario.paper_test()
    path = geometry.shortest_path(drawn.initial.q_BN, drawn.q_DN, BORESIGHT_B)
    start = rotations.rotate(drawn.initial.q_BN, jnp.array(BORESIGHT_B))
    np.testing.assert_allclose(path[0], start, atol=1e-6)
    np.testing.assert_allclose(path[-1], BORESIGHT_B, atol=1e-6)
    # The paper gives the axis to three digits.
    assert angle_deg(path[len(path) // 2], np.asarray(drawn.constraints.axis_N[0], np.float64)) < 0.05
    steps = angle_deg(path[1:], path[:-1])
    np.testing.assert_allclose(steps, steps[0], rtol=1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_shortest_path_does_not_depend_on_the_sign_of_the_quaternion(sign):
    q_BN = jnp.array([0.6, 0.0, 0.0, 0.8])
    path = geometry.shortest_path(sign * q_BN, jnp.array([1.0, 0.0, 0.0, 0.0]), BORESIGHT_B)
    np.testing.assert_allclose(angle_deg(path[0], path[-1]), 2 * np.rad2deg(np.arccos(0.6)), atol=1e-4)
    assert np.all(angle_deg(path[1:], path[:-1]) < 1.0)


def test_a_maneuver_of_nothing_has_a_path_of_one_point():
    attitude = jnp.array([1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(geometry.shortest_path(attitude, attitude, BORESIGHT_B), [BORESIGHT_B] * 201, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("agent, enters", [("phase1", True), ("phase2", False)])
def test_the_trace_of_phase_1_enters_the_zone_and_that_of_phase_2_does_not(agent, enters):
    history, _, _ = flown(agent)
    traces = geometry.sphere_traces(history)
    to_axis = angle_deg(traces.trace_N, traces.zones[0].axis_N)
    assert (to_axis.min() < 15.2) == enters
    np.testing.assert_allclose(to_axis - 15.2, np.rad2deg(history.zone_margin), atol=1e-3)
    np.testing.assert_array_equal(geometry.inside(traces.trace_N, traces.zones[0]), np.array(history.zone_margin) <= 0)
    assert angle_deg(traces.trace_N[-1], traces.shortest_N[-1]) < 0.25
    assert angle_deg(traces.trace_N[0], traces.shortest_N[0]) < 1e-3


def test_the_view_faces_zone_and_paths():
    history, _, _ = flown("phase2")
    traces = geometry.sphere_traces(history)
    np.testing.assert_allclose(traces.view.axes_N @ traces.view.axes_N.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(traces.view.axes_N) == pytest.approx(1.0)
    for line in (traces.trace_N, traces.shortest_N, *traces.circles_N):
        assert traces.view.project(line)[:, 2].min() > 0.3
    assert traces.view.project(np.array([0.0, 0.0, 1.0]))[1] > 0, "north is up"


def test_what_is_behind_the_sphere_is_told_from_what_is_before_it():
    depth = np.array([1.0, 0.5, -0.5, -1.0, 0.5])
    line = np.stack([np.arange(5.0), np.zeros(5), depth], axis=1)
    front, back = geometry.front_and_back(line)
    np.testing.assert_array_equal(np.isfinite(front[:, 0]), [True, True, False, False, True])
    np.testing.assert_array_equal(np.isfinite(back[:, 0]), [False, True, True, True, True])


@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [-0.5, 0.5, 0.1]])
def test_the_picture_of_the_sphere_is_what_the_viewer_sees(direction):
    view = geometry.view_of(np.array([direction]) / np.linalg.norm(direction))
    seen = view.sphere_directions(50)
    right, up = np.meshgrid(np.linspace(-1, 1, 50), np.linspace(1, -1, 50))
    on_sphere = np.isfinite(seen[..., 0])
    np.testing.assert_array_equal(on_sphere, right**2 + up**2 <= 1.0)
    projected = view.project(seen[on_sphere])
    np.testing.assert_allclose(projected[:, :2], np.stack([right, up], -1)[on_sphere], atol=1e-12)
    assert projected[:, 2].min() >= -1e-12
