"""``koz fly``, and the figures of ``koz evaluate``: what they write, and what they refuse."""

import csv
import dataclasses
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support import tiny

from koz_jax.cli.flags import parsing
from koz_jax.cli.fly import FlyFlags
from koz_jax.config.maneuvers.maneuver_file import load_maneuver
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import SpacecraftConfig, TaskConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases


@pytest.mark.slow
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
        assert len(list(csv.DictReader(file))) == tiny.CONFIG.task.episode_steps + 1
    if "--case" in choice:  # the same as in the Monte Carlo
        replay = ["--replay-case", 3, "--cases", 5, "--seed", 1, "--history", tmp_path / "replayed.csv"]
        assert tiny.status("evaluate", "--agent", agent, *replay) == 0
        assert (out / "history.csv").read_text() == (tmp_path / "replayed.csv").read_text()


REFUSED = {
    "unknown case": (("--case", 10_000), "case: must be from 0 to cases - 1 = 9999, got 10000"),
    "negative case": (("--case", -1), "case: must be from 0 to cases - 1 = 9999, got -1"),
    "two scenarios": (("--case", 1, "--scenario", "paper"), "scenario: give either --scenario paper or --case"),
    "seed of nothing": (("--seed", 1), "seed: is of the draw, and needs --case"),
    "seed": (("--case", 1, "--seed", -1), "seed: Input should be greater than or equal to 0 (got -1)"),
    "angles": (("--case", 1, "--max-angle-deg", 20, "--min-angle-deg", 0), "max_angle_deg: must be above 34 deg"),
    "agent": (("--agent", "nobody"), "agent: 'nobody' is neither a shipped agent"),
    "folder": (("--out", "file/out"), "out: the folder file/out cannot be written: Not a directory"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_fly_refuses_before_it_flies(name, agent, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cases, "_keep_and_evaluate", lambda *_, **__: pytest.fail("something was flown"))
    Path("file").touch()
    argv, message = REFUSED[name]
    assert tiny.status("fly", "--agent", agent, *argv) == 2
    output = capsys.readouterr()
    assert output.err.startswith(f"error: {message}") and output.out == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["agent", "file"]


# --- maneuvers of one's own ---

PAPER, CUBESAT = (tiny.MANEUVER_FILES[name] for name in ("paper", "cubesat_6u"))
HALF = (0.7071, 0.0, 0.7071, 0.0)  # a quarter turn about y


def numbers(path: Path) -> np.ndarray:
    return np.loadtxt(io.StringIO(path.read_text()), delimiter=",", skiprows=1)


@pytest.mark.slow
def test_the_papers_file_is_flown_as_the_papers_scenario_is(tmp_path, capsys):
    ours, papers = tmp_path / "ours", tmp_path / "papers"
    written = tmp_path / "result.json"
    assert tiny.status("fly", PAPER, "--out", ours, "--json", written) == 0
    printed = capsys.readouterr().out
    assert tiny.status("fly", "--out", papers, "--substeps", 5) == 0
    first = capsys.readouterr().out.splitlines()[0]
    # What is printed has three digits, and the file's numbers are rounded a little differently.
    assert (
        printed.splitlines()[0].partition(": ")[2].split(", accuracy")[0]
        == (first.partition(": ")[2].split(", accuracy")[0])
    )
    np.testing.assert_allclose(numbers(ours / "history.csv"), numbers(papers / "history.csv"), atol=2e-4)
    report = json.loads(written.read_text())
    assert report["settled"] and not report["violated"] and f"written: {written}" in printed
    assert re.search(r"settling time \[s\] +1\d(\.\d+)? +27\.8\n", printed)
    assert "published: mean of the paper's Monte Carlo" in printed


@pytest.mark.slow
def test_a_maneuver_is_flown_without_a_file(tmp_path, capsys):
    """With the spacecraft of a file, and the cone in the way of its first instrument."""
    argv = ["--from", *HALF, "--to", 1, 0, 0, 0, "--keep-out", 0.7071, 0, 0.7071, 20, "--keep-out", 0, -1, 0, "2e1"]
    argv += ["--spacecraft", CUBESAT, "--controller", "pd", "--shield", "--json", tmp_path / "x.json"]
    assert tiny.status("fly", *argv, "--out", tmp_path / "out") == 0
    printed = capsys.readouterr().out
    assert printed.startswith("a turn of one's own: 90.0 deg") and "flown for 70 s" in printed
    report = json.loads((tmp_path / "x.json").read_text())
    assert len(report["margins_deg"]) == 2 and not report["violated"]


def parsed(*argv: object) -> FlyFlags:
    return parsing.parse(FlyFlags, [str(word) for word in argv], "koz fly")


def test_the_file_is_given_by_its_place_or_by_a_flag():
    expected = load_maneuver(PAPER)
    for argv in ([PAPER], ["--maneuver", PAPER], ["--shield", PAPER], [PAPER, "--agent", "phase1", "--seed", 3]):
        assert parsed(*argv).own_maneuver == expected
    assert parsed().own_maneuver is None


def test_flags_make_a_maneuver_of_the_agents_spacecraft():
    cones = ["--keep-in", 0, 0, -1, 170, "--keep-out", 0, 1.005, 0, 12]
    found = parsed("--from", *HALF, "--to", 1, 0, 0, 0, *cones).own_maneuver
    assert found is not None and found.task == TaskConfig()
    assert found.start.attitude == pytest.approx(HALF, abs=1e-5) and found.target.attitude == (1, 0, 0, 0)
    assert [(cone.kind, cone.direction, cone.half_angle_deg) for cone in found.constraints] == [
        ("keep_out", (0.0, 1.0, 0.0), 12.0),
        ("keep_in", (0.0, 0.0, -1.0), 170.0),
    ]


def _turn_of(spacecraft: SpacecraftConfig, tmp_path: Path) -> FlyFlags:
    """A turn with an agent that was made for a spacecraft."""
    untrained = tiny.untrained_agent()
    task = untrained.task.model_copy(update={"spacecraft": spacecraft})
    dataclasses.replace(untrained, task=task).save(tmp_path / "own")
    return parsed("--agent", tmp_path / "own", "--from", *HALF, "--to", 1, 0, 0, 0, "--keep-out", 0, 1, 0, 12)


def test_flags_take_the_agents_whole_spacecraft(tmp_path):
    """With its wheels and its rate limit."""
    leo = load_maneuver(tiny.MANEUVER_FILES["leo_6u"]).task.spacecraft
    for own in (leo, SpacecraftConfig(torque_limit=(1.0, 2.0, 3.0), max_rate_deg=5.0)):
        found = _turn_of(own, tmp_path).own_maneuver
        assert found is not None and found.task.spacecraft == own


def test_flags_refuse_an_agents_gyros_of_which_a_file_is_needed(tmp_path):
    own = load_maneuver(tiny.MANEUVER_FILES["cmg_smallsat"]).task.spacecraft
    with pytest.raises(SettingsError, match=r"spacecraft\.gyros: must be none, got 4; a file"):
        _turn_of(own, tmp_path)


def test_flags_take_the_spacecraft_of_a_file(tmp_path):
    (tmp_path / "body.toml").write_text(
        "step_seconds = 0.5\n[spacecraft]\ntorque_limit = [0.1, 0.1, 0.2]\ninertia = [[2, 0, 0], [0, 2, 0], [0, 0, 2]]"
    )
    turn = ["--from", *HALF, "--to", 1, 0, 0, 0, "--keep-out", 0, 1, 0, 12, "--spacecraft"]
    bare = parsed(*turn, tmp_path / "body.toml").own_maneuver
    assert bare is not None and bare.task.spacecraft.torque_limits == (0.1, 0.1, 0.2)
    assert bare.task.spacecraft.boresight == (1.0, 0.0, 0.0) and bare.seconds == 80.0
    whole = parsed(*turn, CUBESAT).own_maneuver
    assert whole is not None and whole.constraints[0].instrument == "telescope"
    assert whole.task.spacecraft == load_maneuver(CUBESAT).task.spacecraft


def test_errors_come_from_the_file_or_from_flags_and_are_what_robust_withstands(tmp_path):
    (tmp_path / "mine.toml").write_text(PAPER.read_text() + "\n[errors]\ninertia = 0.1\n")
    config = parsed(tmp_path / "mine.toml", "--shield", "--robust").config()
    assert config.uncertainty == UncertaintyConfig(inertia_error=0.1)
    assert isinstance(config.shield, ShieldConfig) and config.shield.error_bounds == config.uncertainty
    assert config.substeps == 5 and parsed(PAPER, "--substeps", 9).config().substeps == 9
    assert parsed("--json", "x.json").config().substeps == 5 and parsed().config().substeps == 1
    assert parsed(PAPER, "--inertia-error", 0.2).config().uncertainty == UncertaintyConfig(inertia_error=0.2)


def test_flags_in_radians_are_told_once(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cases, "_keep_and_evaluate", lambda *_, **__: pytest.fail("something was flown"))
    argv = ["--from", *HALF, "--to", 1, 0, 0, 0, "--keep-out", 0, 1, 0, 0.5236, "--out", tmp_path]
    with pytest.raises(pytest.fail.Exception):
        tiny.status("fly", *argv)
    told = capsys.readouterr().err
    assert (
        told.count("is it 0.5236 rad = 30.0 deg?") == 1 and "constraints.0.half_angle_deg: 0.5236 deg is small" in told
    )


TURN = ("--from", 1, 0, 0, 0, "--to", 0, 1, 0, 0)
REFUSED_TURNS = {
    "no file": (("no.toml",), "maneuver: no.toml cannot be read: No such file or directory"),
    "two files": ((PAPER, "--maneuver", PAPER), "maneuver: give one file, got"),
    "file and flags": ((PAPER, *TURN), "from: give either a maneuver file or --from"),
    "file and case": ((PAPER, "--case", 1), "case: is of the draw; give either --case or a maneuver, got 1"),
    "file and paper": ((PAPER, "--scenario", "paper"), "scenario: give either --scenario paper or a maneuver"),
    "file and draw": ((PAPER, "--zones", 2), "zones: is of the draw, and needs --case; a maneuver of one's own has"),
    "no target": (("--from", 1, 0, 0, 0), "from: needs --to too"),
    "no start": (("--to", 1, 0, 0, 0), "to: needs --from too"),
    "cone alone": (("--keep-out", 1, 0, 0, 20), "keep_out: needs --from and --to"),
    "cone to stay in alone": (("--keep-in", 1, 0, 0, 80), "keep_in: needs --from and --to"),
    "second cone to stay in": (
        (*TURN, "--keep-out", 0, 1, 0, 9, "--keep-in", 0, 0, 1, 99, "--keep-in", 0, 0, 2, 99),
        "keep_in.1.direction: must be a unit vector, of length 1",
    ),
    "body alone": (("--spacecraft", CUBESAT), "spacecraft: needs --from and --to"),
    "quaternion": (("--from", 1, 1, 0, 0, "--to", 1, 0, 0, 0), "from: must be a unit quaternion, scalar first"),
    "cone": ((*TURN, "--keep-out", 3, 4, 0, 20), "keep_out.0.direction: must be a unit vector, of length 1"),
    "half angle": ((*TURN, "--keep-out", 0, 1, 0, 200), "keep_out.0.half_angle_deg: Input should be less than 180"),
    "start inside": ((*TURN, "--keep-out", 1, 0, 0, 20), "from: must keep every constraint"),
    "no body": ((*TURN, "--spacecraft", "no.toml"), "spacecraft: no.toml cannot be read"),
    "urgency": ((CUBESAT, "--agent", "phase2", "--urgency", 0.2), "urgency: phase2 was trained for one trade"),
    "hurried law": ((CUBESAT, "--controller", "pd", "--urgency", 1), "urgency: is of agents, and pd has none"),
    "too urgent": ((CUBESAT, "--urgency", 1.5), "urgency: Input should be less than or equal to 1"),
    "controller": ((CUBESAT, "--controller", "nobody"), "controller: must be one of pd"),
    "json": ((PAPER, "--json", "no/x.json"), "json: the folder no of no/x.json does not exist"),
    "task": ((PAPER, "--task.step-seconds", 0.2), "task: a maneuver of one's own says what flies"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", REFUSED_TURNS)
def test_maneuvers_that_cannot_be_flown_are_refused_in_one_line(name, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cases, "_keep_and_evaluate", lambda *_, **__: pytest.fail("something was flown"))
    argv, message = REFUSED_TURNS[name]
    assert tiny.status("fly", *argv) == 2
    output = capsys.readouterr()
    assert output.err.startswith(f"error: {message}") and output.out == ""
    assert len(output.err.splitlines()) == 1


@pytest.mark.slow
def test_an_evaluation_draws_the_monte_carlo(agent, tmp_path, capsys):
    out = tmp_path / "figures"
    assert tiny.status("evaluate", "--agent", agent, "--cases", tiny.CASES, "--figures", out) == 0
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
def test_an_evaluation_refuses_figures_that_cannot_be(argv, message, agent, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cases, "_fly_cases", lambda *_, **__: pytest.fail("something was flown"))
    Path("file").touch()
    assert tiny.status("evaluate", "--agent", agent, *argv) == 2
    assert capsys.readouterr().err.startswith(f"error: {message}")
    assert not Path("out").exists()
