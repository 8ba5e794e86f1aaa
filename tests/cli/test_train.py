"""``koz train`` as a user meets it: its help, its errors, its signals, its output."""

import dataclasses
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from support import tiny

import koz_jax.runs.trainer
from koz_jax.agents.agent import load_agent
from koz_jax.cli import train as train_cli
from koz_jax.cli.train import TrainFlags, parse
from koz_jax.config.base import Settings
from koz_jax.config.maneuvers.maneuver_file import load_spacecraft
from koz_jax.config.presets.named import PRESETS, preset
from koz_jax.config.presets.spacecraft import for_spacecraft
from koz_jax.config.training import TrainConfig
from koz_jax.learning import train_step
from koz_jax.runs import checkpoint, memory
from koz_jax.runs.folder import RunFolder
from koz_jax.storage import archive, files


@pytest.fixture
def no_training(monkeypatch) -> None:
    """Make an error of any training."""
    monkeypatch.setattr(train_step, "init", lambda *_: pytest.fail("networks were made"))
    monkeypatch.setattr(train_step, "train_chunk", lambda *_: pytest.fail("something was learned"))


def no_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out what is not about the command line: shapes and what they take of the memory."""
    monkeypatch.setattr(checkpoint, "template", mock.MagicMock())
    monkeypatch.setattr(memory, "check", lambda *_: None)


def refused(capsys: Any, *argv: object) -> str:
    """What a command line that is refused says."""
    assert tiny.status("train", *argv) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert "Traceback" not in output.err
    assert 0 < len(output.err.splitlines()) <= 12
    return output.err


def fields(settings: Settings, prefix: str = "--") -> Iterator[tuple[str, str]]:
    """Flag and description of every field."""
    for name, field in type(settings).model_fields.items():
        flag = prefix + name.replace("_", "-")
        value = getattr(settings, name)
        if isinstance(value, Settings):
            yield from fields(value, f"{flag}.")
        else:
            yield flag, field.description or "no description"


INERTIA = "--task.spacecraft.inertia"
# Arguments, and what the message must say: the field, the value, what is allowed.
BAD = [
    (f"{INERTIA} 1 0 0 0 1 0 0 0 -1", ["task.spacecraft", "inertia must be positive definite", "-1.0"]),
    (f"{INERTIA} 1 0.5 0 0 1 0 0 0 1", ["task.spacecraft", "inertia must be symmetric", "0.5"]),
    (f"{INERTIA} 1 0 0 0 1 0 0 0 3", ["task.spacecraft", "inertia must obey the triangle inequality", "3.0"]),
    (f"{INERTIA} 1 0 0", [INERTIA, "Expected 9 values"]),
    ("--task.spacecraft.boresight 1 1 0", ["task.spacecraft", "boresight must be a unit vector", "(1.0, 1.0, 0.0)"]),
    ("--task.scenario.max-half-angle-deg 180", ["task.scenario.max_half_angle_deg", "less than 180", "got 180.0"]),
    ("--task.scenario.min-half-angle-deg 0", ["task.scenario.min_half_angle_deg", "greater than 0", "got 0.0"]),
    ("--task.angle-convention quarter", ["--task.angle-convention", "quarter", "full", "half"]),
    ("--eval-min-angle-deg 170 --eval-max-angle-deg 100", ["eval_min_angle_deg must be at most", "170.0", "100.0"]),
    ("--curriculum.phase1.max-angle-deg 0 10 0.5 300", ["curriculum.phase1", "max_angle_deg", "180", "300"]),
    ("--curriculum.phase1.max-angle-deg 0 10 0.5", ["--curriculum.phase1.max-angle-deg"]),
    ("--sac.batch-size 300 --sac.buffer-size 200", ["sac.batch_size must be at most sac.buffer_size", "300", "200"]),
    ("--sac.reward-scale nan", ["sac.reward_scale", "finite number", "nan"]),
    ("--sac.reward-scale inf", ["sac.reward_scale", "finite number", "inf"]),
    ("--seed -1", ["seed", "greater than or equal to 0", "got -1"]),
    ("--seed 99999999999999999999", ["seed", "less than 4294967296", "9999999999"]),
    ("--seed nan", ["seed: Input should be a finite number", "nan"]),
    ("--num-envs abc", ["num_envs: Input should be a valid integer", "abc"]),
    ("--num-envs 0", ["num_envs", "greater than 0", "got 0"]),
    ("--cases 0", ["cases: Input should be greater than 0 (got 0)"]),
    ("--cases -5", ["cases: Input should be greater than 0 (got -5)"]),
    ("--cases abc", ["cases: Input should be a valid integer", "abc"]),
    ("--preset quick", [f"preset: unknown preset 'quick'; allowed: {', '.join(PRESETS)}"]),
    ("--preset", [f"preset: unknown preset ''; allowed: {', '.join(PRESETS)}"]),
    ("--colour red", ["--colour"]),
    ("surplus", ["surplus"]),
    ("--resume nowhere", ["resume: nowhere is not a run folder (it has no config.json)"]),
    ("--resume .", ["resume: . is not a run folder (it has no config.json)"]),
    ("--resume", ["--resume"]),
    (f"--resume {'x' * 300}", ["resume: xxx", "is not a run folder"]),
    ("--spacecraft nowhere.toml", ["spacecraft: nowhere.toml cannot be read"]),
    ("--spacecraft", ["--spacecraft"]),
    ("--start-from nowhere", ["start_from: nowhere is neither a run with a checkpoint nor a snapshot"]),
]


@pytest.mark.slow
@pytest.mark.parametrize(("argv", "words"), BAD, ids=[argv[:60] for argv, _ in BAD])
@pytest.mark.usefixtures("no_training")
def test_bad_input_is_refused_by_name_before_anything_happens(capsys, monkeypatch, empty_cwd, argv, words):
    no_shapes(monkeypatch)
    message = refused(capsys, *argv.split())
    for word in words:
        assert word in message
    assert list(empty_cwd.iterdir()) == []


@pytest.mark.slow
def test_bad_settings_are_refused_before_jax_is_even_loaded(tmp_path):
    argvs = [argv.split() for argv, _ in BAD if "resume" not in argv and "start-from" not in argv][::3]
    code = (
        "import sys\nfrom koz_jax.cli.main import main\n"
        f"for argv in {argvs!r}:\n"
        "    try: status = main(['train', *argv])\n"
        "    except SystemExit as end: status = end.code\n"
        "    assert status == 2, argv\n"
        "assert 'jax' not in sys.modules\n"
    )
    done = tiny.run_python("-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]
    assert list(tmp_path.iterdir()) == []


def test_several_bad_settings_are_reported_at_once(capsys, empty_cwd):
    message = refused(capsys, "--num-envs", 0, "--sac.n-step", 0, "--task.step-seconds", -1)
    assert [line.split(":")[:2] for line in message.splitlines()] == [
        ["error", " task.step_seconds"],
        ["error", " sac.n_step"],
        ["error", " num_envs"],
    ]


@pytest.mark.slow
@pytest.mark.usefixtures("no_training")
def test_an_existing_run_is_not_overwritten(capsys, run, empty_cwd):
    before = tiny.contents(run.path)
    message = refused(capsys, "--run", run.path)
    assert (
        message
        == f"error: run: {run.path} exists already; resume it with --resume {run.path}, or choose another folder\n"
    )
    (empty_cwd / "mine.txt").write_text("my work")
    assert "run: . exists already" in refused(capsys, "--run", ".")
    assert f"run: {run.config} exists already" in refused(capsys, "--run", run.config)
    assert tiny.contents(run.path) == before
    assert tiny.contents(empty_cwd) == {empty_cwd / "mine.txt": b"my work"}


@pytest.mark.usefixtures("no_training")
def test_a_run_folder_that_cannot_be_made_is_named(capsys, empty_cwd):
    (empty_cwd / "file").write_text("")
    assert "run: file/run cannot be created: Not a directory" in refused(capsys, "--run", "file/run")
    if Path("/proc/self").exists():  # a place where not even root may write
        assert "run: /proc/run cannot be created: " in refused(capsys, "--run", "/proc/run")


@pytest.mark.parametrize(
    "others",
    [
        "--seed 3",
        "--preset paper",
        "--spacecraft mine.toml",
        "--preset=fast",
        "--run other",
        "--start-from other",
        "--num-envs=4",
        "--preset",
    ],
)
@pytest.mark.usefixtures("no_training")
def test_resume_takes_no_other_settings(capsys, run, empty_cwd, others):
    before = tiny.contents(run.path)
    for argv in (["--resume", run.path, *others.split()], [*others.split(), f"--resume={run.path}"]):
        message = refused(capsys, *argv)
        assert "resume" in message and others.replace("=", " ").split()[0] in message
    assert tiny.contents(run.path) == before


@pytest.mark.slow
@pytest.mark.usefixtures("no_training")
def test_a_tampered_run_is_not_resumed(capsys, run, tmp_path, monkeypatch):
    no_shapes(monkeypatch)
    content = json.loads(run.config.read_text())
    for change, reason in [
        ({"num_envs": 0}, "num_envs: Input should be greater than 0 (got 0)"),
        ({"colour": "red"}, "colour: Extra inputs are not permitted (got 'red')"),
        ({"seed": 5}, "resume: seed is 5, but"),
    ]:
        folder = RunFolder(tmp_path / next(iter(change)))
        folder.path.mkdir()
        folder.config.write_text(json.dumps(content | change))
        archive.save_tree(folder.checkpoint(0), {}, {"config": content})
        assert reason in refused(capsys, "--resume", folder.path)


def test_help_names_and_describes_every_setting(capsys):
    assert tiny.status("train", "--help") == 0
    text = capsys.readouterr().out
    flags = set(re.findall(r"--[a-z0-9.-]+", text))
    # Wrapped lines and their frame do not count.
    text = re.sub(r"[\s│]", "", text)
    described = list(fields(preset("fast")))
    assert len(described) > 60
    for flag, description in described:
        assert flag in flags
        if flag != "--preset":
            assert re.sub(r"\s", "", description) in text, flag
    assert f"Settingstobeginfrom:{','.join(PRESETS)}" in text
    assert {"--run", "--resume", "--start-from", "--cases"} <= flags


@pytest.mark.slow
def test_help_cut_short_by_its_reader_ends_quietly():
    with subprocess.Popen(
        [sys.executable, tiny.ROOT / "train.py", "--help"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


def test_help_of_a_preset_shows_its_values(capsys):
    for argv in (["--preset", "paper", "--help"], ["--preset", "paper", "--resume", "x", "-h"]):
        assert tiny.status("train", *argv) == 0
        assert "(default: 1000000)" in capsys.readouterr().out


@pytest.mark.slow
def test_every_setting_can_be_given_as_a_flag():
    for name in PRESETS:
        other = "fast" if name == "paper" else "paper"
        wanted = preset(name)
        settings = wanted.model_dump()
        del settings["preset"]
        config, _ = parse(["--preset", other, *tiny.flags(settings)])
        assert config == wanted.model_copy(update={"preset": other})
    assert parse([]) == (preset("fast"), TrainFlags())
    assert parse(tiny.FLAGS)[0] == tiny.CONFIG


def test_wheels_are_rows_of_six_numbers(capsys):
    rows = "1 0 0 2 20 0  0 1 0 2 20 -3  0 0 1 2 20 0.5".split()
    config, _ = parse(["--task.spacecraft.wheels", *rows])
    found = config.task.spacecraft.wheels
    assert [wheel.axis for wheel in found] == [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
    assert [(wheel.max_torque, wheel.max_momentum, wheel.momentum) for wheel in found] == [
        (2.0, 20.0, 0.0),
        (2.0, 20.0, -3.0),
        (2.0, 20.0, 0.5),
    ]
    assert tiny.status("train", "--task.spacecraft.wheels", *rows[:-1], "x") == 2
    assert "task.spacecraft.wheels.2.momentum: Input should be a valid number" in capsys.readouterr().err


def test_arguments_reach_the_training(monkeypatch, capsys, empty_cwd):
    calls = []

    def train(config: TrainConfig, run: Path, **options: Any) -> None:
        calls.append((config, run, options))

    monkeypatch.setattr(koz_jax.runs.trainer, "train", train)
    assert tiny.status("train", "--seed", 7, "--preset", "paper", "--start-from", "other") == 0
    assert tiny.status("train", "--run", "my run") == 0
    (config, run, options), (_, named, _) = calls
    assert config == preset("paper").model_copy(update={"seed": 7})
    assert options == {
        "resume": False,
        "start_from": Path("other"),
        "devices": 1,
        "command": "koz train --seed 7 --preset paper --start-from other",
    }
    assert re.fullmatch(r"runs/paper-seed7-\d{8}-\d{6}", str(run))
    assert named == Path("my run")
    assert capsys.readouterr().err.splitlines() == [
        f"stopped; go on with: koz train --resume {run}",
        "stopped; go on with: koz train --resume 'my run'",
    ]


def test_ctrl_c_outside_training_ends_without_a_traceback(monkeypatch, capsys, empty_cwd):
    def train(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(koz_jax.runs.trainer, "train", train)
    assert tiny.status("train") == 130
    assert capsys.readouterr().err == "interrupted\n"


# Runs train.py on one core (as the run it is compared with), and sends it a signal when so much is done.
DRIVER = """
import os, runpy, signal, sys
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from koz_jax.runs.progress import Progress
stop_at, sys.argv = int(sys.argv[1]), sys.argv[2:]
advance = Progress.advance
def advance_and_signal(bar, done):
    advance(bar, done)
    if done == stop_at:
        os.kill(os.getpid(), signal.SIGTERM)
