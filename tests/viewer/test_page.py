"""The 3-D page: what is in the file is what was flown, and nothing outside the file is needed."""

import dataclasses
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import plotly.graph_objects as go
import pytest
from support import tiny
from support.drawn import CUBESAT
from support.tiny import CONFIG, untrained_agent

from koz_jax.agents.agent import Agent
from koz_jax.config import attitudes
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import TaskConfig
from koz_jax.errors import SettingsError
from koz_jax.figures import geometry
from koz_jax.task import rotations, scenario
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.viewer import body, page
from koz_jax.viewer.maneuver import Clock, Maneuver, clock, fly

PAPER = scenario.paper_test()
LONGEST = 6e6  # bytes


@pytest.fixture(scope="module")
def agents():
    """Two agents that do not know what they do, for maneuvers of 12 s."""
    long = TaskConfig.model_validate(CONFIG.task.model_dump() | {"episode_seconds": 12.0})
    return [dataclasses.replace(untrained_agent(seed), task=long, name=f"agent <{seed}>") for seed in (1, 2)]


@pytest.fixture(scope="module")
def flown(agents: list[Agent]):
    return [fly(agent, PAPER) for agent in agents]


@pytest.fixture(scope="module")
def mixed(agents, flown):
    """A maneuver of the paper's spacecraft beside one of a CubeSat."""
    long = TaskConfig.model_validate(CUBESAT.model_dump() | {"episode_seconds": 12.0, "step_seconds": 0.1})
    return [flown[0], fly(agents[1], PAPER, "/some/where/runs/6u", task=long)]


@pytest.fixture(scope="module")
def text(flown):
    return page.render(flown, "Two & two")


@pytest.fixture(scope="module")
def content(text):
    return content_of(text)


def content_of(text):
    found = re.search(r'<script type="application/json" id="content">(.*?)</script>', text, re.DOTALL)
    assert found
    return json.loads(found[1])


def points(maneuver, name):
    """Points (n, 3) of a trace of a scene."""
    (trace,) = (trace for trace in maneuver["scene"]["data"] if trace["name"] == name)
    return np.array([trace[axis] for axis in "xyz"], float).T


@pytest.mark.slow
def test_file_stands_alone_and_is_small(text):
    assert len(text.encode()) < LONGEST
    # The library holds addresses of maps that are never asked for; the page itself names none.
    own = text.replace(page.plotly_library(), "")
    assert "http" not in own and "//cdn" not in own
    assert len(own.encode()) < LONGEST - 5e6 + 2e5
    assert not re.search(r"<script[^>]+src", own) and not re.search(r"<link[^>]+href=\"(?!data:)", own)
    assert own.count("<script") == 3 == own.count("</script>")


def test_different_spacecraft_are_not_compared(mixed, flown):
    together, apart = page.render(flown, "same"), page.render(mixed, "mixed")
    assert '<p class="caution"></p>' in together
    (caution,) = re.findall(r'<p class="caution">(.*?)</p>', apart)
    assert caution == (
        "These spacecraft differ, so the maneuvers compare nothing: each has scales of its own; the scenario&#x27;s"
        " telescope is not that of 6u."
    )

    def scales(rendered):
        layouts = [maneuver["timeline"]["layout"] for maneuver in content_of(rendered)["maneuvers"]]
        return [[layout[axis]["range"] for axis in ("yaxis", "yaxis2", "yaxis3")] for layout in layouts]

    one, other = scales(together)
    assert one == other
    (_, _, large), (_, _, small) = scales(apart)
    assert large == pytest.approx([-2.24, 2.24]) and small == pytest.approx([-4.48, 4.48])


