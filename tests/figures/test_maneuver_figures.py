"""Figures of one maneuver: what is drawn is true, and is written."""

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from support import tiny
from support.drawn import angle_deg, crowded_labels, flown, flown_cubesat

from koz_jax.evaluation import cases
from koz_jax.figures import animation, geometry, histories, palette, sphere, style
from koz_jax.task import scenario
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE
from koz_jax.task.scenario import Scenario

TASK = tiny.CONFIG.task


@pytest.mark.slow
def test_the_zone_on_the_page_has_the_true_radius():
    history, _, task = flown()
    traces = geometry.sphere_traces(history)
    axes = sphere.draw(history, task).axes[0]
    (line,) = [line for line in axes.lines if str(line.get_label()).startswith("keep-out zone")]
    x, y = np.array(line.get_data(), float)
    assert np.isfinite(x).all(), "all of the circle faces the viewer"
    on_sphere = np.stack([x, y, np.sqrt(1.0 - x**2 - y**2)], axis=1)
    axis = traces.view.project(traces.zones[0].axis_N)
    np.testing.assert_allclose(angle_deg(on_sphere, axis), 15.2, atol=1e-4)


def test_start_and_end_are_marked_as_in_the_paper():
    history, _, task = flown("phase2")
    axes = sphere.draw(history, task).axes[0]
    traces = geometry.sphere_traces(history)
    marks = {str(line.get_label()).split(",")[0]: line for line in axes.lines if line.get_marker() in ("x", "o")}
    ends = {"start": (0, "x", palette.START), "end": (-1, "o", palette.TARGET)}
    for name, (instant, marker, color) in ends.items():
        assert (marks[name].get_marker(), marks[name].get_color()) == (marker, color)
        right, up, _ = traces.view.project(traces.trace_N[instant])
        np.testing.assert_allclose(np.array(marks[name].get_data(), float).ravel(), [right, up])


def test_histories_are_in_the_units_on_their_axes():
    history, result, task = flown("phase2")
    figure = histories.draw(history, result, task, "title")
    turns = figure.axes[:4]
    attitude, rate, torque, margin = turns
    assert [axes.get_ylabel().split("[")[-1] for axes in turns] == ["-]", "deg/s]", "N m]", "deg]"]
    assert margin.get_xlabel() == "time [s]"
    drawn = {line.get_label(): np.array(line.get_ydata(), float) for axes in turns for line in axes.lines}
    np.testing.assert_allclose(drawn["$q_{e0}$"], history.attitude_error[:, 0])
    np.testing.assert_allclose(drawn[r"$\omega_y$"], np.rad2deg(history.state.body.omega_BN_B[:, 1]), rtol=1e-6)
    np.testing.assert_allclose(drawn[r"$\tau_z$"], history.torque_B[:, 2])
    np.testing.assert_allclose(drawn[r"$\theta_\mathrm{margin}$"], np.rad2deg(history.zone_margin), rtol=1e-6)
    settled = [line for line in rate.lines if line.get_linestyle() == ":"]
    assert np.array(settled[0].get_xdata())[0] == pytest.approx(float(result.settling_time))
    assert len(attitude.texts) == 1 and torque.get_ylim()[1] > 2.0


@pytest.mark.slow
@pytest.mark.parametrize("maneuver", [lambda: flown("phase2"), flown_cubesat])
def test_the_turn_fills_its_panels_and_the_hold_has_its_own(maneuver):
    history, result, task = maneuver()
    figure = histories.draw(history, result, task)
    turns, holds = figure.axes[:4], figure.axes[4:]
    settled, whole = float(result.settling_time), task.episode_seconds
    for axes in turns:
        begin, end = axes.get_xlim()
        assert begin == 0.0 and settled < end <= 1.5 * settled
    assert len(holds) == 4
    first = int(np.ceil(turns[0].get_xlim()[1] / task.step_seconds - 1e-9))
    held_deg = np.rad2deg(history.state.body.omega_BN_B)[first:]
    for axes in holds:
        assert axes.get_xlim() == pytest.approx((turns[0].get_xlim()[1], whole))
    low, high = holds[1].get_ylim()
    assert low < held_deg.min() and high > held_deg.max()
    assert high - low < 0.05 * np.ptp(turns[1].get_ylim()), "the hold is seen at a scale of its own"
    np.testing.assert_allclose(np.array(holds[1].lines[2].get_ydata()), held_deg[:, 2], rtol=1e-6)


def test_a_maneuver_that_does_not_settle_is_drawn_whole():
    history, result, task = flown("phase2")
    lost = result.replace(settled=np.array(False), settling_time=np.array(np.nan))
    figure = histories.draw(history, lost, task)
    assert len(figure.axes) == 4 and figure.axes[0].get_xlim() == pytest.approx((0.0, 100.0))
    late = result.replace(settling_time=np.array(95.0))
    figure = histories.draw(history, late, task)
    assert len(figure.axes) == 4 and figure.axes[0].get_xlim() == pytest.approx((0.0, 100.0))
    early = result.replace(settling_time=np.array(0.0))
    assert histories.draw(history, early, task).axes[0].get_xlim() == pytest.approx((0.0, 1.0))