Progress.advance = advance_and_signal
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def drive(stop_at: int, *argv: object) -> subprocess.CompletedProcess[str]:
    return tiny.run_python("-c", DRIVER, stop_at, tiny.ROOT / "train.py", *argv)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the number of devices would not be the same")
def test_a_run_ended_by_sigterm_and_resumed_equals_the_undisturbed_one(run, tmp_path, capsys):
    folder = RunFolder(tmp_path / "run")
    stopped = drive(48, "--run", folder.path, *tiny.FLAGS)
    assert (stopped.returncode, stopped.stdout) == (0, ""), stopped.stderr
    assert "SIGTERM: finishing the chunk, then checkpointing" in stopped.stderr
    assert f"run folder: {folder.path}" in stopped.stderr
    assert f"stopped; go on with: python {tiny.ROOT / 'train.py'} --resume {folder.path}" in stopped.stderr
    assert json.loads((folder.checkpoints()[0] / "record.json").read_text())["done"] == 48
    assert folder.read_config() == run.read_config() == tiny.CONFIG

    assert tiny.status("train", "--resume", folder.path, "--cases", tiny.CASES) == 0
    told = capsys.readouterr().out
    for saved in ("checkpoints/0000000136", "snapshots/phase1", "agents/phase1", "agents/phase2", "agents/phase2-sac"):
        with np.load(folder.path / saved / "arrays.npz") as found, np.load(run.path / saved / "arrays.npz") as expected:
            assert found.files == expected.files
            for name in found.files:
                np.testing.assert_array_equal(found[name], expected[name], err_msg=f"{saved} {name}", strict=True)
    assert (folder.path / "metrics.csv").read_bytes() == (run.path / "metrics.csv").read_bytes()

    # It ends with the table, its numbers as JSON, and a hint.
    assert f"{tiny.CASES} cases" in told and "mean reward" in told
    assert told.rstrip().endswith(f"koz evaluate --agent {folder.path} --csv cases.csv")
    evaluated = files.read_json(folder.evaluation)
    assert (evaluated["cases"], evaluated["agent"]) == (tiny.CASES, str(folder.path))


