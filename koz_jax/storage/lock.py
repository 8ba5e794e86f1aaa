"""One process per folder of results.  The system gives the lock up when the process ends, however it ends."""

import os
from pathlib import Path
from typing import Self

from filelock import FileLock, Timeout

from koz_jax.errors import SettingsError

LOCK = "lock"


class FolderLock:
    """Holds the file ``lock`` of a folder, in which the holder writes its process id."""

    def __init__(self, folder: Path, name: str = "run") -> None:
        """Take the lock of an existing folder; does not wait for it.  name: the setting that gave the folder.

        Raises:
            SettingsError: another process (or this one already) holds it, or the folder cannot be written.

        """
        path = folder / LOCK
        # Not a lock that is the existence of a file, where the system has no better: a killed process would leave it.
        # The file stays: to remove it could take the lock of one who has just opened it.
        self._lock = FileLock(path, blocking=False, fallback_to_soft=False, preserve_lock_file=True)
        try:
            self._lock.acquire()
        except Timeout:
            raise SettingsError(
                f"{name}: {folder} is in use by another process ({_holder(path)}); wait for it, or choose another"
                " folder"
            ) from None
        except OSError as error:
            raise SettingsError(f"{name}: {path} cannot be written: {error.strerror or error}") from None
        try:
            path.write_text(f"pid {os.getpid()}\n", encoding="ascii")
        except OSError as error:
            self._lock.release()
            raise SettingsError(f"{name}: {path} cannot be written: {error.strerror or error}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.release()


def _holder(path: Path) -> str:
    """What the holder of a lock has written into it."""
    try:
        return path.read_text(encoding="ascii").strip() or "unknown"
    except (OSError, ValueError):
        return "unknown"
