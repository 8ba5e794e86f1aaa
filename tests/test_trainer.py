"""The host loop: what a run leaves behind, and that stopping and going on changes nothing."""

import contextlib
import csv
import errno
import hashlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from tensorboardX.event_file_writer import EventsWriter
from tiny import CONFIG

from koz_jax import storage, trainer, training
from koz_jax.agent import load_agent
from koz_jax.config import TrainConfig
from koz_jax.errors import UserError
from koz_jax.interrupt import StopRequest
from koz_jax.lock import FolderLock
from koz_jax.metrics_log import MetricsLog, read_metrics
from koz_jax.progress import Progress
from koz_jax.reward import PAPER_WEIGHTS
from koz_jax.rollout import CaseResult
from koz_jax.run_folder import Checkpoint, RunFolder, RunState
from koz_jax.sac import replay
from koz_jax.trainer import train


@pytest.fixture(scope="module")
def run() -> RunFolder:
    """The undisturbed run; read it, do not change it."""
    return tiny.finished_run()


@pytest.fixture
def copied(run, tmp_path) -> RunFolder:
    """A copy of the undisturbed run, to be damaged."""
    shutil.copytree(run.path, tmp_path / "copy")
    return RunFolder(tmp_path / "copy")


@pytest.fixture
def no_compute(monkeypatch) -> None:
    """Make an error of whatever would be compiled."""
    init = training.init

    def only_shapes(config: TrainConfig, key: jax.Array) -> training.TrainState:
        return init(config, key) if isinstance(key, jax.core.Tracer) else pytest.fail("networks were made")

    monkeypatch.setattr(training, "init", only_shapes)
    monkeypatch.setattr(training, "train_chunk", lambda *_: pytest.fail("something was learned"))
    monkeypatch.setattr(trainer.refine, "refine_chunk", lambda *_: pytest.fail("something was refined"))
    monkeypatch.setattr(trainer.evaluation, "fly_cases", lambda *_: pytest.fail("something was flown"))


@contextlib.contextmanager
def signal_after(done: int, number: signal.Signals) -> Iterator[None]:
    """Send this process a signal when a run has done so much."""
    advance = Progress.advance

    def advance_and_signal(bar: Progress, at: int) -> None:
        advance(bar, at)
        if at == done:
            signal.raise_signal(number)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Progress, "advance", advance_and_signal)
        yield


def changed(**fields: Any) -> TrainConfig:
    """The tiny configuration with other values in some fields."""
    return TrainConfig.model_validate(tiny.merged(CONFIG.model_dump(), fields))


def state_of(folder: Path) -> RunState:
    return storage.load_tree(folder, trainer._template(CONFIG))


def assert_same_tree(found: Any, expected: Any) -> None:
    for (path, one), (_, other) in zip(
        jax.tree_util.tree_leaves_with_path(found), jax.tree_util.tree_leaves_with_path(expected), strict=True
    ):
        if jax.dtypes.issubdtype(one.dtype, jax.dtypes.prng_key):  # pyright: ignore[reportPrivateImportUsage]
            one, other = jax.random.key_data(one), jax.random.key_data(other)
        np.testing.assert_array_equal(one, other, err_msg=jax.tree_util.keystr(path), strict=True)


def assert_same_run(found: RunFolder, expected: RunFolder) -> None:
    """Same to the last bit."""
    assert_same_tree(state_of(found.checkpoints()[0]), state_of(expected.checkpoints()[0]))
    assert_same_tree(state_of(found.snapshot("phase1")), state_of(expected.snapshot("phase1")))
    assert (found.path / "metrics.csv").read_bytes() == (expected.path / "metrics.csv").read_bytes()
    for phase in (1, 2):
        one, other = (load_agent(folder.agent(phase)) for folder in (found, expected))
        assert_same_tree(one.controller, other.controller)
        assert one.provenance.updates == other.provenance.updates


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
    with pytest.raises(UserError, match=r"tensorboard: cannot be written: No space left on device"):
        log.write(1, {"a": 1.0}, {"b": 2.0})
    with pytest.raises(UserError, match=r"tensorboard: cannot be written"):
        log.close()


