"""Writing training states in the background, one at a time, while training goes on."""

import concurrent.futures
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from koz_jax import storage


class Writer:
    """Saves copies of trees in a thread.  The next save waits for the one before."""

    def __init__(self) -> None:
        """Nothing is being written yet."""
        self._thread = concurrent.futures.ThreadPoolExecutor(1, "checkpoint")
        self._pending: concurrent.futures.Future[None] | None = None

    def save(self, folder: Path, tree: Any, record: Mapping[str, Any], after: Callable[[], None] | None = None) -> None:
        """Begin to save a tree as ``storage.save_tree`` does.

        after: called in the thread when the folder is whole.

        Raises:
            UserError: the save before this one failed.

        """
        self.wait()
        arrays = storage.to_arrays(tree)

        def write() -> None:
            storage.save_arrays(folder, arrays, record)
            if after is not None:
                after()

        self._pending = self._thread.submit(write)

    def check(self) -> None:
        """Raise the error of a save that has failed meanwhile; does not wait."""
        if self._pending is not None and self._pending.done():
            self.wait()

    def wait(self) -> None:
        """Wait until nothing is being written.

        Raises:
            UserError: the last save failed.

        """
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None) -> None:
        try:
            if kind is None:
                self.wait()
        finally:
            self._thread.shutdown()
