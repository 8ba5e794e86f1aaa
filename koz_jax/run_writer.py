"""What a run leaves in its folder while it goes on: the log, checkpoints, snapshots, agents.

Only the first of several processes writes.  A write that fails does not raise: where only one process writes, the
others would wait for it for ever.  ``error`` has it, for all to agree on at the end of the chunk.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from koz_jax import processes
from koz_jax.agent import Agent
from koz_jax.config import TrainConfig
from koz_jax.errors import UserError
from koz_jax.metrics_log import MetricsLog
from koz_jax.run_folder import Checkpoint, RunFolder, RunState, record_of
from koz_jax.writer import Writer


class RunWriter:
    """Writes into the folder of a run under way."""

    def __init__(self, folder: RunFolder, config: TrainConfig, saved: Checkpoint) -> None:
        """Go on from a checkpoint: later ones, which training has left, are removed, and the log is cut."""
        self._folder = folder
        self._config = config
        self._states = Writer()
        self._log: MetricsLog | None = None
        self._error: UserError | None = None
        self._attempt(lambda: self._open(saved))

    def _open(self, saved: Checkpoint) -> None:
        self._folder.prune(saved.state.done)
        self._log = MetricsLog(self._folder.path, saved.log, saved.state.done)

    def _attempt(self, write: Callable[[], None]) -> None:
        """Write, if this process does and nothing failed before."""
        if processes.leads() and self._error is None:
            try:
                write()
            except UserError as error:
                self._error = error

    @property
    def error(self) -> UserError | None:
        """The first write that failed; does not wait for one under way."""
        self._attempt(self._states.check)
        return self._error

    def row(self, done: int, values: Mapping[str, float], times: Mapping[str, float]) -> None:
        """Append a row to the log, as ``MetricsLog.write`` does."""
        self._attempt(lambda: self._opened.write(done, values, times))

    def checkpoint(self, state: RunState) -> None:
        """Begin to write a checkpoint; those before the last two go when it is whole."""

        def write() -> None:
            record = record_of(state, self._config, self._opened.text)
            self._states.save(self._folder.checkpoint(state.done), state, record, self._folder.prune)

        self._attempt(write)

    def snapshot(self, name: str, state: RunState) -> None:
        """Begin to write a snapshot, from which other runs can start."""
        self._attempt(lambda: self._states.save(self._folder.snapshot(name), state, record_of(state, self._config)))

    def agent(self, folder: Path, agent: Agent) -> None:
        """Write an agent."""
        self._attempt(lambda: agent.save(folder))

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
            UserError: a write failed.

        """
        try:
            self._states.__exit__(kind, error, trace)
        finally:
            if self._log is not None:
                self._attempt(self._log.close)
        if kind is None and self._error is not None:
            raise self._error
