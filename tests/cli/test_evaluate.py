"""``koz evaluate`` as a user meets it: its table, its files, its errors."""

import csv
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import tiny

from koz_jax.cli.evaluate import EvaluateFlags
from koz_jax.cli.flags import parsing
from koz_jax.config.maneuvers.maneuver_file import load_spacecraft
from koz_jax.config.task import TaskConfig
from koz_jax.evaluation import cases

pytestmark = pytest.mark.usefixtures("empty_cwd")

JSON_KEYS = [
    *("cases", "seed", "agent", "mean_reward", "std_reward", "settling_time_mean", "settling_time_std"),
    *("control_effort_mean", "control_effort_std", "control_accuracy_deg_mean", "control_accuracy_deg_std"),
    *("non_settled_rate", "violation_rate", "success_rate"),
    *("min_margin_deg", "intervention_rate", "mean_torque_change", "deadlock_rate", "unsafe_start_rate"),
    *("infeasible_steps_mean", "infeasible_case_rate"),
    *("settling_time_scaled_mean", "control_effort_scaled_mean", "compile_s", "wall_s"),
]


@pytest.fixture
def no_flight(monkeypatch) -> None:
    """Make an error of any flight."""
    for name in ("_fly_cases", "_keep_and_evaluate"):
        monkeypatch.setattr(cases, name, lambda *_, **__: pytest.fail("something was flown"))


def refused(capsys: Any, *argv: object) -> str:
    """What a command line that is refused says."""
    assert tiny.status("evaluate", *argv) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert "Traceback" not in output.err
    assert 0 < len(output.err.splitlines()) <= 14
    return output.err


# Arguments, and what the message must say: the field, the value, what is allowed.
BAD = [
    ("--cases 0", ["cases: Input should be greater than 0 (got 0)"]),
    ("--cases -5", ["cases: Input should be greater than 0 (got -5)"]),
    ("--cases 1.5", ["cases: Input should be a valid integer", "1.5"]),
    ("--cases 1e-3", ["cases: Input should be a valid integer", "0.001"]),
    ("--cases many", ["cases: Input should be a valid integer", "many"]),
    ("--cases 1e10", ["cases: Input should be less than 2147483648 (got 10000000000"]),
    ("--seed -1", ["seed: Input should be greater than or equal to 0 (got -1)"]),
    ("--min-angle-deg nan", ["min_angle_deg: Input should be a finite number (got nan)"]),
    ("--max-angle-deg inf", ["max_angle_deg: Input should be a finite number (got inf)"]),
    ("--min-angle-deg 170 --max-angle-deg 100", ["max_angle_deg must be in [min_angle_deg = 170.0, 180]; got 100.0"]),
    ("--min-angle-deg 10 --max-angle-deg 30", ["max_angle_deg: must be above 34 deg", "got 30", "shrink"]),
    ("--substeps 0", ["substeps: Input should be greater than 0 (got 0)"]),
    ("--angle-convention quarter", ["--angle-convention", "quarter", "full", "half"]),
    ("--infeasible-zone skip", ["--infeasible-zone", "skip", "resample", "shrink"]),
    ("--replay-case 10000", ["replay_case: must be from 0 to cases - 1 = 9999, got 10000"]),
    ("--replay-case 5 --cases 5", ["replay_case: must be from 0 to cases - 1 = 4, got 5"]),
    ("--replay-case -1", ["replay_case: must be from 0 to cases - 1 = 9999, got -1"]),
    ("--replay-case abc", ["replay_case: Input should be a valid integer", "abc"]),
    ("--replay-case 1 --json x.json", ["json: is not written with --replay-case", "x.json"]),
    ("--replay-case 1 --csv x.csv", ["csv: is not written with --replay-case", "x.csv"]),
    ("--replay-case 1 --history nowhere/x.csv", ["history: the folder nowhere of nowhere/x.csv does not exist"]),
    ("--history x.csv", ["history: is written by --replay-case only, got x.csv"]),
    ("--json nowhere/x.json", ["json: the folder nowhere of nowhere/x.json does not exist"]),
    ("--csv nowhere/x.csv", ["csv: the folder nowhere of nowhere/x.csv does not exist"]),
    ("--json .", ["json: . must be a new or an ordinary file"]),
    ("--csv /dev/null", ["csv: /dev/null must be a new or an ordinary file"]),
    ("--colour red", ["--colour"]),
    ("--robust", ["robust: is of the shield, and needs --shield"]),
    ("--shield-margin-deg 1", ["shield_margin_deg: needs --shield, got 1.0"]),
    ("--shield --filter zoh_cbf", ["filter: give either --shield or --filter, got --filter zoh_cbf and --shield"]),
    ("--filter zoh_cbf --robust", ["robust: is of the shield, and needs --shield"]),
    ("--shield --robust", ["robust: needs an error to withstand"]),
    ("--shield --shield-margin-deg 0", ["shield_margin_deg: Input should be greater than 0"]),
    (
        "--shield --robust --disturbance-torque 3",
        ["disturbance_torque: must be below 0.5 times the torque limit of 2.0", "3.0"],
    ),
    ("--inertia-error 1.5", ["inertia_error", "less than 1", "1.5"]),
    ("--controller nobody", ["controller: must be one of pd, potential", "FILE.py:CLASS", "nobody"]),
    ("--task.step-seconds -1", ["task.step_seconds: Input should be greater than 0 (got -1.0)"]),
    ("--task.spacecraft.boresight 1 1 0", ["task.spacecraft: boresight must be a unit vector", "(1.0, 1.0, 0.0)"]),
    ("--task.spacecraft.mass 3", ["--task.spacecraft.mass"]),
    ("--zones 9", ["zones", "less than or equal to 8", "9"]),
    ("--max-rate-deg -1", ["max_rate_deg", "greater than or equal to 0", "-1"]),
]


