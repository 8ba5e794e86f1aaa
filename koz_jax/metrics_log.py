"""Training curves: one CSV row per logged chunk, and the same numbers for TensorBoard."""

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
from tensorboardX import SummaryWriter

from koz_jax import storage


def flatten(prefix: str, tree: Any) -> dict[str, float]:
    """Scalars of a struct under ``prefix/field`` names."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {f"{prefix}/" + "/".join(str(part).strip(".") for part in path): float(leaf) for path, leaf in leaves}


class MetricsLog:
    """Writes ``metrics.csv`` and TensorBoard events into a run folder."""

    def __init__(self, folder: Path, resume_at: int) -> None:
        """Open the log; rows past update ``resume_at`` belong to work that was lost, and are dropped."""
        self._path = folder / "metrics.csv"
        rows = read_metrics(self._path) if self._path.exists() else []
        kept = [row for row in rows if int(row["updates"]) <= resume_at]
        self._columns: list[str] = list(kept[0]) if kept else []
        if kept:
            lines = [",".join(self._columns), *(",".join(row[name] for name in self._columns) for row in kept)]
            storage.write_text(self._path, "\n".join(lines) + "\n")
        else:
            self._path.unlink(missing_ok=True)
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=resume_at + 1)

    def write(self, updates: int, values: Mapping[str, float | None]) -> None:
        """Append one row.  None leaves a cell empty; every row must have the same names."""
        if not self._columns:
            self._columns = ["updates", *values]
            self._append(self._columns)
        cells = {name: "" if value is None else f"{value:.9g}" for name, value in values.items()}
        self._append([str(updates), *(cells[name] for name in self._columns[1:])])
        for name, value in values.items():
            if value is not None and math.isfinite(value):
                self._board.add_scalar(name, value, updates)

    def _append(self, cells: list[str]) -> None:
        with open(self._path, "a", newline="") as file:
            csv.writer(file).writerow(cells)

    def close(self) -> None:
        """Flush the TensorBoard events."""
        self._board.close()


def read_metrics(path: Path) -> list[dict[str, str]]:
    """The rows of a ``metrics.csv``."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))
