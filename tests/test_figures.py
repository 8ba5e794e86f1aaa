"""Figures: what is drawn is true, is written, and what cannot be drawn is refused in a line."""

import csv
import functools
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
import tiny
from matplotlib.collections import Collection
from matplotlib.colors import to_hex
from PIL import Image

import koz_jax.agent
from koz_jax import curriculum, evaluation, reward, rotations, scenario, trainer
from koz_jax.figures import animation, geometry, histories, learning, monte_carlo, sphere, style
from koz_jax.figures.geometry import Zone
from koz_jax.figures.monte_carlo import NOT_SETTLED, SETTLED, VERDICTS, VIOLATED
from koz_jax.keep_out import NO_ZONE_HALF_ANGLE
from koz_jax.metrics_log import flatten
from koz_jax.rollout import CaseResult, History
from koz_jax.scenario import Scenario
from koz_jax.task_config import TaskConfig

TASK = tiny.CONFIG.task
BORESIGHT_B = TASK.spacecraft.boresight
SCATTER_LIMIT = 3_000_000  # bytes


@functools.cache
def flown(agent: str = "") -> tuple[History, CaseResult, TaskConfig]:
    """The paper's test scenario, flown by a shipped agent, or for 2 s by one that nobody trained."""
    pilot = koz_jax.agent.load_agent(agent) if agent else tiny.untrained_agent()
    return *evaluation.fly_scenario(pilot, scenario.paper_test()), pilot.task


