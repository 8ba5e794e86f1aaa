"""What a run leaves behind: files, curves, and where its agents come from."""

import csv
import errno
import hashlib
import json
import math
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from support import tiny
from support.runs import state_of
from support.tiny import CONFIG
from tensorboardX.event_file_writer import EventsWriter

import koz_jax
from koz_jax.agents.agent import load_agent
from koz_jax.config.training import TrainConfig
from koz_jax.errors import SettingsError, StorageError
from koz_jax.learning import refinement
from koz_jax.runs import checkpoint, provenance, stages
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.metrics_log import MetricsLog, read_metrics
from koz_jax.runs.progress import Progress
from koz_jax.runs.trainer import train
from koz_jax.storage.lock import FolderLock


def test_layout_of_a_run(run):
    found = {str(path.relative_to(run.path)) for path in run.path.rglob("*") if "tensorboard/" not in str(path)}
    saved = [
        ("agents/phase1", "agents"),
        ("agents/phase2", "agents"),
        ("agents/phase2-sac", "agents"),
        ("snapshots/phase1", "snapshots"),
        ("checkpoints/0000000132", "checkpoints"),
        ("checkpoints/0000000136", "checkpoints"),
    ]
    assert found == {
        "config.json",
        "lock",
        "metrics.csv",
        "tensorboard",
        "timing.csv",
        *(name for names in saved for name in names),
        *(f"{folder}/{name}" for folder, _ in saved for name in ("arrays.npz", "record.json")),
    }
    assert any((run.path / "tensorboard").iterdir())
    assert run.read_config() == CONFIG
    in_file = hashlib.sha256(run.config.read_bytes()).hexdigest()
    assert load_agent(run.path).provenance.config_sha256 == in_file