def test_agents_tell_where_they_come_from(run):
    for phase in (1, 2):
        agent = load_agent(run.agent(phase))
        provenance = agent.provenance
        assert (provenance.phase, provenance.seed) == (phase, CONFIG.seed)
        assert provenance.updates in ({32, 64}, {96, 128})[phase - 1]
        assert provenance.refinements in ({0}, {0, 4, 8})[phase - 1]
        assert provenance.command.startswith("python ") and provenance.version
        assert agent.task == CONFIG.task


# 48, 112 and 134 are between evaluations, where only the stop itself makes the checkpoint; the others end a stage.
@pytest.mark.parametrize(
    ("done", "number"),
    [
        (48, signal.SIGINT),
        (64, signal.SIGTERM),
        (112, signal.SIGTERM),
        (tiny.LEARNED, signal.SIGINT),
        (134, signal.SIGINT),
    ],
)
def test_a_stopped_and_resumed_run_equals_the_undisturbed_one(run, tmp_path, done, number):
    folder = RunFolder(tmp_path / "run")
    with signal_after(done, number):
        assert train(CONFIG, folder.path, progress=False) is None
    assert state_of(folder.checkpoints()[0]).done == done
    agent = train(CONFIG, folder.path, resume=True, progress=False)
    assert agent is not None
    assert_same_run(folder, run)
    assert_same_tree(agent.controller, load_agent(run.path).controller)


def test_a_run_stopped_twice_equals_the_undisturbed_one(run, tmp_path):
    folder = RunFolder(tmp_path / "run")
    with signal_after(16, signal.SIGINT):
        assert train(CONFIG, folder.path, progress=False) is None
    with signal_after(80, signal.SIGTERM):
        assert train(CONFIG, folder.path, resume=True, progress=False) is None
    assert train(CONFIG, folder.path, resume=True, progress=False) is not None
    assert_same_run(folder, run)


def test_a_killed_run_goes_on_from_its_last_checkpoint(run, tmp_path):
    folder = RunFolder(tmp_path / "run")

    class PowerCutError(Exception):
        pass

    advance = Progress.advance

    def cut(bar: Progress, at: int) -> None:
        advance(bar, at)
        if at == 112:
            raise PowerCutError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Progress, "advance", cut)
        with pytest.raises(PowerCutError):
            train(CONFIG, folder.path, progress=False)
    # The log goes on beyond the checkpoint, and loses a part as after a crash of the system.
    assert [path.name for path in folder.checkpoints()] == ["0000000096", "0000000064"]
    log = folder.path / "metrics.csv"
    log.write_bytes(log.read_bytes() + b"112,0.1")
    assert train(CONFIG, folder.path, resume=True, progress=False) is not None
    assert_same_run(folder, run)


