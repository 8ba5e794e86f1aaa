"""One process per folder of results.  The system gives the lock up when the process ends, however it ends."""

import os
from pathlib import Path
from typing import IO, Self

from koz_jax.errors import UserError

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None

LOCK = "lock"


class FolderLock:
    """Holds the file ``lock`` of a folder."""

    def __init__(self, folder: Path, name: str = "run") -> None:
        """Take the lock of an existing folder.  name: the setting that gave the folder, for messages.

        Raises:
            UserError: another process (or this one already) holds it, or the folder cannot be written.

        """
        self._file: IO[str] | None = None
        path = folder / LOCK
        try:
            file = open(path, "a+", encoding="ascii")
        except OSError as error:
            raise UserError(f"{name}: {path} cannot be written: {error.strerror}") from None
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                holder = file.read().strip()
                file.close()
                raise UserError(
                    f"{name}: {folder} is in use by another process ({holder or 'unknown'}); wait for it, or"
                    " choose another folder"
                ) from None
            except OSError as error:
                file.close()
                raise UserError(f"{name}: {path} cannot be locked: {error.strerror}") from None
        try:
            file.truncate(0)
            file.write(f"pid {os.getpid()}\n")
            file.flush()
        except OSError as error:
            file.close()
            raise UserError(f"{name}: {path} cannot be written: {error.strerror}") from None
        self._file = file

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            # The file stays: to remove it could take the lock of one who has just opened it.
            self._file.close()
