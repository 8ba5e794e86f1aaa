"""What a run refuses, and that it then leaves nothing: folders, settings, sources, too little room."""

import os
from typing import Any

import jax
import pytest
from support import tiny
from support.tiny import CONFIG

from koz_jax.errors import DamagedFileError, KozError, SettingsError
from koz_jax.runs import checkpoint, trainer
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.trainer import train
from koz_jax.storage.lock import FolderLock


def test_a_used_folder_is_refused_and_stays_as_it_is(copied, tmp_path, no_compute):
    before = tiny.contents(copied.path)
    for resumed in (copied.path, copied.path / "agents", copied.config):
        with pytest.raises(SettingsError, match="exists already"):
            train(CONFIG, resumed, progress=False)
    assert tiny.contents(copied.path) == before


@pytest.mark.slow
def test_an_empty_folder_is_used(tmp_path, monkeypatch):
    monkeypatch.setattr(trainer._Run, "go", lambda *_: None)
    assert train(CONFIG, tmp_path, progress=False) is None
    assert RunFolder(tmp_path).read_config() == CONFIG


@pytest.mark.parametrize("parent", ["file", "x" * 300])
def test_a_folder_that_cannot_be_made_is_named(tmp_path, no_compute, parent):
    (tmp_path / "file").write_text("")
    with pytest.raises(SettingsError, match=rf"run: {tmp_path}/{parent}/run cannot be created: "):
        train(CONFIG, tmp_path / parent / "run", progress=False)


def test_a_range_without_room_for_a_zone_is_refused(tmp_path, no_compute):
    config = tiny.changed({"eval_min_angle_deg": 10.0, "eval_max_angle_deg": 30.0})
    with pytest.raises(SettingsError, match=r"eval_max_angle_deg: must be above 34 deg.*'resample'; got 30"):
        train(config, tmp_path / "run", progress=False)
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_run_is_not_resumed(tmp_path, no_compute):
    for attempt in (lambda: RunFolder(tmp_path).read_config(), lambda: train(CONFIG, tmp_path, resume=True)):
        with pytest.raises(SettingsError, match="is not a run folder"):
            attempt()
    assert list(tmp_path.iterdir()) == []
    RunFolder(tmp_path).write_config(CONFIG)
    with pytest.raises(SettingsError, match=f"resume: {tmp_path} has no checkpoint"):
        train(CONFIG, tmp_path, resume=True, progress=False)


def test_a_run_keeps_its_settings(copied, no_compute):
    before = tiny.contents(copied.path)
    other = tiny.changed({"sac": {"reward_scale": 0.5}})
    with pytest.raises(
        SettingsError, match=r"resume: sac.reward_scale is 0.5, but .*copy was begun with 1.0; a run keeps"
    ):
        train(other, copied.path, resume=True, progress=False)
    with pytest.raises(SettingsError, match=r"resume: network.hidden_sizes is \(16, 8\), but"):
        train(tiny.changed({"network": {"hidden_sizes": (16, 8)}}), copied.path, resume=True, progress=False)
    assert tiny.contents(copied.path) == before


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "cannot be read as JSON"),
        ("[]", "must hold a JSON object, got list"),
        ("{}", "curriculum: Field required"),
        ('{"num_envs": 0}', "num_envs: Input should be greater than 0 (got 0)"),
        ('{"colour": "red"}', "colour: Extra inputs are not permitted (got 'red')"),
    ],
)
def test_a_tampered_configuration_is_refused(copied, content, reason):
    copied.config.write_text(content)
    with pytest.raises(DamagedFileError) as caught:
        copied.read_config()
    assert str(caught.value).startswith(f"{copied.config}: ") and reason in str(caught.value)


def test_two_trainers_do_not_share_a_folder(copied, no_compute):
    before = tiny.contents(copied.path)
    with FolderLock(copied.path):
        with pytest.raises(SettingsError, match=rf"run: {copied.path} is in use by .*\(pid {os.getpid()}\)"):
            train(CONFIG, copied.path, resume=True, progress=False)
    assert tiny.contents(copied.path).keys() == before.keys()
    assert train(CONFIG, copied.path, resume=True, progress=False) is not None