@pytest.mark.slow
@pytest.mark.parametrize(("argv", "words"), BAD, ids=[argv for argv, _ in BAD])
@pytest.mark.usefixtures("no_flight")
def test_bad_input_is_refused_by_name_before_anything_happens(capsys, agent, empty_cwd, argv, words):
    message = refused(capsys, "--agent", agent, *argv.split())
    for word in words:
        assert word in message
    assert list(empty_cwd.iterdir()) == []


@pytest.mark.parametrize(("word", "count"), [("1e4", 10_000), ("10_000", 10_000), ("12", 12), ("1.2e1", 12)])
def test_whole_numbers_may_be_written_in_any_way(word, count):
    assert parsing.parse(EvaluateFlags, ["--cases", word], "koz evaluate").cases == count


@pytest.mark.usefixtures("no_flight")
def test_a_value_that_is_no_whole_number_is_refused_in_one_line(capsys):
    assert len(refused(capsys, "--cases", "1.5").splitlines()) == 1


@pytest.mark.usefixtures("no_flight")
def test_an_unwritable_place_is_refused(capsys, agent):
    if not Path("/proc/self").exists():
        pytest.skip("needs a folder in which not even root can write")
    for name in ("json", "csv"):
        message = refused(capsys, "--agent", agent, f"--{name}", f"/proc/x.{name}")
        assert f"{name}: /proc/x.{name} cannot be written: " in message


@pytest.mark.parametrize("name", ["nobody", "", ".", "nowhere/run"])
@pytest.mark.usefixtures("no_flight")
def test_an_unknown_agent_is_refused_and_the_known_are_listed(capsys, monkeypatch, name):
    monkeypatch.setattr("koz_jax.agents.record.shipped_agents", lambda: ("alpha", "beta"))
    message = refused(capsys, "--agent", name)
    assert message.startswith(f"error: agent: {name!r} is neither a shipped agent (alpha, beta) nor a folder with")


@pytest.mark.usefixtures("no_flight")
def test_a_damaged_agent_is_refused(capsys, agent):
    (agent / "arrays.npz").write_bytes(b"")
    assert f"{agent}/arrays.npz: damaged" in refused(capsys, "--agent", agent)
    (agent / "record.json").write_text("{")
    assert f"{agent}/record.json: cannot be read as JSON" in refused(capsys, "--agent", agent)


