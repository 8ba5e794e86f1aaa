"""Training on several devices, in one process or in several: the same as on one up to rounding."""

import itertools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny
from support.tiny import CONFIG, UNREFINED

from koz_jax.errors import SettingsError
from koz_jax.learning import train_step
from koz_jax.runs import checkpoint, sharding
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.metrics_log import read_metrics
from koz_jax.runs.trainer import train
from koz_jax.storage import archive, pytrees

STEPS = 4
ONE_CASE = ["--devices", 2, "--cases", 1]

# Some steps on four devices, from the state that one device begins with.
TRAIN = """
import sys, pathlib
import jax, jax.numpy as jnp
from support.tiny import UNREFINED
from koz_jax.learning import train_step
from koz_jax.runs import checkpoint, sharding
from koz_jax.runs.folder import RunFolder
from koz_jax.storage import archive
assert jax.local_device_count() == 4
folder = pathlib.Path(sys.argv[1])
begun = archive.load_tree(RunFolder(folder / "run").checkpoint(0), checkpoint.template(UNREFINED))
state = sharding.place(begun.train, 4)
for _ in range(2):
    state, metrics = train_step.train_chunk(UNREFINED, state, jnp.int32(int(sys.argv[2])))
    placed = sharding.place(state, 4)
    assert all(one is other for one, other in zip(*map(jax.tree.leaves, (placed, state)), strict=True))  # at no cost
    for leaf in (state.buffer.rows.observation, state.buffer.rows.truncated, state.env_states.body.q_BN):
        shards = leaf.addressable_shards
        assert len({shard.device for shard in shards}) == 4
        assert sum(shard.data.size for shard in shards) == leaf.size  # divided, not copied
assert train_step.train_chunk._cache_size() == 1
archive.save_tree(folder / "state", (state, metrics), {})
"""

# Runs train.py, and sends the second of two processes a signal in the second phase.
DRIVER = """
import os, runpy, signal, sys
from koz_jax.runs.progress import Progress
sys.argv = sys.argv[1:]
advance = Progress.advance
def advance_and_signal(bar, done):
    advance(bar, done)
    if done == 80 and sys.argv[-2:] == ["--process", "1"]:
        os.kill(os.getpid(), signal.SIGTERM)
Progress.advance = advance_and_signal
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def interrupted(*_: Any) -> None:
    raise KeyboardInterrupt


@pytest.fixture(scope="module")
def four(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What four devices have come to."""
    folder = tmp_path_factory.mktemp("four")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train_step, "train_chunk", interrupted)
        with pytest.raises(KeyboardInterrupt):
            train(UNREFINED, folder / "run", progress=False)
    done = tiny.run_python("-c", TRAIN, folder, STEPS, cwd=tiny.ROOT / "tests", variables=tiny.devices(4))
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


@pytest.mark.slow
def test_steps_on_four_devices_equal_those_on_one(four):
    state = train_step.init(CONFIG, jax.random.key(0))
    for _ in range(2):
        state, metrics = train_step.train_chunk(CONFIG, state, jnp.int32(STEPS))
    found = archive.load_tree(four / "state", jax.eval_shape(lambda: (state, metrics)))
    for (path, one), (_, other) in zip(
        jax.tree_util.tree_leaves_with_path(pytrees.key_data(found)),
        jax.tree_util.tree_leaves_with_path(pytrees.key_data((state, metrics))),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-5, err_msg=jax.tree_util.keystr(path))


def assert_like_the_run_on_one_device(folder: RunFolder) -> None:
    one, other = (read_metrics(path / "metrics.csv") for path in (folder.path, tiny.finished_run().path))
    assert [row["updates"] for row in one[:8]] == [row["updates"] for row in other[:8]]
    # Rounding grows from update to update, so that only the first ones can be compared.
    for early, name in itertools.product((0, 1), ("critic_loss", "actor_loss", "entropy", "q_mean")):
        found, expected = (float(rows[early][f"train/{name}"]) for rows in (one, other))
        assert found == pytest.approx(expected, rel=2e-3)
    # Its checkpoint is one like any other.
    config = folder.read_config()
    state = archive.load_tree(folder.checkpoints()[0], checkpoint.template(config))
    assert state.done == config.length == int(one[-1]["updates"])


@pytest.mark.slow
def test_two_processes_of_two_devices_train_as_one_device(tmp_path):
    folder = RunFolder(tmp_path / "run")
    begin = ["-c", DRIVER, "train.py", *tiny.FLAGS, "--refine.iterations", 0, *ONE_CASE, "--run", folder.path]
    # One is told, both stop: in the second phase, to which the best learner of the first one was handed on.
    assert "stopped; go on with" in tiny.ended(tiny.begin_two(*begin), 0, 0)[0]
    assert [int(row["updates"]) for row in read_metrics(folder.path / "metrics.csv")] == [16, 32, 48, 64, 80]
    # One device goes on from there.
    assert train(folder.read_config(), folder.path, resume=True, progress=False) is not None
    assert_like_the_run_on_one_device(folder)


@pytest.mark.slow
def test_a_run_that_one_process_refuses_ends_in_all(tmp_path):
    folder = RunFolder(tmp_path / "run")
    (folder.path / "thesis").mkdir(parents=True)
    errors = tiny.ended(tiny.begin_two("train.py", *tiny.FLAGS, *ONE_CASE, "--run", folder.path), 2, 2)
    assert f"run: {folder.path} exists already" in errors[0]
    assert "processes: another process has failed" in errors[1]
    assert [path.name for path in folder.path.iterdir()] == ["thesis"]


def test_impossible_numbers_of_devices_are_refused(tmp_path, capsys, monkeypatch):
    with pytest.raises(SettingsError, match="devices: must be from 1 to 1, the devices that there are; got 2"):
        sharding.check(CONFIG, 2)
    monkeypatch.setattr(sharding.jax, "local_devices", lambda: [None] * 3)
    with pytest.raises(SettingsError, match="devices: must divide num_envs = 8; got 3"):
        sharding.check(CONFIG, 3)
    for argv in (["--devices", 0], ["--devices", 2, "--seeds", 2]):
        assert tiny.status("train", *argv, "--run", tmp_path / "run") == 2
        assert "error: devices: " in capsys.readouterr().err