@pytest.mark.slow
def test_a_run_too_large_for_memory_is_refused_in_numbers(tmp_path, no_compute):
    for fields, words in [
        ({"sac": {"buffer_size": 2**31 - 1}}, ["sac.buffer_size: must be smaller, got 2147483647", "GiB are free"]),
        ({"network": {"hidden_sizes": (2**20, 2**20)}}, ["network.hidden_sizes: must be smaller, got (1048576, "]),
        ({"refine": {"scenarios": 2**31 - 1}}, ["refine.scenarios: must be smaller, got 2147483647"]),
        ({"num_envs": 2**30, "sac": {"buffer_size": 2**31 - 1, "n_step": 1}}, ["must be smaller, got"]),
    ]:
        with pytest.raises(SettingsError) as caught:
            train(tiny.changed(fields), tmp_path / "run", progress=False)
        assert all(word in str(caught.value) for word in words), str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_cannot_begin_leaves_nothing(tmp_path, monkeypatch):
    def exhausted(*_: Any) -> None:
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 bytes.")

    monkeypatch.setattr(checkpoint, "begin", exhausted)
    with pytest.raises(SettingsError, match=r"^out of memory: make num_envs, .* smaller; RESOURCE_EXHAUSTED"):
        train(CONFIG, tmp_path / "run", progress=False)
    assert list(tmp_path.iterdir()) == []


def test_a_beginning_that_was_killed_is_no_obstacle(tmp_path, monkeypatch):
    (tmp_path / "run" / "checkpoints" / ".0000000000.new").mkdir(parents=True)
    (tmp_path / "run" / ".config.json.4711").write_text("{")
    (tmp_path / "run" / "lock").write_text("pid 1\n")
    monkeypatch.setattr(trainer._Run, "go", lambda *_: None)
    assert train(CONFIG, tmp_path / "run", progress=False) is None
    (tmp_path / "mine" / "checkpoints" / "0000000064").mkdir(parents=True)
    with pytest.raises(SettingsError, match="mine exists already"):
        train(CONFIG, tmp_path / "mine", progress=False)
    assert (tmp_path / "mine" / "checkpoints" / "0000000064").is_dir()


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"network": {"hidden_sizes": (16, 8)}}, "network.hidden_sizes must be (16, 16), as in "),
        ({"network": {"encoding": {"rate_scales": ()}}}, "network.encoding.rate_scales must be (0.003, 0.03), as in "),
        ({"num_envs": 4}, "num_envs must be 8, as in "),
        ({"sac": {"buffer_size": 2048}}, "sac.buffer_size must be 1024, as in "),
    ],
)
def test_a_source_that_does_not_fit_is_refused(run, tmp_path, no_compute, fields, reason):
    with pytest.raises(SettingsError) as caught:
        train(tiny.changed(fields), tmp_path / "run", start_from=run.snapshot("phase1"), progress=False)
    assert str(caught.value).startswith(f"start_from: {reason}{run.snapshot('phase1')}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_source_with_too_few_steps_is_refused(run, tmp_path, no_compute):
    config = tiny.changed({"sac": {"n_step": 64}, "prefill_steps": 64})
    with pytest.raises(
        SettingsError, match=r"sac.n_step: must be at most the 37 steps in the replay buffer of .*, got 64"
    ):
        train(config, tmp_path / "run", start_from=run.snapshot("phase1"), progress=False)
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_source_is_refused(run, tmp_path, no_compute):
    for source, reason in [
        (tmp_path / "nowhere", "start_from: .*nowhere is neither a run with a checkpoint nor a snapshot"),
        (run.agent("phase2"), "phase2: holds an agent alone, not a training state"),
    ]:
        with pytest.raises(KozError, match=reason):
            train(CONFIG, tmp_path / "run", start_from=source, progress=False)
    with pytest.raises(SettingsError, match="start_from: a resumed run goes on from its own checkpoint"):
        train(CONFIG, run.path, resume=True, start_from=run.path, progress=False)
    assert list(tmp_path.iterdir()) == []
