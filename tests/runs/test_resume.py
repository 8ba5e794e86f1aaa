"""Stopping and going on changes nothing."""

import signal
import subprocess
import sys
from typing import Any

import jax
import numpy as np
import pytest
from support import tiny
from support.runs import assert_same_run, assert_same_tree, signal_after, state_of
from support.tiny import CONFIG

from koz_jax.agents.agent import load_agent
from koz_jax.learning import train_step
from koz_jax.runs import checkpoint, trainer
from koz_jax.runs.checkpoint import Checkpoint, RunState
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.interrupt import GracefulShutdown
from koz_jax.runs.progress import Progress
from koz_jax.runs.trainer import train
from koz_jax.sac import replay_buffer


# 48, 112 and 134 are between evaluations, where only the stop itself makes the checkpoint; the others end a stage.
@pytest.mark.slow
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


@pytest.mark.slow
def test_a_run_stopped_twice_equals_the_undisturbed_one(run, tmp_path):
    folder = RunFolder(tmp_path / "run")
    with signal_after(16, signal.SIGINT):
        assert train(CONFIG, folder.path, progress=False) is None
    with signal_after(80, signal.SIGTERM):
        assert train(CONFIG, folder.path, resume=True, progress=False) is None
    assert train(CONFIG, folder.path, resume=True, progress=False) is not None
    assert_same_run(folder, run)


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_signal_before_the_first_update_makes_a_checkpoint_too(run, tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run")
    begin = checkpoint.begin

    def signalled(*args: Any) -> RunState:
        signal.raise_signal(signal.SIGTERM)
        return begin(*args)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "begin", signalled)
        assert train(CONFIG, folder.path, progress=False) is None
    assert state_of(folder.checkpoints()[0]).done == 0
    assert train(CONFIG, folder.path, resume=True, progress=False) is not None
    assert_same_run(folder, run)


@pytest.mark.parametrize("second", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_aborts_at_once(second):
    code = (
        "import signal\n"
        "from koz_jax.runs.interrupt import GracefulShutdown\n"
        "with GracefulShutdown() as shutdown:\n"
        "    signal.raise_signal(signal.SIGINT)\n"
        "    print(shutdown.requested, flush=True)\n"
        f"    signal.raise_signal({int(second)})\n"
        "    print('still here', flush=True)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (-second, "True\n")
    assert "SIGINT: finishing the chunk, then checkpointing; again to abort at once" in done.stderr


def test_handlers_are_put_back():
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with GracefulShutdown() as shutdown:
        assert signal.getsignal(signal.SIGINT) != before[signal.SIGINT]
        signal.raise_signal(signal.SIGTERM)
        assert shutdown.requested
    assert {number: signal.getsignal(number) for number in before} == before


@pytest.mark.slow
def test_resuming_a_finished_run_returns_its_agent_without_training(run, copied, no_compute):
    before = tiny.contents(copied.path)
    agent = train(CONFIG, copied.path, resume=True, progress=False)
    assert agent is not None
    saved = load_agent(run.path)
    assert_same_tree(agent.controller, saved.controller)
    assert agent.provenance.updates == saved.provenance.updates
    assert tiny.contents(copied.path) == before


def test_start_from_takes_learner_and_buffer(run, tmp_path):
    for source in (run.snapshot("phase1"), run.path):
        expected = state_of(source if source != run.path else run.checkpoints()[0]).train
        with pytest.MonkeyPatch.context() as patch:
            begun: list[RunState] = []

            def catch(_: Any, saved: Checkpoint, __: Any, begun: list[RunState] = begun) -> None:
                begun.append(saved.state)

            patch.setattr(trainer._Run, "go", catch)
            train(CONFIG, tmp_path / source.name, start_from=source, progress=False)
        (state,) = begun
        assert_same_tree(state.train.learner, expected.learner)
        assert_same_tree(state.train.buffer, replay_buffer.truncate_newest(expected.buffer))
        assert_same_tree(state.best, expected.learner)
        assert state.done == 0 and float(state.best_score) == -np.inf
        fresh = train_step.init(CONFIG, jax.random.key(CONFIG.seed))
        assert_same_tree(state.train.env_states, fresh.env_states)
        assert_same_tree(state.train.key, fresh.key)


@pytest.mark.slow
def test_start_from_trains(run, tmp_path):
    # The same seed and settings, but a head start: another result.
    agent = train(CONFIG, tmp_path / "run", start_from=run.snapshot("phase1"), progress=False)
    assert agent is not None
    observed = np.ones((4, 16), np.float32)
    assert not np.allclose(agent.predict(observed), load_agent(run.path).predict(observed), atol=1e-4)
