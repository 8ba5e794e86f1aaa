"""Training curves: one CSV row per logged chunk, and the same numbers for TensorBoard."""

import contextlib
import csv
import math
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax

from koz_jax.errors import StorageError
from koz_jax.storage import files


@contextlib.contextmanager
def _hidden(module: str) -> Iterator[None]:
    """Let imports not find a module that is not loaded yet."""
    if module in sys.modules:
        yield
        return
    sys.modules[module] = None  # pyright: ignore[reportArgumentType]
    try:
        yield
    finally:
        del sys.modules[module]


# tensorboardX loads PyTorch wherever it is installed, for seconds, to understand tensors that it is never given here.
with _hidden("torch"):
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]
    from tensorboardX.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]


def flatten(prefix: str, tree: Any) -> dict[str, float]:
    """Scalars of a struct under ``prefix/field`` names."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {f"{prefix}/" + "/".join(str(part).strip(".") for part in path): float(leaf) for path, leaf in leaves}


def last_row(text: str) -> dict[str, float]:
    """What the last row of ``metrics.csv`` holds, by the names of its columns; nothing where there is none."""
    rows = [*csv.DictReader(text.splitlines())]
    return {name: float(value) for name, value in rows[-1].items() if value} if rows else {}


class MetricsLog:
    """Writes ``metrics.csv`` and TensorBoard events into a run folder.

    ``metrics.csv`` holds nothing that depends on the machine's speed, so that it is the same whenever the run is;
    times go to TensorBoard and to ``timing.csv``, which keeps the rows of work that was lost and done again.
    """

    def __init__(self, folder: Path, text: str, resume_at: int) -> None:
        """Open the log; ``metrics.csv`` begins with ``text``, that of the checkpoint made at update ``resume_at``.

        Raises:
            StorageError: the files cannot be written.

        """
        self._path = folder / "metrics.csv"
        self._timing = folder / "timing.csv"
        self._lines = [text]
        self._columns: list[str] = text.partition("\n")[0].split(",") if text else []
        self._resumed = bool(text)
        with _writing(folder):
            if text:
                files.write_text(self._path, text)
            else:
                self._path.unlink(missing_ok=True)
            self._board = _Board(folder / "tensorboard", resume_at + 1)

    @property
    def text(self) -> str:
        """All of ``metrics.csv`` so far."""
        return "".join(self._lines)

    def write(self, done: int, values: Mapping[str, float], times: Mapping[str, float]) -> None:
        """Append one row.  The first row of a run names all columns (nan leaves a cell empty), later ones some.

        A log that is gone on with keeps its columns: what an older version did not log yet is left out of the file.

        times: what depends on the machine's speed.

        Raises:
            StorageError: the disk is full, or the file cannot be written for another reason.

        """
        if not self._columns:
            self._columns = ["updates", *values]
            self._lines.append(_append(self._path, self._columns))
        unknown = values.keys() - self._columns
        if unknown and not self._resumed:
            raise KeyError(f"columns of {self._path} do not include {sorted(unknown)}")
        shown = {name: f"{value:.9g}" for name, value in values.items() if math.isfinite(value)}
        self._lines.append(_append(self._path, [str(done), *(shown.get(name, "") for name in self._columns[1:])]))
        if not self._timing.exists():
            _append(self._timing, ["updates", *times])
        _append(self._timing, [str(done), *(f"{value:.4g}" for value in times.values())])
        self._board.write(done, {**values, **times})

    def close(self) -> None:
        """Close the TensorBoard events.

        Raises:
            StorageError: they cannot be written.

        """
        self._board.close()


class _Board:
    """TensorBoard events, written at once: a writer in a thread of its own would take a full disk to its grave."""

    def __init__(self, folder: Path, first: int) -> None:
        """Begin a file of events.  first: rows from this update on replace those of earlier files."""
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._events = EventsWriter(str(folder / "events"))
        self._add(Event(step=first, session_log=SessionLog(status=SessionLog.START)))

    def write(self, done: int, values: Mapping[str, float]) -> None:
        """Append the finite ones of some values."""
        shown = [Summary.Value(tag=name, simple_value=value) for name, value in values.items() if math.isfinite(value)]
        self._add(Event(step=done, summary=Summary(value=shown)))

    def _add(self, event: Event) -> None:
        event.wall_time = time.time()
        with _writing(self._folder):
            self._events.write_event(event)
            self._events.flush()

    def close(self) -> None:
        with _writing(self._folder):
            self._events.close()


def _append(path: Path, cells: list[str]) -> str:
    """Add a line to a file.  Returns it."""
    line = ",".join(cells) + "\n"
    with _writing(path), open(path, "a", encoding="utf-8", newline="") as file:
        file.write(line)
    return line


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Name what cannot be written."""
    try:
        yield
    except StorageError:  # which is named already
        raise
    except OSError as error:
        raise StorageError(f"{path}: cannot be written: {error.strerror or error}") from None


def read_metrics(path: Path) -> list[dict[str, str]]:
    """Read the rows of a ``metrics.csv``."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))