def test_small_torques_keep_their_digits(mixed):
    large, small = content_of(page.render(mixed, "mixed"))["maneuvers"]
    assert [large["torqueUnit"], small["torqueUnit"]] == ["N m", "mN m"]
    for maneuver, shown in zip(mixed, (large, small), strict=True):
        factor = {"N m": 1.0, "mN m": 1e3}[shown["torqueUnit"]]
        torque = np.transpose([curve["y"] for curve in shown["timeline"]["data"][2:]])
        np.testing.assert_allclose(torque, factor * np.asarray(maneuver.history.torque_B), atol=1e-4)
        titles = [note["text"] for note in shown["timeline"]["layout"]["annotations"]]
        assert titles[-1] == f"torque [{shown['torqueUnit']}]"
    effort = 1e6 * float(mixed[1].result.control_effort)
    (text,) = (verdict["text"] for verdict in small["verdicts"] if verdict["text"].startswith("effort"))
    assert text.endswith(" (mN m)² s") and float(text.split()[1]) == pytest.approx(effort, rel=6e-3)


def test_titles_stand_above_the_numbers_of_their_axis(content):
    layout = content["maneuvers"][0]["timeline"]["layout"]
    tops = [layout[axis]["domain"][1] for axis in ("yaxis", "yaxis2", "yaxis3")]
    for title, top in zip(layout["annotations"], tops, strict=True):
        assert (title["x"], title["xanchor"], title["y"], title["yanchor"]) == (0.0, "left", top, "bottom")
    assert not any("title" in layout[axis] for axis in ("yaxis", "yaxis2", "yaxis3"))


def test_a_path_is_shown_by_its_last_part(mixed):
    assert content_of(page.render(mixed, "x"))["maneuvers"][1]["label"] == "6u"


def test_titles_cannot_become_markup(text, content):
    assert "<h1>Two &amp; two</h1>" in text
    assert [maneuver["label"] for maneuver in content["maneuvers"]] == ["agent <1>", "agent <2>"]
    assert "agent <1>" not in text


def test_plotly_knows_every_property(content):
    for maneuver in content["maneuvers"]:
        for figure in (maneuver["scene"], maneuver["timeline"]):
            go.Figure(data=figure["data"], layout=figure["layout"])


def test_frames_cover_the_maneuver(flown, content):
    assert content["frameSeconds"] == pytest.approx(0.1)
    assert content["frames"] == 121 == flown[0].steps + 1
    for maneuver in content["maneuvers"]:
        assert len(points(maneuver, "boresight trail")) == 121
        assert all(len(group["turns"]) == 121 for group in maneuver["scene"]["turning"])
        assert all(len(curve["y"]) == 121 for curve in maneuver["timeline"]["data"])


def test_trail_is_what_was_flown(flown, content):
    for maneuver, shown in zip(flown, content["maneuvers"], strict=True):
        trail = points(shown, "boresight trail")
        boresight_B = jnp.array(maneuver.task.spacecraft.boresight)
        expected = jax.vmap(rotations.rotate, in_axes=(0, None))(maneuver.history.state.body.q_BN, boresight_B)
        np.testing.assert_allclose(trail, expected, atol=6e-5)
        np.testing.assert_allclose(points(shown, "now"), trail[:1])
        margin, error, *torque = (curve["y"] for curve in shown["timeline"]["data"])
        np.testing.assert_allclose(margin, np.rad2deg(maneuver.history.zone_margin), atol=1e-4)
        np.testing.assert_allclose(error, np.rad2deg(maneuver.history.pointing_error), atol=1e-4)
        np.testing.assert_allclose(np.transpose(torque), maneuver.history.torque_B, atol=1e-4)