def test_a_finished_run_is_evaluated_again(run, tmp_path, capsys, monkeypatch):
    shutil.copytree(run.path, tmp_path / "run")
    monkeypatch.setattr(train_step, "train_chunk", lambda *_: pytest.fail("something was learned"))
    assert tiny.status("train", "--resume", tmp_path / "run", "--cases", tiny.CASES) == 0
    assert f"{tiny.CASES} cases" in capsys.readouterr().out
    assert files.read_json(RunFolder(tmp_path / "run").evaluation)["cases"] == tiny.CASES


@pytest.mark.slow
def test_a_resumed_run_keeps_the_cases_that_it_was_begun_with(run, tmp_path, capsys, monkeypatch):
    shutil.copytree(run.path, tmp_path / "run")
    folder = RunFolder(tmp_path / "run")
    folder.write_command(f"koz train --preset short --cases={tiny.CASES}.0 --run run")
    assert tiny.status("train", "--resume", folder.path) == 0
    shown = capsys.readouterr().out
    assert files.read_json(folder.evaluation)["cases"] == tiny.CASES
    assert re.search(rf"{folder.path} takes \d+ MB, most of it to resume from; make it small with: koz trim", shown)
    assert tiny.status("train", "--resume", folder.path, "--cases", 5) == 0
    assert files.read_json(folder.evaluation)["cases"] == 5