def test_metrics_have_a_row_per_chunk_and_an_evaluation_where_due(run):
    rows = read_metrics(run.path / "metrics.csv")
    learned, refined = rows[:8], rows[8:]
    assert [int(row["updates"]) for row in learned] == [16, 32, 48, 64, 80, 96, 112, 128]
    assert [int(row["updates"]) for row in refined] == [130, 132, 134, 136]
    assert [row["eval/success_rate"] != "" for row in rows] == [False, True] * 6
    assert [int(row["env_steps"]) for row in learned] == [8 * (5 + updates // 2) for updates in range(16, 129, 16)]
    for row in learned:
        assert all(np.isfinite(float(row[name])) for name in row if name.startswith(("train/", "reward/")))
        assert row["refine/cost"] == ""
    assert all(float(row["refine/cost"]) > 0 and row["train/critic_loss"] == "" for row in refined)
    assert {"train/critic_loss", "reward/zone", "curriculum/max_angle"} <= rows[0].keys()
    with open(run.path / "timing.csv", newline="") as file:
        times = list(csv.DictReader(file))
    assert [row["updates"] for row in times] == [row["updates"] for row in rows]
    assert all(float(row["updates_per_second"]) > 0 for row in times)


def test_metrics_go_to_tensorboard_too(run):
    (events,) = (run.path / "tensorboard").iterdir()
    content = events.read_bytes()
    for name in (b"train/critic_loss", b"eval/success_rate", b"curriculum/zone_weight"):
        assert name in content


def test_a_disk_that_is_full_for_tensorboard_is_named(tmp_path, monkeypatch):
    log = MetricsLog(tmp_path, "", 0)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(EventsWriter, "flush", full)
    with pytest.raises(StorageError, match=r"tensorboard: cannot be written: No space left on device"):
        log.write(1, {"a": 1.0}, {"b": 2.0})
    with pytest.raises(StorageError, match=r"tensorboard: cannot be written"):
        log.close()


def test_agents_tell_where_they_come_from(run):
    for phase in (1, 2):
        agent = load_agent(run.agent(f"phase{phase}"))
        found = agent.provenance
        assert (found.phase, found.seed) == (phase, CONFIG.seed)
        assert found.updates in ({32, 64}, {96, 128})[phase - 1]
        assert found.refinements in ({0}, {0, 4, 8})[phase - 1]
        assert found.command == "" and found.version == koz_jax.__version__
        assert agent.task == CONFIG.task


def test_the_log_goes_on_from_the_text_of_the_checkpoint(tmp_path):
    log = MetricsLog(tmp_path, "", 0)
    for updates in (10, 20):
        log.write(updates, {"loss": updates / 3, "eval/score": math.nan if updates == 10 else 0.5}, {"rate": 7.0})
    text = log.text
    log.write(30, {"loss": 1.0}, {"rate": 7.0})
    log.close()
    path = tmp_path / "metrics.csv"
    assert path.read_text().startswith(text)
    for damage in (path.read_text(), path.read_text()[:-7], "", "rubbish\n"):
        path.write_text(damage)
        log = MetricsLog(tmp_path, text, 20)
        assert path.read_text() == log.text == text
        log.write(30, {"eval/score": 0.5, "loss": 10.0}, {"rate": 8.0})
        log.write(40, {"eval/score": 0.5}, {"rate": 9.0})
        log.close()
        assert path.read_text() == log.text == text + "30,10,0.5\n40,,0.5\n"
    assert read_metrics(path)[0] == {"updates": "10", "loss": "3.33333333", "eval/score": ""}
    assert (tmp_path / "timing.csv").read_text().splitlines()[:5] == ["updates,rate", "10,7", "20,7", "30,7", "30,8"]
    MetricsLog(tmp_path, "", 0).close()
    assert not path.exists()


def test_a_log_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "metrics.csv").mkdir()
    with pytest.raises(StorageError, match="cannot be written: Is a directory"):
        MetricsLog(tmp_path, "", 0)
    (tmp_path / "metrics.csv").rmdir()
    log = MetricsLog(tmp_path, "", 0)
    (tmp_path / "metrics.csv").symlink_to("/dev/full")
    with pytest.raises(StorageError, match=r"metrics.csv: cannot be written: No space left on device"):
        log.write(10, {"loss": 1.0}, {})
    log.close()


def test_progress_speaks_only_when_enabled(capsys, monkeypatch):
    for enabled in (True, False):
        with Progress(stages.plan(CONFIG), 16, enabled=enabled) as bar:
            bar.note("run folder: x")
            bar.compiling()
            bar.advance(80)
        shown = capsys.readouterr().err
        assert ("compiling" in shown and "phase 2" in shown and "run folder: x" in shown) == enabled
        assert (shown == "") != enabled


def test_a_machine_without_git_trains_too(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert provenance.commit() == ""


def test_the_run_folder_records_what_runs(run):
    record = json.loads((run.checkpoints()[0] / "record.json").read_text())
    assert record["done"] == 136
    assert TrainConfig.model_validate(record["config"]) == CONFIG
    assert os.access(run.config, os.R_OK)


def git(folder: Path, *command: str) -> str:
    author = ["-c", "user.name=me", "-c", "user.email=me@here"]
    done = subprocess.run(["git", "-C", str(folder), *author, *command], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_the_commit_is_that_of_the_package_never_of_a_repository_around_it(tmp_path):
    package = tmp_path / "theirs" / ".venv" / "koz_jax"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    assert provenance.commit(package) == ""  # no repository at all
    git(tmp_path / "theirs", "init")
    (tmp_path / "theirs" / "thesis.tex").write_text("")
    git(tmp_path / "theirs", "add", "thesis.tex")
    git(tmp_path / "theirs", "commit", "-m", "work")
    assert provenance.commit(package) == ""
    git(tmp_path / "theirs", "add", ".venv")
    git(tmp_path / "theirs", "commit", "-m", "a checkout")
    assert provenance.commit(package) == git(tmp_path / "theirs", "rev-parse", "HEAD")
    (package / "__init__.py").write_text("changed = True")
    assert provenance.commit(package).endswith("-dirty")


def test_the_command_is_what_the_caller_says_it_is():
    assert provenance.collect(CONFIG, "koz train --preset smoke").command == "koz train --preset smoke"
    assert provenance.collect(CONFIG, "").command == ""


def test_a_log_refuses_a_column_that_its_first_row_has_not(tmp_path):
    log = MetricsLog(tmp_path, "", 0)
    log.write(10, {"loss": 1.0}, {})
    with pytest.raises(KeyError, match="colour"):
        log.write(20, {"colour": 1.0}, {})
    log.close()


def test_the_log_of_an_older_version_goes_on_with_its_columns(run, tmp_path):
    """What was not logged yet when the run began, such as eval/unsafe_start_rate, is left out of it."""
    rows = read_metrics(run.path / "metrics.csv")
    older = [name for name in rows[0] if name != "eval/unsafe_start_rate"]
    assert len(older) == len(rows[0]) - 1
    text = "\n".join([",".join(older), *(",".join(row[name] for name in older) for row in rows[:4])]) + "\n"
    log = MetricsLog(tmp_path, text, 64)
    log.write(80, {"eval/score": 3.0, "eval/unsafe_start_rate": 0.5}, {})
    log.close()
    last = read_metrics(tmp_path / "metrics.csv")[-1]
    assert (last["updates"], last["eval/score"], "eval/unsafe_start_rate" in last) == ("80", "3", False)
    assert (tmp_path / "metrics.csv").read_text().startswith(text)


def test_an_agent_tells_how_much_refinement_was_tried(run):
    assert load_agent(run.agent("phase2")).provenance.refinements_tried == 8
    assert load_agent(run.agent("phase2-sac")).provenance.refinements_tried == 0


@pytest.mark.slow
@pytest.mark.parametrize("better", [False, True])
def test_a_refinement_that_gave_no_better_agent_says_so(run, tmp_path, monkeypatch, capsys, better):
    """Resumed at the beginning of the refinement, with evaluations that make every refined agent worse, or better."""
    shutil.copytree(run.path, tmp_path / "run")
    folder, done = RunFolder(tmp_path / "run"), 128
    state = state_of(run.checkpoints()[0])
    begun = state.replace(
        best_score=np.float32(100.0),
        best_at=np.int32(96),
        refine=refinement.init(CONFIG, state.best.averaged_policy),
    )
    for path in folder.checkpoints():
        shutil.rmtree(path)
    checkpoint.save(folder.checkpoint(done), begun, CONFIG)
    monkeypatch.setattr(stages.Stage, "score", lambda *_: 200.0 if better else -200.0)
    trained = train(CONFIG, folder.path, resume=True)
    assert trained is not None
    told = "refine: gave no better agent; kept the one of update 96" in capsys.readouterr().err
    assert told == (not better)
    for agent in (trained, load_agent(folder.path)):
        found = agent.provenance
        assert (found.updates, found.refinements) == ((128, 4) if better else (96, 0))
        assert found.refinements_tried == 8


def test_a_finished_run_can_be_made_small(copied):
    before = copied.size
    assert before == sum(len(content) for content in tiny.contents(copied.path).values() if content)
    freed = copied.trim()
    assert copied.size == before - freed
    assert not copied.checkpoints() and not copied.snapshot("phase1").exists()
    assert load_agent(copied.path).provenance.refinements_tried == 8
    assert copied.read_config() == CONFIG and (copied.path / "metrics.csv").exists()
    assert copied.trim() == 0


def test_a_run_that_is_not_finished_keeps_its_checkpoints(copied):
    shutil.rmtree(copied.checkpoints()[0])
    with pytest.raises(SettingsError, match=r"is not finished \(132 of 136 updates and iterations\)"):
        copied.trim()
    assert copied.checkpoints()


def test_a_run_under_way_is_not_trimmed(copied):
    with FolderLock(copied.path), pytest.raises(SettingsError, match="in use by another process"):
        copied.trim()
    assert copied.checkpoints()