def outcomes(cases: int, seed: int = 0) -> CaseResult:
    """Random outcomes in all verdicts, also settled nowhere and violated."""
    draw = np.random.default_rng(seed)
    settled, violated = draw.uniform(size=cases) > 0.1, draw.uniform(size=cases) < 0.1
    terms = [draw.normal(size=cases) for _ in reward.PAPER_WEIGHTS.__dataclass_fields__]
    leaves: dict[str, Any] = {
        "initial_angle": draw.uniform(1.4, 3.1, cases),
        "reward_terms": jax.tree.unflatten(jax.tree.structure(reward.PAPER_WEIGHTS), terms),
        "settling_time": np.where(settled, draw.normal(25.0, 4.0, cases), np.nan),
        "control_effort": draw.gamma(9.0, 8.0, cases),
        "control_accuracy": np.where(settled, 1e-3, 1.0) * draw.uniform(size=cases),
        "min_margin": np.where(violated, -0.1, 0.1),
        "settled": settled,
        "violated": violated,
        **tiny.unshielded(len(settled)),
    }
    return CaseResult(**leaves)


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between unit vectors (..., 3), in double precision."""
    return np.rad2deg(2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


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
    assert angle_deg(path[len(path) // 2], np.asarray(drawn.zones.axis_N[0], np.float64)) < 0.05
    steps = angle_deg(path[1:], path[:-1])
    np.testing.assert_allclose(steps, steps[0], rtol=1e-3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_shortest_path_does_not_depend_on_the_sign_of_the_quaternion(sign):
    q_BN = jnp.array([0.6, 0.0, 0.0, 0.8])
    path = geometry.shortest_path(sign * q_BN, jnp.array([1.0, 0.0, 0.0, 0.0]), (1.0, 0.0, 0.0))
    np.testing.assert_allclose(angle_deg(path[0], path[-1]), 2 * np.rad2deg(np.arccos(0.6)), atol=1e-4)
    assert np.all(angle_deg(path[1:], path[:-1]) < 1.0)


def test_a_maneuver_of_nothing_has_a_path_of_one_point():
    attitude = jnp.array([1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(geometry.shortest_path(attitude, attitude, BORESIGHT_B), [BORESIGHT_B] * 201, atol=1e-7)


@pytest.mark.parametrize("agent, enters", [("phase1", True), ("phase2", False)])
def test_the_trace_of_phase_1_enters_the_zone_and_that_of_phase_2_does_not(agent, enters):
    history, _, task = flown(agent)
    traces = geometry.sphere_traces(history, task)
    to_axis = angle_deg(traces.trace_N, traces.zones[0].axis_N)
    assert (to_axis.min() < 15.2) == enters
    np.testing.assert_allclose(to_axis - 15.2, np.rad2deg(history.zone_margin), atol=1e-3)
    np.testing.assert_array_equal(geometry.inside(traces.trace_N, traces.zones[0]), np.array(history.zone_margin) <= 0)
    assert angle_deg(traces.trace_N[-1], traces.shortest_N[-1]) < 0.25
    assert angle_deg(traces.trace_N[0], traces.shortest_N[0]) < 1e-3


def test_the_view_faces_zone_and_paths():
    history, _, task = flown("phase2")
    traces = geometry.sphere_traces(history, task)
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


def test_the_zone_on_the_page_has_the_true_radius():
    history, _, task = flown()
    traces = geometry.sphere_traces(history, task)
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
    traces = geometry.sphere_traces(history, task)
    marks = {str(line.get_label()).split(",")[0]: line for line in axes.lines if line.get_marker() in ("x", "o")}
    ends = {"start": (0, "x", style.BLUE), "end": (-1, "o", style.GREEN)}
    for name, (instant, marker, color) in ends.items():
        assert (marks[name].get_marker(), marks[name].get_color()) == (marker, color)
        right, up, _ = traces.view.project(traces.trace_N[instant])
        np.testing.assert_allclose(np.array(marks[name].get_data(), float).ravel(), [right, up])


def test_histories_are_in_the_units_on_their_axes():
    history, result, task = flown("phase2")
    figure = histories.draw(history, result, task, "title")
    attitude, rate, torque, margin = figure.axes
    assert [axes.get_ylabel().split("[")[-1] for axes in figure.axes] == ["-]", "deg/s]", "N m]", "deg]"]
    assert margin.get_xlabel() == "time [s]" and margin.get_xlim() == pytest.approx((0.0, 100.0))
    drawn = {line.get_label(): np.array(line.get_ydata(), float) for axes in figure.axes for line in axes.lines}
    np.testing.assert_allclose(drawn["$q_{e0}$"], history.observation[:, 0])
    np.testing.assert_allclose(drawn[r"$\omega_y$"], np.rad2deg(history.state.body.omega_BN_B[:, 1]), rtol=1e-6)
    np.testing.assert_allclose(drawn[r"$\tau_z$"], history.torque_B[:, 2])
    np.testing.assert_allclose(drawn[r"$\theta_\mathrm{margin}$"], np.rad2deg(history.zone_margin), rtol=1e-6)
    settled = [line for line in rate.lines if line.get_linestyle() == ":"]
    assert np.array(settled[0].get_xdata())[0] == pytest.approx(float(result.settling_time))
    assert len(attitude.texts) == 1 and torque.get_ylim()[1] > 2.0


def test_a_case_without_a_zone_says_so():
    paper = scenario.paper_test()
    drawn = Scenario(paper.initial, paper.q_DN, paper.zones.replace(half_angle=jnp.array([NO_ZONE_HALF_ANGLE])))
    history, result = evaluation.fly_scenario(tiny.untrained_agent(), drawn)
    assert geometry.zones(history) == []
    assert "no keep-out zone" in histories.draw(history, result, TASK).axes[3].texts[0].get_text()
    labels = [str(line.get_label()) for line in sphere.draw(history, TASK).axes[0].lines]
    assert not any("keep-out" in label for label in labels)
    assert animation.gif(history, result, TASK).startswith(b"GIF")


def offsets(cloud: Collection) -> np.ndarray:
    """Points of a scatter, (points, 2)."""
    return np.array(cloud.get_offsets())


def test_cases_are_coloured_by_verdict():
    results = outcomes(500)
    shown = monte_carlo.points(results, TaskConfig())
    settled, violated = np.asarray(results.settled), np.asarray(results.violated)
    wanted = {SETTLED: settled & ~violated, VIOLATED: violated, NOT_SETTLED: ~settled & ~violated}
    figure = monte_carlo.draw_samples(shown)
    for axes, values in zip(figure.axes, (results.reward, shown.settling_time, results.control_effort), strict=True):
        clouds = {to_hex(np.array(cloud.get_facecolor())[0]).upper(): cloud for cloud in axes.collections}
        for verdict, cases in wanted.items():
            expected = np.stack([np.flatnonzero(cases), np.asarray(values)[cases]], axis=1)
            np.testing.assert_allclose(offsets(clouds[verdict.color]), expected)
    assert len({verdict.color for verdict in VERDICTS}) == len({verdict.marker for verdict in VERDICTS}) == 3
    text = figure.legends[0].get_texts()[1].get_text()
    assert text.startswith(f"zone violated: {violated.sum()} ({violated.mean() * 100:.2f} %)")
    assert f"{(violated & ~settled).sum()} of them not settled" in text


def test_what_did_not_settle_is_drawn_at_200_s():
    results = outcomes(500)
    shown = monte_carlo.points(results, TaskConfig())
    settled = np.asarray(results.settled)
    np.testing.assert_array_equal(shown.settling_time[~settled], 200.0)
    np.testing.assert_array_equal(shown.settling_time[settled], np.asarray(results.settling_time)[settled])
    assert "did not settle: drawn at 200 s" in monte_carlo.draw_samples(shown).axes[1].texts[0].get_text()


def test_the_accuracy_of_settled_cases_stands_alone():
    shown = monte_carlo.points(outcomes(500), TaskConfig())
    everything, settled_only = monte_carlo.draw_accuracy(shown, 0.25).axes
    counts = [sum(map(len, map(offsets, axes.collections))) for axes in (everything, settled_only)]
    assert counts == [500, shown.settled.sum()]


def test_ten_thousand_cases_make_small_figures(tmp_path):
    files = monte_carlo.write(tmp_path, outcomes(10_000), TaskConfig(), "a title")
    assert sorted(path.suffix for path in files) == [".pdf"] * 3 + [".png"] * 3
    for path in files:
        assert 5_000 < path.stat().st_size <= SCATTER_LIMIT


def test_one_case_can_be_drawn():
    lost = outcomes(1).replace(settled=np.array([False]), settling_time=np.array([np.nan]))
    shown = monte_carlo.points(lost, TaskConfig())
    for figure in (
        monte_carlo.draw_samples(shown),
        monte_carlo.draw_relations(shown),
        monte_carlo.draw_accuracy(shown, 0.25),
    ):
        figure.draw_without_rendering()


def test_the_same_figure_gives_the_same_bytes(tmp_path):
    history, result, task = flown()
    contents = []
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        files = style.save(histories.draw(history, result, task), tmp_path / name, "histories")
        contents.append([path.read_bytes() for path in files])
    assert contents[0] == contents[1]


def test_the_moving_picture_is_short_and_small():
    history, result, task = flown("phase2")
    content = animation.gif(history, result, task, "a title")
    assert len(content) <= 2_000_000
    instants = animation.shown_instants(history, result, task)
    assert instants[0] == 0 and 0 <= instants[-1] * 0.1 - float(result.settling_time) - 3.0 < 0.1
    not_settled = result.replace(settled=jnp.array(False), settling_time=jnp.nan)
    instants = animation.shown_instants(history, not_settled, task)
    assert instants[-1] == 1000 and len(instants) <= 251


# Learning curves.


def log(folder: Path, factor: float = 1.0, updates: tuple[int, ...] = (10, 20, 30, 40), refined: int = 2) -> Path:
    """A run folder with a log: two updates out of four in phase 1, then iterations of refinement."""
    folder.mkdir()
    rows = [
        dict(zip(learning._COLUMNS, [n, 1 + (i >= 1), "", *[factor * (i + 1)] * 6], strict=True))
        for i, n in enumerate(updates)
    ]
    rows += [
        dict(zip(learning._COLUMNS, [updates[-1] + n + 1, "", 8.5, *[factor * 9] * 6], strict=True))
        for n in range(refined)
    ]
    with open(folder / "metrics.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, learning._COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return folder


def test_curves_keep_the_values_of_every_run(tmp_path):
    logs = [learning.read_metrics(log(tmp_path / str(factor), factor)) for factor in (1.0, 2.0, 4.0)]
    shown = learning.curves(logs)
    np.testing.assert_array_equal(shown.done, [10, 20, 30, 40, 41, 42])
    rewards = shown.values["eval/mean_reward"]
    np.testing.assert_array_equal(rewards, np.outer([1.0, 2.0, 4.0], [1, 2, 3, 4, 9, 9]))
    assert shown.stages == learning.Stages(phase1=20, learned=40, length=42)
    figure = learning.draw(shown)
    line = next(line for line in figure.axes[0].lines if str(line.get_label()).startswith("median"))
    np.testing.assert_array_equal(line.get_ydata(), rewards[1])
    x = np.array(line.get_xdata(), float)
    assert np.all(np.diff(x) > 0) and x[-1] == 1.0
    (band,) = figure.axes[0].collections
    assert band.get_paths()[0].get_extents().y1 == 36.0
    ticks = [tick.get_text() for tick in figure.axes[-1].get_xticklabels()]
    assert ticks == ["0", "20", "40", "+2"]


def test_runs_with_other_instants_are_interpolated_but_not_extended(tmp_path):
    logs = [
        learning.read_metrics(log(tmp_path / "a", refined=0)),
        learning.read_metrics(log(tmp_path / "b", updates=(5, 15, 25), refined=0)),
    ]
    shown = learning.curves(logs)
    np.testing.assert_array_equal(shown.done, [5, 10, 15, 20, 25, 30, 40])
    np.testing.assert_allclose(
        shown.values["eval/success_rate"], [[np.nan, 1, 1.5, 2, 2.5, 3, 4], [1, 1.5, 2, 2.5, 3, np.nan, np.nan]]
    )


def test_runs_of_other_lengths_are_not_mixed(tmp_path, capsys):
    runs = [log(tmp_path / "a"), log(tmp_path / "b", updates=(10, 20))]
    assert learning.main([*map(str, runs), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err == (
        "error: runs: draw runs of one preset together; these learned for [20, 40] updates\n"
    )


def test_learning_curves_are_written(tmp_path, capsys):
    out = tmp_path / "new" / "out"
    assert learning.main([str(log(tmp_path / "a")), str(log(tmp_path / "b", 2.0)), "--out", str(out)]) == 0
    for suffix in ("png", "pdf"):
        assert (out / f"learning.{suffix}").stat().st_size > 5_000
    assert "learning.png" in capsys.readouterr().out


def test_the_columns_are_those_that_a_training_writes():
    written = {"updates", *trainer._EVAL_NAMES}
    written |= flatten("curriculum", curriculum.difficulty(tiny.CONFIG.curriculum, jnp.int32(0))).keys()
    assert set(learning._COLUMNS) - written == {"refine/cost"}
    assert '"refine/cost"' in Path(trainer.__file__).read_text()


def test_a_line_that_is_still_being_written_is_left_out(tmp_path):
    run = log(tmp_path / "run")
    whole = learning.read_metrics(run)
    with open(run / "metrics.csv", "a") as file:
        file.write("43,1,,7.")
    np.testing.assert_array_equal(learning.read_metrics(run)["updates"], whole["updates"])


BROKEN_LOGS = {
    "nothing": (None, "is not a run folder (it has no metrics.csv)"),
    "empty": (b"", "has no rows yet"),
    "header": (",".join(learning._COLUMNS).encode() + b"\n", "has no rows yet"),
    "other": (b"a,b\n1,2\n", "has no column 'updates'"),
    "words": (",".join(learning._COLUMNS).encode() + b"\n" + b"x," * 8 + b"x\n", "a cell is not a number"),
    "short": (",".join(learning._COLUMNS).encode() + b"\n,1,,1\n", "has a row without its number of updates"),
    "bytes": (b"\xff\xfe\x00\n\xff\n", "cannot be read as CSV"),
    "quote": (b'updates,"x\n1,2\n', "cannot be read as CSV"),
    "no evaluation": (",".join(learning._COLUMNS).encode() + b"\n10,1" + b"," * 7 + b"\n", "no evaluation in"),
}


@pytest.mark.parametrize("name", BROKEN_LOGS)
def test_a_log_that_cannot_be_drawn_is_refused(name, tmp_path, capsys):
    content, message = BROKEN_LOGS[name]
    run = tmp_path / "run"
    run.mkdir()
    if content is not None:
        (run / "metrics.csv").write_bytes(content)
    assert learning.main([str(run), "--out", str(tmp_path / "out")]) == 2
    output = capsys.readouterr()
    assert message in output.err and str(run) in output.err
    assert len(output.err.splitlines()) == 1 and not (tmp_path / "out").exists()


# Command lines.


@pytest.fixture
def agent(tmp_path) -> Path:
    """Folder of an agent that nobody trained."""
    tiny.untrained_agent().save(tmp_path / "agent")
    return tmp_path / "agent"


@pytest.mark.parametrize("choice", [("--scenario", "paper"), ("--case", 3, "--cases", 5, "--seed", 1, "--gif")])
def test_fly_writes_what_it_says(choice, agent, tmp_path, capsys):
    out = tmp_path / "new" / "out"
    assert tiny.status("fly", "--agent", agent, "--out", out, *choice) == 0
    printed = capsys.readouterr().out
    names = {"history.csv", "sphere.png", "sphere.pdf", "histories.png", "histories.pdf"}
    names |= {"maneuver.gif"} if "--gif" in choice else set()
    assert {path.name for path in out.iterdir()} == names
    assert all((out / name).stat().st_size > 1_000 and str(out / name) in printed for name in names)
    assert printed.startswith("case 3 of seed 1: " if "--case" in choice else "the paper's test scenario: 100.0 deg")
    with Image.open(out / "sphere.png") as picture:
        assert np.ptp(np.asarray(picture.convert("L"))) > 200
    with open(out / "history.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == TASK.episode_steps + 1
    if "--case" in choice:  # the same as in the Monte Carlo
        replay = ["--replay-case", 3, "--cases", 5, "--seed", 1, "--history", tmp_path / "replayed.csv"]
        assert tiny.status("eval_mc", "--agent", agent, *replay) == 0
        assert (out / "history.csv").read_text() == (tmp_path / "replayed.csv").read_text()


REFUSED = {
    "unknown case": (("--case", 10_000), "case: must be from 0 to cases - 1 = 9999, got 10000"),
    "negative case": (("--case", -1), "case: must be from 0 to cases - 1 = 9999, got -1"),
    "two scenarios": (("--case", 1, "--scenario", "paper"), "scenario: give either --scenario paper or --case"),
    "seed of nothing": (("--seed", 1), "seed: is of the draw, and needs --case"),
    "seed": (("--case", 1, "--seed", -1), "seed: must be from 0 to 2^32 - 1, got -1"),
    "angles": (("--case", 1, "--max-angle-deg", 20, "--min-angle-deg", 0), "max_angle_deg: must be above 34 deg"),
    "agent": (("--agent", "nobody"), "agent: 'nobody' is neither a shipped agent"),
    "folder": (("--out", "file/out"), "out: the folder file/out cannot be written: Not a directory"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_fly_refuses_before_it_flies(name, agent, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(evaluation, "_keep_and_judge", lambda *_, **__: pytest.fail("something was flown"))
    Path("file").touch()
    argv, message = REFUSED[name]
    assert tiny.status("fly", "--agent", agent, *argv) == 2
    output = capsys.readouterr()
    assert output.err.startswith(f"error: {message}") and output.out == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["agent", "file"]


def test_eval_mc_draws_the_monte_carlo(agent, tmp_path, capsys):
    out = tmp_path / "figures"
    assert tiny.status("eval_mc", "--agent", agent, "--cases", tiny.CASES, "--figures", out) == 0
    assert re.search(r"figure: .*monte-carlo-samples\.png", capsys.readouterr().out)
    assert sorted(path.stem for path in out.iterdir()) == sorted(
        2 * ["monte-carlo-accuracy", "monte-carlo-relations", "monte-carlo-samples"]
    )


@pytest.mark.parametrize(
    "argv, message",
    [
        (("--figures", "file"), "figures: the folder file cannot be written: File exists"),
        (("--figures", "out", "--replay-case", 1), "figures: are of many cases, and not drawn with --replay-case"),
    ],
)
def test_eval_mc_refuses_figures_that_cannot_be(argv, message, agent, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(evaluation, "_fly_cases", lambda *_, **__: pytest.fail("something was flown"))
    Path("file").touch()
    assert tiny.status("eval_mc", "--agent", agent, *argv) == 2
    assert capsys.readouterr().err.startswith(f"error: {message}")
    assert not Path("out").exists()


WITHOUT_MATPLOTLIB = """
import sys
sys.modules["matplotlib"] = None
sys.argv = {argv}
import runpy
runpy.{run}
"""


@pytest.mark.parametrize(
    "run, argv",
    [
        ('run_path("fly.py", run_name="__main__")', ["fly.py"]),
        ('run_path("eval_mc.py", run_name="__main__")', ["eval_mc.py", "--figures", "{out}"]),
        (
            'run_module("koz_jax.figures.learning", run_name="__main__", alter_sys=True)',
            ["learning", "{run}", "--out", "{out}"],
        ),
    ],
)
def test_without_matplotlib_the_error_says_what_to_install(run, argv, tmp_path):
    folders = {"out": tmp_path / "out", "run": log(tmp_path / "run")}
    code = WITHOUT_MATPLOTLIB.format(run=run, argv=[arg.format(**folders) for arg in argv])
    done = tiny.run_python("-c", code)
    assert done.returncode == 2
    assert done.stderr.startswith('error: figures need matplotlib: pip install "koz_jax[viz]"'), done.stderr
    assert len(done.stderr.splitlines()) == 1 and not (tmp_path / "out").exists()


def test_drawing_leaves_the_settings_of_matplotlib_alone():
    history, result, task = flown()
    before = dict(matplotlib.rcParams)
    histories.draw(history, result, task)
    assert dict(matplotlib.rcParams) == before