@pytest.mark.slow
def test_the_command_that_begins_a_run_is_kept_in_its_folder(monkeypatch, tmp_path, capsys):
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(train_step, "train_chunk", interrupted)
    argv = ["--run", str(tmp_path / "run"), *tiny.FLAGS, "--cases", "7"]
    assert tiny.status("train", *argv) == 130
    assert RunFolder(tmp_path / "run").read_command() == shlex.join(["koz", "train", *argv])


@pytest.mark.usefixtures("no_training")
def test_units_of_which_nothing_can_be_learned_are_refused(capsys, monkeypatch, empty_cwd):
    no_shapes(monkeypatch)
    message = refused(capsys, INERTIA, *"6e7 5e6 1e6 5e6 5e7 2e6 1e6 2e6 7e7".split())
    assert "task.spacecraft: a turn by 80 deg takes 1.11e+04 s or more" in message and "kg m^2 and N m?" in message
    assert "never drawn above 88 deg" in refused(capsys, "--task.scenario.max-half-angle-deg", 95)
    assert list(empty_cwd.iterdir()) == []


def test_a_refinement_in_vain_is_told_below_the_table(run, tmp_path, capsys):
    shutil.copytree(run.path, tmp_path / "run")
    folder = RunFolder(tmp_path / "run")
    agent = load_agent(folder.path)
    for refinements, told in ((0, True), (4, False)):
        record = agent.provenance.model_copy(update={"updates": 96, "refinements": refinements})
        train_cli._report(dataclasses.replace(agent, provenance=record), tiny.CONFIG, 5, folder.path)
        shown = capsys.readouterr().out
        assert ("refinement did not improve the agent; kept the one of update 96" in shown) == told


def test_trim_removes_what_only_a_resume_needs(run, tmp_path, capsys):
    shutil.copytree(run.path, tmp_path / "seeds" / "seed-0")
    (tmp_path / "seeds" / "seeds.json").write_text("{}")
    shutil.copytree(run.path, tmp_path / "run")
    assert tiny.status("trim", tmp_path / "run", tmp_path / "seeds") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and all("MB removed" in line and "MB left" in line for line in lines)
    for folder in (tmp_path / "run", tmp_path / "seeds" / "seed-0"):
        assert not (folder / "checkpoints").exists() and (folder / "agents" / "phase2").exists()
    assert tiny.status("trim", tmp_path) == 2
    assert "run: " in (told := capsys.readouterr().err) and "is not a run folder" in told
    assert tiny.status("trim") == 2


def test_another_spacecraft_comes_from_a_file_and_flags_change_what_it_gives():
    file = tiny.ROOT / "examples" / "cubesat_6u.toml"
    config, _ = parse(["--spacecraft", str(file), "--refine.iterations", "7"])
    assert config == for_spacecraft(preset("fast"), load_spacecraft(file).task).model_copy(
        update={"refine": config.refine}
    )
    assert config.refine.iterations == 7 and config.network.scaled
