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
        header, rows = _whole_lines(self._path)
        kept = [row for row in rows if int(row.split(",")[0]) <= resume_at]
        self._columns: list[str] = header.split(",") if kept else []
        if kept:
            storage.write_text(self._path, "\n".join([header, *kept, ""]))
        else:
            self._path.unlink(missing_ok=True)
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=resume_at + 1)

    def write(self, done: int, values: Mapping[str, float]) -> None:
        """Append one row.  The first row of a run names all columns (nan leaves a cell empty), later ones some."""
        if not self._columns:
            self._columns = ["updates", *values]
            self._append(self._columns)
        unknown = values.keys() - self._columns
        if unknown:
            raise KeyError(f"columns of {self._path} do not include {sorted(unknown)}")
        shown = {name: f"{value:.9g}" for name, value in values.items() if math.isfinite(value)}
        self._append([str(done), *(shown.get(name, "") for name in self._columns[1:])])
        for name in shown:
            self._board.add_scalar(name, values[name], done)

    def _append(self, cells: list[str]) -> None:
        with open(self._path, "a", newline="") as file:
            csv.writer(file, lineterminator="\n").writerow(cells)

    def close(self) -> None:
        """Flush the TensorBoard events."""
        self._board.close()


def _whole_lines(path: Path) -> tuple[str, list[str]]:
    """Header and rows of a ``metrics.csv``; a last line without its end was cut by a crash, and is left out."""
    lines = path.read_text(encoding="utf-8").split("\n")[:-1] if path.exists() else []
    return (lines[0], lines[1:]) if lines else ("", [])


def read_metrics(path: Path) -> list[dict[str, str]]:
    """Read the rows of a ``metrics.csv``."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))
