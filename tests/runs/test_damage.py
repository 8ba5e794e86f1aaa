"""Damaged checkpoints, writes that fail, and checkpoints of the version before."""

import os
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import tiny
from support.runs import assert_same_run, assert_same_tree, signal_after, state_of
from support.tiny import CONFIG

from koz_jax.errors import StorageError
from koz_jax.runs import checkpoint
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.trainer import train
from koz_jax.storage import archive


def damage(folder: Path) -> None:
    """Cut the arrays short."""
    path = folder / "arrays.npz"
    path.write_bytes(path.read_bytes()[:-5])


@pytest.mark.slow
def test_a_damaged_checkpoint_is_named_and_the_one_before_is_used(run, copied, caplog):
    newest, before = copied.checkpoints()
    damage(newest)
    assert train(CONFIG, copied.path, resume=True, progress=False) is not None
    warned = f"{newest / 'arrays.npz'}: damaged: its checksum is not the one in record.json; going on from"
    assert caplog.messages == [f"{warned} {before} instead"]
    assert_same_run(copied, run)
    assert copied.checkpoints() == [newest, before]


def test_start_from_skips_a_damaged_checkpoint_too(copied, caplog):
    newest, before = copied.checkpoints()
    (newest / "record.json").unlink()
    found = checkpoint.load_source(copied.path, CONFIG)
    assert_same_tree(found, state_of(before))
    assert caplog.messages == [f"{newest / 'record.json'}: no such file; going on from {before} instead"]
    assert copied.checkpoints() == [newest, before]  # another run's folder is only read


def test_without_a_good_checkpoint_all_damages_are_named(copied, no_compute):
    newest, before = copied.checkpoints()
    damage(newest)
    (before / "record.json").write_text('{"format": 1, "config": {}}')
    contents = tiny.contents(copied.path)
    with pytest.raises(StorageError) as caught:
        train(CONFIG, copied.path, resume=True, progress=False)
    first, *others = str(caught.value).splitlines()
    assert first.startswith(f"{newest / 'arrays.npz'}: damaged")
    assert others[0] == f"{before / 'record.json'}: curriculum: Field required"
    del contents[copied.path / "lock"]
    assert contents.items() <= tiny.contents(copied.path).items()


@pytest.mark.slow
def test_what_a_killed_write_leaves_is_cleared_away(run, copied):
    newest, before = copied.checkpoints()
    os.replace(newest, newest.with_name(f".{newest.name}.new"))
    assert train(CONFIG, copied.path, resume=True, progress=False) is not None
    assert_same_run(copied, run)
    assert sorted(path.name for path in newest.parent.iterdir()) == [before.name, newest.name]


@pytest.mark.slow
def test_a_failed_write_ends_the_run_at_the_next_chunk(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run")
    save = archive.save_arrays

    def full(path: Path, *others: Any) -> None:
        if path == folder.checkpoint(64):
            raise StorageError(f"{path}: cannot be written: No space left on device")
        save(path, *others)

    monkeypatch.setattr(archive, "save_arrays", full)
    with pytest.raises(StorageError, match=r"checkpoints/0000000064: cannot be written: No space left"):
        train(CONFIG, folder.path, progress=False)
    assert state_of(folder.checkpoints()[0]).done == 32


def test_the_last_write_is_awaited_and_its_error_shown(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run")
    save = archive.save_arrays

    def full(path: Path, *others: Any) -> None:
        if path == folder.checkpoint(48):
            time.sleep(0.3)
            raise StorageError("the disk is full")
        save(path, *others)

    monkeypatch.setattr(archive, "save_arrays", full)
    with signal_after(48, signal.SIGTERM), pytest.raises(StorageError, match="the disk is full"):
        train(CONFIG, folder.path, progress=False)


def old_names(path: Path) -> None:
    """Make a state one as version 0.1.0 saved it."""
    record = archive.read_record(path)
    record["config"]["shielding"]["shield"]["withstands"] = record["config"]["shielding"]["shield"].pop("error_bounds")
    arrays = {
        name.replace("scenario/constraints/", "scenario/zones/"): array
        for name, array in archive.read_arrays(path).items()
        if not name.endswith("constraints/boresight_B")
    }
    assert sum("scenario/zones/" in name for name in arrays) == 2
    archive.save_arrays(path, arrays, record)


def test_a_checkpoint_of_the_version_before_loads_as_it_was(run, copied):
    newest, before = copied.checkpoints()
    for path in (newest, before, copied.snapshot("phase1")):
        old_names(path)
    assert_same_tree(checkpoint.load(copied, CONFIG).state, state_of(run.checkpoints()[0]))
    assert_same_tree(checkpoint.load_source(copied.snapshot("phase1"), CONFIG), state_of(run.snapshot("phase1")))
    copied.config.write_text(copied.config.read_text().replace("error_bounds", "withstands"))
    shutil.rmtree(newest)
    assert train(copied.read_config(), copied.path, resume=True, progress=False) is not None
    assert_same_tree(state_of(copied.checkpoints()[0]), state_of(run.checkpoints()[0]))


def test_old_names_of_arrays_are_renamed_and_the_boresight_is_that_of_the_settings():
    config = tiny.changed({"task": {"spacecraft": {"boresight": (0.0, 0.6, 0.8)}}})
    zones = "train/env_states/scenario/zones"
    old = {"key": np.zeros(2), f"{zones}/axis_N": np.ones((8, 2, 3)), f"{zones}/half_angle": np.ones((8, 2))}
    new = checkpoint.upgrade(old, config)
    constraints = "train/env_states/scenario/constraints"
    assert new.keys() == {"key", *(f"{constraints}/{name}" for name in ("axis_N", "half_angle", "boresight_B"))}
    np.testing.assert_array_equal(
        new[f"{constraints}/boresight_B"], np.tile(np.array([0.0, 0.6, 0.8], np.float32), (8, 2, 1))
    )
    assert new[f"{constraints}/boresight_B"].dtype == np.float32
    assert checkpoint.upgrade(new, config) is new
