"""One process per folder of results, told by name, however it ends."""

import os
import subprocess
import sys

import pytest
from support import tiny

from koz_jax.errors import SettingsError
from koz_jax.storage.lock import FolderLock

HOLD = "import sys, signal, pathlib; from koz_jax.storage.lock import FolderLock\n"
HOLD += "held = FolderLock(pathlib.Path(sys.argv[1])); print('held', flush=True); signal.pause()"


def test_the_holder_is_named_however_often_others_try_and_gives_the_lock_up_when_killed(tmp_path):
    command = [sys.executable, "-c", HOLD, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=tiny.ROOT) as process:
        assert process.stdout is not None
        process.stdout.readline()
        for _ in range(3):  # the second would not find what the first had erased
            with pytest.raises(SettingsError, match=f"run: {tmp_path} is in use by another process .pid {process.pid}"):
                FolderLock(tmp_path)
        process.kill()
        process.wait()
    with FolderLock(tmp_path):
        assert (tmp_path / "lock").read_text() == f"pid {os.getpid()}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["lock"]


def test_a_process_does_not_share_a_folder_with_itself_and_may_take_it_again(tmp_path):
    for _ in range(2):
        with FolderLock(tmp_path):
            with pytest.raises(SettingsError, match=rf"partial: .* is in use by another process \(pid {os.getpid()}\)"):
                FolderLock(tmp_path, "partial")


def test_what_cannot_be_locked_is_named(tmp_path):
    (tmp_path / "lock").mkdir()
    with pytest.raises(SettingsError, match=r"run: .*lock cannot be written: Is a directory"):
        FolderLock(tmp_path)
