"""What a run leaves in its folder while it goes on: the log, checkpoints, snapshots, agents.

Only the first of several processes writes.  A write that fails does not raise: where only one process writes, the
others would wait for it for ever.  ``error`` has it, for all to agree on at the end of the chunk.
"""

import concurrent.futures
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from koz_jax.agents.agent import Agent
from koz_jax.config.training import TrainConfig
from koz_jax.errors import StorageError
from koz_jax.runs import checkpoint
from koz_jax.runs.checkpoint import Checkpoint, RunState
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.metrics_log import MetricsLog
from koz_jax.storage import processes


class RunWriter:
    """Writes into the folder of a run under way; training states in a thread, one at a time, while training goes on."""

    def __init__(self, folder: RunFolder, config: TrainConfig, saved: Checkpoint) -> None:
        """Go on from a checkpoint: later ones, which training has left, are removed, and the log is cut."""
        self._folder = folder
        self._config = config
        self._thread = concurrent.futures.ThreadPoolExecutor(1, "checkpoint")
        self._pending: concurrent.futures.Future[None] | None = None
        self._log: MetricsLog | None = None
        self._error: StorageError | None = None
        self._attempt(lambda: self._open(saved))

    def _open(self, saved: Checkpoint) -> None:
        self._folder.prune(saved.state.done)
        self._log = MetricsLog(self._folder.path, saved.log, saved.state.done)

    def _attempt(self, write: Callable[[], None]) -> None:
        """Write, if this process does and nothing failed before."""
        if processes.is_primary_process() and self._error is None:
            try:
                write()
            except StorageError as error:
                self._error = error

    @property
    def error(self) -> StorageError | None:
        """The first write that failed; does not wait for one under way."""
        if self._pending is not None and self._pending.done():
            self._attempt(self._wait)
        return self._error

    def row(self, done: int, values: Mapping[str, float], times: Mapping[str, float]) -> None:
        """Append a row to the log, as ``MetricsLog.write`` does."""
        self._attempt(lambda: self._opened.write(done, values, times))

    def checkpoint(self, state: RunState) -> None:
        """Begin to write a checkpoint; those before the last two go when it is whole."""
        self._attempt(
            lambda: self._save(self._folder.checkpoint(state.done), state, self._opened.text, self._folder.prune)
        )

    def snapshot(self, name: str, state: RunState) -> None:
        """Begin to write a snapshot, from which other runs can start."""
        self._attempt(lambda: self._save(self._folder.snapshot(name), state))

    def _save(self, folder: Path, state: RunState, log: str = "", after: Callable[[], None] = lambda: None) -> None:
        """Begin to save a state.  after: called in the thread when it is whole."""
        self._wait()  # two copies of a state at once would be too many
        copy = checkpoint.copy_to_host(state, self._config, log)

        def write() -> None:
            copy.write(folder)
            after()

        self._pending = self._thread.submit(write)

    def _wait(self) -> None:
        """Wait until no state is being written; raises the error of one that failed."""
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def agent(self, name: str, agent: Agent) -> None:
        """Write an agent."""
        self._attempt(lambda: agent.save(self._folder.agent(name)))

    @property
    def _opened(self) -> MetricsLog:
        assert self._log is not None  # or there is an error, and nothing is written
        return self._log

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish what is being written.

        Raises:
            StorageError: a write failed.

        """
        try:
            if kind is None:
                self._attempt(self._wait)
        finally:
            self._thread.shutdown()
            if self._log is not None:
                self._attempt(self._log.close)
        if kind is None and self._error is not None:
            raise self._error