def test_shortest_path_goes_from_start_to_target_through_the_papers_zone_axis(content):
    for maneuver in content["maneuvers"]:
        path = points(maneuver, "shortest path")
        np.testing.assert_allclose(path[0], points(maneuver, "boresight trail")[0], atol=2e-4)
        np.testing.assert_allclose(path[-1], [1.0, 0.0, 0.0], atol=1e-4)
        np.testing.assert_allclose(points(maneuver, "target")[0], path[-1])
        np.testing.assert_allclose(path[len(path) // 2], PAPER.constraints.axis_N[0], atol=1e-3)


def test_zone_circle_has_the_zones_half_angle(content):
    axis = np.asarray(PAPER.constraints.axis_N[0])
    for maneuver in content["maneuvers"]:
        edge = points(maneuver, "zone edge")
        np.testing.assert_allclose(np.linalg.norm(edge, axis=1), 1.0, atol=1e-4)
        np.testing.assert_allclose(np.rad2deg(np.arccos(edge @ axis)), 15.20, atol=0.02)
        np.testing.assert_allclose(edge[0], edge[-1], atol=1e-4)
        rim = points(maneuver, "zone cone")[-61:]
        along = rim / np.linalg.norm(rim, axis=1, keepdims=True)
        np.testing.assert_allclose(np.rad2deg(np.arccos(along @ axis)), 15.20, atol=0.06)


def test_trail_is_marked_where_it_is_inside(content):
    for maneuver in content["maneuvers"]:
        (trail,) = (trace for trace in maneuver["scene"]["data"] if trace["name"] == "boresight trail")
        inside = np.array(maneuver["timeline"]["data"][0]["y"]) <= 0.0
        np.testing.assert_array_equal(trail["line"]["color"], inside)


@pytest.mark.slow
@pytest.mark.parametrize("half_angles_deg", [(), (20.0, 35.0), (120.0,)])
def test_any_number_of_zones(agents, half_angles_deg):
    axes = jnp.eye(3)[: max(len(half_angles_deg), 1)]
    half_angles = jnp.deg2rad(jnp.array(half_angles_deg or (-180.0,)))
    boresights = jnp.tile(PAPER.constraints.boresight_B, (len(axes), 1))
    drawn = PAPER.replace(constraints=PointingConstraint(boresights, axes, half_angles))
    text = page.render([fly(agents[0], drawn, "one")], "zones")
    (maneuver,) = content_of(text)["maneuvers"]
    edges = [trace for trace in maneuver["scene"]["data"] if trace["name"] == "zone edge"]
    assert len(edges) == len(half_angles_deg)
    for trace, axis, angle in zip(edges, "xyz", half_angles_deg, strict=False):
        np.testing.assert_allclose(np.rad2deg(np.arccos(trace[axis])), angle, atol=0.02)
    assert ("zone" in str(maneuver["verdicts"])) == bool(half_angles_deg)
    numbers = [trace for trace in maneuver["scene"]["data"] if trace["name"] == "zone number"]
    assert len(numbers) == (len(half_angles_deg) if len(half_angles_deg) > 1 else 0)
    for index, (trace, angle) in enumerate(zip(numbers, half_angles_deg, strict=False)):
        assert trace["text"] == [f"<b>{index + 1}</b>"]
        place = np.array([trace[axis][0] for axis in "xyz"])
        np.testing.assert_allclose(place, np.cos(np.deg2rad(angle)) * np.eye(3)[index], atol=1e-4)
        assert "zone 1, half angle 20.0°, zone 2, half angle 35.0°" in text


def maneuver_of(seconds, step, settling_time):
    steps = round(seconds / step)
    settings = TaskConfig(step_seconds=step, episode_seconds=seconds)
    history = type("History", (), {"zone_margin": np.zeros(steps + 1)})()
    return Maneuver("x", settings, history, type("Result", (), {"settling_time": settling_time})())  # pyright: ignore


@pytest.mark.parametrize(
    ("settling", "seconds", "expected"),
    [
        ((17.2, 12.0), None, Clock(0.1, 251)),  # rounded up to 5 s, and 5 s of rest
        ((np.nan, 12.0), None, Clock(0.2, 501)),  # one does not settle: everything, at half the rate
        ((97.0, 98.0), None, Clock(0.2, 501)),
        ((17.2, 12.0), 8.0, Clock(0.1, 81)),
        ((17.2, 12.0), 1e6, Clock(0.2, 501)),
    ],
)
def test_clock(settling, seconds, expected):
    found = clock([maneuver_of(100.0, 0.1, time) for time in settling], seconds)
    assert found.frames == expected.frames
    assert found.seconds == pytest.approx(expected.seconds)


def test_clock_of_unlike_steps_and_lengths():
    found = clock([maneuver_of(10.0, 0.25, np.nan), maneuver_of(20.0, 0.03, np.nan)])
    assert found.seconds == pytest.approx(0.12)
    assert found.times[-1] >= 20.0 - 1e-6 > found.times[-2]


def turned(maneuver, name, frame):
    """Points (n, 3) of a trace of a scene, turned as the page turns them to a frame."""
    names = [trace["name"] for trace in maneuver["scene"]["data"]]
    (group,) = (group for group in maneuver["scene"]["turning"] if names.index(name) in group["traces"])
    return attitudes.rotate(np.array(group["turns"][frame]), points(maneuver, name))


def test_body_turns_with_the_attitude(content):
    (maneuver, _) = content["maneuvers"]
    (group,) = maneuver["scene"]["turning"]
    names = {maneuver["scene"]["data"][index]["name"] for index in group["traces"]}
    assert {"body", "telescope", "line of sight", "body axis x", "body axis y", "body axis z"} <= names
    np.testing.assert_array_equal(points(maneuver, "line of sight")[-1], [1.0, 0.0, 0.0])
    for frame in (0, 60, 120):
        sight = turned(maneuver, "line of sight", frame)[-1]
        np.testing.assert_allclose(sight, points(maneuver, "boresight trail")[frame], atol=1e-4)


@pytest.mark.slow
def test_a_zone_that_turns_is_where_it_is_at_each_instant(agents):
    rate_N = np.deg2rad([[0.3, -0.2, 0.6]]).astype(np.float32)
    drawn = PAPER.replace(constraints=PAPER.constraints.replace(axis_rate_N=jnp.array(rate_N)))
    flown = fly(agents[0], drawn, "one")
    (maneuver,) = content_of(page.render([flown], "turning"))["maneuvers"]
    axes = np.asarray(flown.history.state.scenario.constraints.axis_N[:, 0])
    assert geometry.zones(flown.history)[0].turns and np.linalg.norm(axes[-1] - axes[0]) > 0.05
    for frame in (0, 60, 120):
        for name in ("zone edge", "zone cone"):
            rim = turned(maneuver, name, frame)[-61:]
            along = rim / np.linalg.norm(rim, axis=1, keepdims=True)
            np.testing.assert_allclose(np.rad2deg(np.arccos(along @ axes[frame])), 15.20, atol=0.06)


@pytest.mark.slow
def test_the_maneuver_under_the_shield_is_another_one(agents, flown):
    config = MonteCarloConfig(shield=ShieldConfig(margin_deg=60.0))
    shielded = fly(agents[0], PAPER, "shielded", config=config)
    assert shielded.label == "shielded"
    assert not np.array_equal(shielded.history.torque_B, flown[0].history.torque_B)
    np.testing.assert_array_equal(geometry.boresight(shielded.history), [1.0, 0.0, 0.0])


def test_box_has_the_proportions_of_the_inertia():
    sides = np.array([1.0, 2.0, 3.0])
    inertia = np.diag([13.0, 10.0, 5.0]) / 12.0  # of a unit mass
    np.testing.assert_allclose(body.half_sides(inertia) / sides, body.half_sides(inertia)[0], rtol=1e-6)
    assert np.all(body.half_sides(np.diag([1.0, 1.0, 0.0])) > 0.0)  # a rod


def test_every_face_of_the_box_looks_outwards():
    (box, *_) = body.solid(np.array(TaskConfig().spacecraft.inertia), np.array([1.0, 0.0, 0.0]))
    corners = np.array([box[axis] for axis in "xyz"]).T
    for triangle in np.array([box["i"], box["j"], box["k"]]).T:
        a, b, c = corners[triangle]
        assert np.cross(b - a, c - a) @ (a + b + c) > 0.0


def test_no_page_without_maneuvers():
    with pytest.raises(SettingsError, match="1 to 8, got 0"):
        page.render([], "nothing")


@pytest.mark.slow
def test_the_page_needs_no_matplotlib():
    code = "import sys; sys.modules['matplotlib'] = None; import koz_jax.viewer.page"
    assert tiny.run_python("-c", code).returncode == 0