def test_a_signal_before_the_first_update_makes_a_checkpoint_too(run, tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run")
    begin = trainer._begin

    def signalled(*args: Any) -> RunState:
        signal.raise_signal(signal.SIGTERM)
        return begin(*args)

    with monkeypatch.context() as patch:
        patch.setattr(trainer, "_begin", signalled)
        assert train(CONFIG, folder.path, progress=False) is None
    assert state_of(folder.checkpoints()[0]).done == 0
    assert train(CONFIG, folder.path, resume=True, progress=False) is not None
    assert_same_run(folder, run)


@pytest.mark.parametrize("second", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_aborts_at_once(second):
    code = (
        "import signal\n"
        "from koz_jax.interrupt import StopRequest\n"
        "with StopRequest() as stop:\n"
        "    signal.raise_signal(signal.SIGINT)\n"
        "    print(stop.requested, flush=True)\n"
        f"    signal.raise_signal({int(second)})\n"
        "    print('still here', flush=True)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (-second, "True\n")
    assert "SIGINT: finishing the chunk, then checkpointing; again to abort at once" in done.stderr


def test_handlers_are_put_back():
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with StopRequest() as stop:
        assert signal.getsignal(signal.SIGINT) != before[signal.SIGINT]
        signal.raise_signal(signal.SIGTERM)
        assert stop.requested
    assert {number: signal.getsignal(number) for number in before} == before


def test_the_best_learner_of_phase_1_starts_phase_2(tmp_path, monkeypatch):
    # The first evaluation of the phase is made to be the better one.
    scores = iter([2.0, 1.0])
    monkeypatch.setattr(trainer, "score", lambda *_: next(scores))
    folder = RunFolder(tmp_path / "run")
    with signal_after(64, signal.SIGINT):
        assert train(CONFIG, folder.path, progress=False) is None
    snapshot, begun = state_of(folder.snapshot("phase1")), state_of(folder.checkpoints()[0])
    assert (float(snapshot.best_score), int(snapshot.best_at)) == (2.0, 32)
    assert_same_tree(begun.train.learner, snapshot.best)
    assert not np.array_equal(begun.train.learner.log_alpha, snapshot.train.learner.log_alpha)
    assert_same_tree(begun.train.buffer, snapshot.train.buffer)
    assert float(begun.best_score) == -np.inf  # phase 2 judges anew
    agent = load_agent(folder.agent(1))
    assert agent.provenance.updates == 32
    assert_same_tree(agent.controller.policy, snapshot.best.averaged_policy)


def test_refinement_begins_with_the_best_of_phase_2_and_the_best_of_all_is_returned(tmp_path, monkeypatch):
    scores = iter([1.0, 1.0, 4.0, 3.0, 5.0, 2.0])
    monkeypatch.setattr(trainer, "score", lambda *_: next(scores))
    folder = RunFolder(tmp_path / "run")
    with signal_after(tiny.LEARNED, signal.SIGINT):
        assert train(CONFIG, folder.path, progress=False) is None
    begun = state_of(folder.checkpoints()[0])
    assert int(begun.best_at) == 96
    assert_same_tree(begun.refine.policy, begun.best.averaged_policy)
    assert_same_tree(begun.refine.policy, load_agent(folder.sac_agent).controller.policy)
    agent = train(CONFIG, folder.path, resume=True, progress=False)
    assert agent is not None
    assert (agent.provenance.updates, agent.provenance.refinements) == (128, 4)
    assert load_agent(folder.path).provenance == agent.provenance
    assert_same_tree(agent.controller, load_agent(folder.path).controller)


def test_a_training_of_one_phase_returns_its_best(tmp_path, monkeypatch):
    scores = iter([2.0, 1.0])
    monkeypatch.setattr(trainer, "score", lambda *_: next(scores))
    config = changed(curriculum={"phase2": {"updates": 0}}, refine={"iterations": 0})
    # Phase 1 is the same with or without a second phase: use what is compiled already.
    init, train_chunk = training.init, training.train_chunk
    monkeypatch.setattr(training, "init", lambda _, key: init(CONFIG, key))
    monkeypatch.setattr(training, "train_chunk", lambda _, state, steps: train_chunk(CONFIG, state, steps))
    folder = RunFolder(tmp_path / "run")
    agent = train(config, folder.path, progress=False)
    assert agent is not None
    assert (agent.provenance.phase, agent.provenance.updates) == (1, 32)
    assert_same_tree(agent.controller, load_agent(folder.path).controller)
    resumed = train(config, folder.path, resume=True, progress=False)
    assert resumed is not None and resumed.provenance.updates == 32


def test_resuming_a_finished_run_returns_its_agent_without_training(run, copied, no_compute):
    before = tiny.contents(copied.path)
    agent = train(CONFIG, copied.path, resume=True, progress=False)
    assert agent is not None
    saved = load_agent(run.path)
    assert_same_tree(agent.controller, saved.controller)
    assert agent.provenance.updates == saved.provenance.updates
    assert tiny.contents(copied.path) == before


def test_a_used_folder_is_refused_and_stays_as_it_is(copied, tmp_path, no_compute):
    before = tiny.contents(copied.path)
    for resumed in (copied.path, copied.path / "agents", copied.config):
        with pytest.raises(UserError, match="exists already"):
            train(CONFIG, resumed, progress=False)
    assert tiny.contents(copied.path) == before


def test_an_empty_folder_is_used(tmp_path, monkeypatch):
    monkeypatch.setattr(trainer._Run, "go", lambda *_: None)
    assert train(CONFIG, tmp_path, progress=False) is None
    assert RunFolder(tmp_path).read_config() == CONFIG


@pytest.mark.parametrize("parent", ["file", "x" * 300])
def test_a_folder_that_cannot_be_made_is_named(tmp_path, no_compute, parent):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=rf"run: {tmp_path}/{parent}/run cannot be created: "):
        train(CONFIG, tmp_path / parent / "run", progress=False)


def test_a_range_without_room_for_a_zone_is_refused(tmp_path, no_compute):
    config = changed(eval_min_angle_deg=10.0, eval_max_angle_deg=30.0)
    with pytest.raises(UserError, match=r"eval_max_angle_deg: must be above 34 deg.*'resample'; got 30"):
        train(config, tmp_path / "run", progress=False)
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_run_is_not_resumed(tmp_path, no_compute):
    for attempt in (lambda: RunFolder(tmp_path).read_config(), lambda: train(CONFIG, tmp_path, resume=True)):
        with pytest.raises(UserError, match="is not a run folder"):
            attempt()
    assert list(tmp_path.iterdir()) == []
    RunFolder(tmp_path).write_config(CONFIG)
    with pytest.raises(UserError, match=f"resume: {tmp_path} has no checkpoint"):
        train(CONFIG, tmp_path, resume=True, progress=False)


def test_a_run_keeps_its_settings(copied, no_compute):
    before = tiny.contents(copied.path)
    other = changed(sac={"reward_scale": 0.5})
    with pytest.raises(UserError, match=r"resume: sac.reward_scale is 0.5, but .*copy was begun with 1.0; a run keeps"):
        train(other, copied.path, resume=True, progress=False)
    with pytest.raises(UserError, match=r"resume: network.hidden_sizes is \(16, 8\), but"):
        train(changed(network={"hidden_sizes": (16, 8)}), copied.path, resume=True, progress=False)
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
    with pytest.raises(UserError) as caught:
        copied.read_config()
    assert str(caught.value).startswith(f"{copied.config}: ") and reason in str(caught.value)


def damage(folder: Path) -> None:
    """Cut the arrays short."""
    path = folder / "arrays.npz"
    path.write_bytes(path.read_bytes()[:-5])


def test_a_damaged_checkpoint_is_named_and_the_one_before_is_used(run, copied, capsys):
    newest, before = copied.checkpoints()
    damage(newest)
    assert train(CONFIG, copied.path, resume=True, progress=False) is not None
    warned = f"warning: {newest / 'arrays.npz'}: damaged: its checksum is not the one in record.json; going on from"
    assert capsys.readouterr().err.startswith(f"{warned} {before} instead\n")
    assert_same_run(copied, run)
    assert copied.checkpoints() == [newest, before]


def test_start_from_skips_a_damaged_checkpoint_too(run, copied, tmp_path, capsys, monkeypatch):
    newest, before = copied.checkpoints()
    (newest / "record.json").unlink()
    template = trainer._template(CONFIG)
    found = trainer.load_source(copied.path, CONFIG, template)
    assert_same_tree(found, state_of(before))
    assert f"warning: {newest / 'record.json'}: no such file; going on from {before}" in capsys.readouterr().err
    assert copied.checkpoints() == [newest, before]  # another run's folder is only read


def test_without_a_good_checkpoint_all_damages_are_named(copied, no_compute):
    newest, before = copied.checkpoints()
    damage(newest)
    (before / "record.json").write_text('{"format": 1, "config": {}}')
    contents = tiny.contents(copied.path)
    with pytest.raises(UserError) as caught:
        train(CONFIG, copied.path, resume=True, progress=False)
    first, *others = str(caught.value).splitlines()
    assert first.startswith(f"{newest / 'arrays.npz'}: damaged")
    assert others[0] == f"{before / 'record.json'}: curriculum: Field required"
    del contents[copied.path / "lock"]
    assert contents.items() <= tiny.contents(copied.path).items()


def test_what_a_killed_write_leaves_is_cleared_away(run, copied):
    newest, before = copied.checkpoints()
    os.replace(newest, newest.with_name(f".{newest.name}.new"))
    assert train(CONFIG, copied.path, resume=True, progress=False) is not None
    assert_same_run(copied, run)
    assert sorted(path.name for path in newest.parent.iterdir()) == [before.name, newest.name]


def test_a_failed_write_ends_the_run_at_the_next_chunk(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run")
    save = storage.save_arrays

    def full(path: Path, *others: Any) -> None:
        if path == folder.checkpoint(64):
            raise UserError(f"{path}: cannot be written: No space left on device")
        save(path, *others)

    monkeypatch.setattr(storage, "save_arrays", full)
    with pytest.raises(UserError, match=r"checkpoints/0000000064: cannot be written: No space left"):
        train(CONFIG, folder.path, progress=False)
    assert state_of(folder.checkpoints()[0]).done == 32


def test_the_last_write_is_awaited_and_its_error_shown(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run")
    save = storage.save_arrays

    def full(path: Path, *others: Any) -> None:
        if path == folder.checkpoint(48):
            time.sleep(0.3)
            raise UserError("the disk is full")
        save(path, *others)

    monkeypatch.setattr(storage, "save_arrays", full)
    with signal_after(48, signal.SIGTERM), pytest.raises(UserError, match="the disk is full"):
        train(CONFIG, folder.path, progress=False)


def test_two_trainers_do_not_share_a_folder(copied, no_compute):
    before = tiny.contents(copied.path)
    with FolderLock(copied.path):
        with pytest.raises(UserError, match=rf"run: {copied.path} is in use by .*\(pid {os.getpid()}\)"):
            train(CONFIG, copied.path, resume=True, progress=False)
    assert tiny.contents(copied.path).keys() == before.keys()
    assert train(CONFIG, copied.path, resume=True, progress=False) is not None


def test_a_killed_process_gives_its_lock_up(tmp_path):
    code = (
        "import os, pathlib, signal; from koz_jax.lock import FolderLock\n"
        f"held = FolderLock(pathlib.Path({str(tmp_path)!r}))\n"
        "print('held', flush=True); signal.pause()"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=tiny.ROOT) as process:
        assert process.stdout is not None
        process.stdout.readline()
        with pytest.raises(UserError, match=f"in use by another process .pid {process.pid}"):
            FolderLock(tmp_path)
        process.kill()
        process.wait()
    with FolderLock(tmp_path):
        pass


def test_a_run_too_large_for_memory_is_refused_in_numbers(tmp_path, no_compute):
    for fields, words in [
        ({"sac": {"buffer_size": 2**31 - 1}}, ["sac.buffer_size: must be smaller, got 2147483647", "GiB are free"]),
        ({"network": {"hidden_sizes": (2**20, 2**20)}}, ["network.hidden_sizes: must be smaller, got (1048576, "]),
        ({"refine": {"scenarios": 2**31 - 1}}, ["refine.scenarios: must be smaller, got 2147483647"]),
        ({"num_envs": 2**30, "sac": {"buffer_size": 2**31 - 1, "n_step": 1}}, ["must be smaller, got"]),
    ]:
        with pytest.raises(UserError) as caught:
            train(changed(**fields), tmp_path / "run", progress=False)
        assert all(word in str(caught.value) for word in words), str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_cannot_begin_leaves_nothing(tmp_path, monkeypatch):
    def exhausted(*_: Any) -> None:
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 1 bytes.")

    monkeypatch.setattr(trainer, "_begin", exhausted)
    with pytest.raises(UserError, match=r"^out of memory: make num_envs, .* smaller; RESOURCE_EXHAUSTED"):
        train(CONFIG, tmp_path / "run", progress=False)
    assert list(tmp_path.iterdir()) == []


def test_a_beginning_that_was_killed_is_no_obstacle(tmp_path, monkeypatch):
    (tmp_path / "run" / "checkpoints" / ".0000000000.new").mkdir(parents=True)
    (tmp_path / "run" / ".config.json.4711").write_text("{")
    (tmp_path / "run" / "lock").write_text("pid 1\n")
    monkeypatch.setattr(trainer._Run, "go", lambda *_: None)
    assert train(CONFIG, tmp_path / "run", progress=False) is None
    (tmp_path / "mine" / "checkpoints" / "0000000064").mkdir(parents=True)
    with pytest.raises(UserError, match="mine exists already"):
        train(CONFIG, tmp_path / "mine", progress=False)
    assert (tmp_path / "mine" / "checkpoints" / "0000000064").is_dir()


def test_start_from_takes_learner_and_buffer(run, tmp_path):
    for source in (run.snapshot("phase1"), run.path):
        expected = state_of(source if source != run.path else run.checkpoints()[0]).train
        with pytest.MonkeyPatch.context() as patch:
            begun = []

            def catch(_: Any, saved: Checkpoint, begun: list[RunState] = begun) -> None:
                begun.append(saved.state)

            patch.setattr(trainer._Run, "go", catch)
            train(CONFIG, tmp_path / source.name, start_from=source, progress=False)
        (state,) = begun
        assert_same_tree(state.train.learner, expected.learner)
        assert_same_tree(state.train.buffer, replay.seal(expected.buffer))
        assert_same_tree(state.best, expected.learner)
        assert state.done == 0 and float(state.best_score) == -np.inf
        fresh = training.init(CONFIG, jax.random.key(CONFIG.seed))
        assert_same_tree(state.train.env_states, fresh.env_states)
        assert_same_tree(state.train.key, fresh.key)


def test_start_from_trains(run, tmp_path):
    # The same seed and settings, but a head start: another result.
    agent = train(CONFIG, tmp_path / "run", start_from=run.snapshot("phase1"), progress=False)
    assert agent is not None
    observed = np.ones((4, 16), np.float32)
    assert not np.allclose(agent.predict(observed), load_agent(run.path).predict(observed), atol=1e-4)


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
    with pytest.raises(UserError) as caught:
        train(changed(**fields), tmp_path / "run", start_from=run.snapshot("phase1"), progress=False)
    assert str(caught.value).startswith(f"start_from: {reason}{run.snapshot('phase1')}")
    assert list(tmp_path.iterdir()) == []


def test_a_source_with_too_few_steps_is_refused(run, tmp_path, no_compute):
    config = changed(sac={"n_step": 64}, prefill_steps=64)
    with pytest.raises(UserError, match=r"sac.n_step: must be at most the 37 steps in the replay buffer of .*, got 64"):
        train(config, tmp_path / "run", start_from=run.snapshot("phase1"), progress=False)
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_source_is_refused(run, tmp_path, no_compute):
    for source, reason in [
        (tmp_path / "nowhere", "start_from: .*nowhere is neither a run with a checkpoint nor a snapshot"),
        (run.agent(2), "phase2: holds an agent alone, not a training state"),
    ]:
        with pytest.raises(UserError, match=reason):
            train(CONFIG, tmp_path / "run", start_from=source, progress=False)
    with pytest.raises(UserError, match="start_from: a resumed run goes on from its own checkpoint"):
        train(CONFIG, run.path, resume=True, start_from=run.path, progress=False)
    assert list(tmp_path.iterdir()) == []


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
        with pytest.raises(KeyError, match="colour"):
            log.write(30, {"colour": 1.0}, {})
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
    with pytest.raises(UserError, match="cannot be written: Is a directory"):
        MetricsLog(tmp_path, "", 0)
    (tmp_path / "metrics.csv").rmdir()
    log = MetricsLog(tmp_path, "", 0)
    (tmp_path / "metrics.csv").symlink_to("/dev/full")
    with pytest.raises(UserError, match=r"metrics.csv: cannot be written: No space left on device"):
        log.write(10, {"loss": 1.0}, {})
    log.close()


def test_progress_speaks_only_when_enabled(capsys, monkeypatch):
    for enabled in (True, False):
        with Progress(CONFIG, 16, enabled=enabled) as bar:
            bar.note("run folder: x")
            bar.compiling()
            bar.advance(80)
        shown = capsys.readouterr().err
        assert ("compiling" in shown and "phase 2" in shown and "run folder: x" in shown) == enabled
        assert (shown == "") != enabled


def test_a_machine_without_git_trains_too(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert trainer._commit() == ""


def test_the_score_of_a_phase_counts_what_it_asks_for():
    # One case succeeds, one settles but violates the zone, one does not settle.
    terms = jax.tree.map(lambda _: jnp.zeros(3), PAPER_WEIGHTS).replace(
        attitude=jnp.array([100.0, 10.0, 1.0]), zone=jnp.array([-4.0, -4.0, -4.0])
    )
    results = CaseResult(
        initial_angle=jnp.ones(3),
        reward_terms=terms,
        settling_time=jnp.array([1.0, 1.0, jnp.nan]),
        control_effort=jnp.ones(3),
        control_accuracy=jnp.ones(3),
        min_margin=jnp.array([1.0, -1.0, 1.0]),
        settled=jnp.array([True, True, False]),
        violated=jnp.array([False, True, False]),
        **tiny.unshielded(3),
    )
    # Phase 1 ends with zone weight 0, phase 2 with 1.
    assert trainer.score(results, CONFIG, 1) == pytest.approx((100 + 10) / 3)
    assert trainer.score(results, CONFIG, 2) == pytest.approx((100 - 4) / 3)


def test_the_run_folder_records_what_runs(run):
    record = json.loads((run.checkpoints()[0] / "record.json").read_text())
    assert record["done"] == 136
    assert TrainConfig.model_validate(record["config"]) == CONFIG
    assert os.access(run.config, os.R_OK)