@pytest.mark.slow
def test_torques_of_a_cubesat_are_in_millinewtons():
    history, result, task = flown_cubesat()
    torque = histories.draw(history, result, task).axes[2]
    assert torque.get_ylabel() == "torque [mN m]" and 4.0 < torque.get_ylim()[1] < 5.0
    (line,) = (line for line in torque.lines if line.get_label() == r"$\tau_x$")
    np.testing.assert_allclose(np.array(line.get_ydata()), 1e3 * history.torque_B[:, 0], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("maneuver", [lambda: flown("phase1"), lambda: flown("phase2"), flown_cubesat])
def test_no_numbers_of_an_axis_touch(maneuver):
    assert crowded_labels(histories.draw(*maneuver())) == []


@pytest.mark.slow
def test_several_zones_are_told_apart():
    history, _, task = flown_cubesat()
    axes = sphere.draw(history, task).axes[0]
    half_angles = [np.rad2deg(zone.half_angle) for zone in geometry.zones(history)]
    labels = [str(line.get_label()) for line in axes.lines if "half angle" in str(line.get_label())]
    assert labels == [f"zone {number}, half angle {angle:.1f}°" for number, angle in enumerate(half_angles, start=1)]
    traces = geometry.sphere_traces(history)
    numbers = {text.get_text(): text for text in axes.texts if text.get_text().isdecimal()}
    assert {*numbers} == {"1", "2", "3"}
    for number, zone in enumerate(traces.zones, start=1):
        right, up = numbers[str(number)].get_position()
        there = np.array([right, up, np.sqrt(1.0 - right**2 - up**2)]) @ traces.view.axes_N
        assert geometry.inside(there, zone), "a number stands in its own zone"


@pytest.mark.slow
def test_one_zone_needs_no_number():
    history, _, task = flown("phase2")
    assert not [text for text in sphere.draw(history, task).axes[0].texts if text.get_text().isdecimal()]


@pytest.mark.parametrize(("maneuver", "is_dashed"), [(lambda: flown("phase2"), False), (flown_cubesat, True)])
def test_dashes_are_explained_where_there_are_any(maneuver, is_dashed):
    history, _, task = maneuver()
    traces = geometry.sphere_traces(history)
    lines_N = [traces.trace_N, traces.shortest_N, *traces.circles_N]
    assert any((traces.view.project(line)[:, 2] < 0.0).any() for line in lines_N) == is_dashed
    notes = " ".join(text.get_text() for text in sphere.draw(history, task).axes[0].texts)
    assert ("dashed: on the far side" in notes) == is_dashed


def test_a_case_without_a_zone_says_so():
    paper = scenario.paper_test()
    drawn = Scenario(paper.initial, paper.q_DN, paper.constraints.replace(half_angle=jnp.array([ABSENT_HALF_ANGLE])))
    history, result = cases.fly_scenario(tiny.untrained_agent(), drawn)
    assert geometry.zones(history) == []
    assert "no keep-out zone" in histories.draw(history, result, TASK).axes[3].texts[0].get_text()
    labels = [str(line.get_label()) for line in sphere.draw(history, TASK).axes[0].lines]
    assert not any("keep-out" in label for label in labels)
    assert animation.gif(history, result, TASK).startswith(b"GIF")


@pytest.mark.slow
def test_the_same_figure_gives_the_same_bytes(tmp_path):
    history, result, task = flown()
    contents = []
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        files = style.save(histories.draw(history, result, task), tmp_path / name, "histories")
        contents.append([path.read_bytes() for path in files])
    assert contents[0] == contents[1]


@pytest.mark.slow
def test_the_moving_picture_is_short_and_small():
    history, result, task = flown("phase2")
    content = animation.gif(history, result, task, "a title")
    assert len(content) <= 2_000_000
    instants = animation.shown_instants(history, result, task)
    assert instants[0] == 0 and 0 <= instants[-1] * 0.1 - float(result.settling_time) - 3.0 < 0.1
    not_settled = result.replace(settled=jnp.array(False), settling_time=jnp.nan)
    instants = animation.shown_instants(history, not_settled, task)
    assert instants[-1] == 1000 and len(instants) <= 251


def test_drawing_leaves_the_settings_of_matplotlib_alone():
    history, result, task = flown()
    before = dict(matplotlib.rcParams)
    histories.draw(history, result, task)
    assert dict(matplotlib.rcParams) == before


def test_unequal_limits_are_drawn_in_the_colours_of_their_axes():
    history, result, task = flown()
    unequal = task.model_copy(
        update={"spacecraft": task.spacecraft.model_copy(update={"torque_limit": (2.0, 1.0, 0.5)})}
    )
    torque = histories.draw(history, result, unequal).axes[2]
    dashed = {
        (abs(np.array(line.get_ydata())[0]), line.get_color()) for line in torque.lines if line.get_linestyle() == "--"
    }
    assert dashed == {*zip((2.0, 1.0, 0.5), palette.BODY_AXES, strict=True)}
    assert torque.get_ylim()[1] > 2.0
    assert animation.gif(history, result, unequal).startswith(b"GIF")