def test_help_describes_every_flag(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")  # wider, it would have two columns
    assert tiny.status("evaluate", "--help") == 0
    # Wrapped lines and their frame do not count.
    text = re.sub(r"[\s│|]", "", capsys.readouterr().out)
    assert len(EvaluateFlags.model_fields) >= 25
    for name, field in EvaluateFlags.model_fields.items():
        assert f"--{(field.alias or name).replace('_', '-')}" in text
        assert field.description
        assert re.sub(r"[\s|]", "", field.description) in text, name


@pytest.mark.slow
def test_table_json_and_csv_tell_the_same(capsys, run, empty_cwd):
    argv = ["--agent", run.path, "--cases", tiny.CASES, "--seed", 5, "--json", "x.json", "--csv", "x.csv"]
    assert tiny.status("evaluate", *argv) == 0
    output = capsys.readouterr().out
    text = (empty_cwd / "x.json").read_text()
    report = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert list(report) == JSON_KEYS
    assert (report["cases"], report["seed"], report["agent"]) == (tiny.CASES, 5, str(run.path))
    # Two seconds are too short to settle: what is over settled cases only is null.
    assert report["non_settled_rate"] == 1.0 and report["success_rate"] == 0.0
    assert [name for name in JSON_KEYS if report[name] is None] == [
        name for name in JSON_KEYS if "control" in name or "settling" in name
    ]

    rows = list(csv.DictReader((empty_cwd / "x.csv").read_text().splitlines()))
    assert [int(row["case"]) for row in rows] == list(range(tiny.CASES))
    rewards = np.array([float(row["reward"]) for row in rows])
    np.testing.assert_allclose(rewards.mean(), report["mean_reward"], rtol=1e-6)
    np.testing.assert_allclose(rewards.std(), report["std_reward"], rtol=1e-6)
    assert np.mean([int(row["violated"]) for row in rows]) == report["violation_rate"]
    assert np.mean([row["settled"] == "0" for row in rows]) == report["non_settled_rate"]

    assert f"{report['mean_reward']:.2f} +- {report['std_reward']:.2f}" in output
    assert "7281.91" not in output  # the paper's number is of another task
    assert re.search(r"not settled .*100\.00 %  \[\d+\.\d\d, 100\.00\]", output)
    assert re.search(r"compiled in \d+\.\d s, flown in \d+\.\d s", output)
    assert sorted(path.name for path in empty_cwd.iterdir()) == ["x.csv", "x.json"]


def test_files_are_replaced_whole(agent, empty_cwd):
    (empty_cwd / "x.json").write_text("old" * 10_000)
    assert tiny.status("evaluate", "--agent", agent, "--cases", tiny.CASES, "--json", "x.json") == 0
    assert json.loads((empty_cwd / "x.json").read_text())["cases"] == tiny.CASES


@pytest.mark.slow
def test_a_replayed_case_ends_like_its_row(capsys, run, empty_cwd):
    draw = ["--agent", run.path, "--cases", tiny.CASES, "--seed", 5]
    assert tiny.status("evaluate", *draw, "--csv", "all.csv") == 0
    assert tiny.status("evaluate", *draw, "--replay-case", 3) == 0
    assert tiny.status("evaluate", *draw, "--replay-case", 3, "--history", "other.csv") == 0
    rows = list(csv.DictReader((empty_cwd / "all.csv").read_text().splitlines()))
    history = list(csv.DictReader((empty_cwd / "case-3.csv").read_text().splitlines()))
    row, start, end = rows[3], history[0], history[-1]
    assert float(start["phi_deg"]) == pytest.approx(float(row["initial_angle_deg"]), rel=1e-5)
    assert float(end["phi_deg"]) == pytest.approx(float(row["control_accuracy_deg"]), rel=1e-4)
    margins = [float(instant["theta_margin_deg"]) for instant in history]
    assert min(margins) == pytest.approx(float(row["min_margin_deg"]), rel=1e-4)
    effort = sum(0.1 * float(instant[f"torque_{axis}_Nm"]) ** 2 for instant in history[:-1] for axis in "xyz")
    assert effort == pytest.approx(float(row["control_effort_N2m2s"]), rel=1e-4)
    assert (empty_cwd / "other.csv").read_text() == (empty_cwd / "case-3.csv").read_text()
    output = capsys.readouterr().out
    assert f"case 3: {float(row['initial_angle_deg']):.1f} deg, not settled" in output
    assert "history: case-3.csv" in output and "history: other.csv" in output


def test_the_rules_can_be_changed(capsys, agent, empty_cwd):
    argv = ["--agent", agent, "--cases", tiny.CASES]
    for convention in ("full", "half"):
        assert tiny.status("evaluate", *argv, "--angle-convention", convention, "--csv", f"{convention}.csv") == 0
    full, half = (
        [
            float(row["control_accuracy_deg"])
            for row in csv.DictReader((empty_cwd / f"{name}.csv").read_text().splitlines())
        ]
        for name in ("full", "half")
    )
    np.testing.assert_allclose(half, 0.5 * np.array(full), rtol=1e-6)


@pytest.mark.slow
def test_the_command_itself(run, empty_cwd):
    done = tiny.run_python(
        tiny.ROOT / "eval_mc.py", "--agent", run.path, "--cases", 12, "--json", "x.json", cwd=empty_cwd
    )
    assert done.returncode == 0
    (warning,) = done.stderr.splitlines()  # two seconds are too short
    assert warning.startswith("warning: task.spacecraft: a turn by 80 deg takes 11.1 s or more")
    assert "12 cases" in done.stdout
    assert list(json.loads((empty_cwd / "x.json").read_text())) == JSON_KEYS


@pytest.mark.slow
def test_an_agent_flies_ones_own_spacecraft_from_the_command_line(capsys, agent, empty_cwd):
    """What is given changes the agent's own task and nothing else, and it is told that it was not made for that."""
    own = ["--task.spacecraft.inertia", *"12 0 0 0 10 0 0 0 8".split(), "--task.spacecraft.torque-limit=0.4"]
    asked = parsing.parse(EvaluateFlags, [*own, "--task.step_seconds", "0.1"], "koz evaluate")
    made_for = tiny.untrained_agent()
    task = asked.task(made_for)
    assert task == TaskConfig.model_validate(
        tiny.merged(
            made_for.task.model_dump(),
            {"spacecraft": {"inertia": ((12, 0, 0), (0, 10, 0), (0, 0, 8)), "torque_limit": 0.4}},
        )
    )
    assert parsing.parse(EvaluateFlags, [], "koz evaluate").task(made_for) == made_for.task
    rows = []
    for name, argv in (("own", own), ("agents", [])):
        assert tiny.status("evaluate", "--agent", agent, "--cases", tiny.CASES, "--csv", name, *argv) == 0
        told = capsys.readouterr()
        assert ("was not made for this: moments of inertia of 12, 10, 8" in told.err) == bool(argv)
        rows.append(list(csv.DictReader((empty_cwd / name).read_text().splitlines())))
    assert [row["control_effort_N2m2s"] for row in rows[0]] != [row["control_effort_N2m2s"] for row in rows[1]]


def test_a_value_that_is_the_papers_takes_the_place_of_the_agents():
    asked = parsing.parse(EvaluateFlags, ["--task.episode-seconds", "100"], "koz evaluate")
    assert tiny.untrained_agent().task.episode_seconds == 2.0
    assert asked.task(tiny.untrained_agent()).episode_seconds == 100.0


@pytest.mark.slow
def test_a_platform_that_is_not_there_is_named_in_a_line(empty_cwd, agent):
    environment = tiny.environment() | {"JAX_PLATFORMS": "cuda"}
    command = [sys.executable, "-m", "koz_jax", "evaluate", "--agent", str(agent), "--cases", "2"]
    done = subprocess.run(command, env=environment, cwd=empty_cwd, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        pytest.skip("it is there")
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2 and line.startswith("error: JAX_PLATFORMS: 'cuda' cannot be used (")


def test_another_spacecraft_is_flown_in_its_own_units(tmp_path):
    """The draw is the paper's; times and rates follow T = sqrt(J / u), and scaled results are in the paper's units."""
    path = tmp_path / "small.toml"
    path.write_text(
        "step_seconds = 0.05\n[spacecraft]\n"
        "inertia = [[0.06, 0.005, 0.001], [0.005, 0.05, 0.002], [0.001, 0.002, 0.07]]\n"
        "torque_limit = 0.02\n[[instruments]]\nname = 'telescope'\nboresight = [1, 0, 0]\n"
    )
    task = load_spacecraft(path).task
    # The paper's shape with J / u a tenth: everything takes sqrt(1 / 10) of the time.
    assert task.episode_seconds == pytest.approx(100.0 / 10**0.5)
    assert task.scenario.max_rate_deg == pytest.approx(0.001 * 10**0.5)
    assert task.time_to_paper == pytest.approx(10**0.5)
    assert task.effort_to_paper == pytest.approx(100.0**2 * 10**0.5)


@pytest.mark.parametrize(
    ("argv", "name"),
    [
        ("", "phase2"),
        ("--spacecraft random", "universal"),
        ("--urgency 0.2", "universal"),
        ("--agent phase2 --spacecraft random", "phase2"),
        ("--agent phase2 --urgency 0.2", "phase2"),
        ("--agent zones3 --spacecraft random", "zones3"),
    ],
)
def test_an_agent_that_is_named_is_flown_and_where_none_is_the_one_that_is_for_it(argv, name):
    assert parsing.parse(EvaluateFlags, argv.split(), "koz evaluate").name == name


@pytest.mark.slow
def test_a_named_agent_of_one_spacecraft_is_flown_on_another_and_does_not_hurry(capsys):
    """In place of another agent that can."""
    cubesat = tiny.MANEUVER_FILES["cubesat_6u"]
    assert tiny.status("evaluate", "--agent", "phase2", "--spacecraft", cubesat, "--cases", tiny.CASES) == 0
    told = capsys.readouterr()
    assert "phase2" in told.out and "universal" not in told.out
    assert "phase2 was not made for this: " in told.err
    drawn = "zones are drawn at random for its first instrument, 'telescope'; 1 constraints of"
    assert sum(drawn in line for line in told.err.splitlines()) == 1
    assert "urgency: phase2 was trained for one trade" in refused(capsys, "--agent", "phase2", "--urgency", 0.8)


def test_a_spacecraft_that_cannot_be_read_is_refused(capsys, no_flight):
    assert "spacecraft: no.toml cannot be read" in refused(capsys, "--spacecraft", "no.toml")
    assert "urgency: phase1 was trained for one trade" in refused(capsys, "--agent", "phase1", "--urgency", 0.1)
