"""What a table needs beside its numbers: the command that made it, the commit, and the machine."""

import functools
import os
import platform
import shlex
import subprocess
import time
from importlib import metadata
from pathlib import Path

import numpy as np

from koz_jax.storage import files

_ROOT = Path(__file__).resolve().parent.parent
_SIDE = 2048


def write_table(path: Path, argv: list[str], table: str) -> None:
    """Write a Markdown table with its origin above it, for a page to include.  argv: what the command was given."""
    _write(path, f"Made by `{shlex.join(['python', *argv])}` at commit {commit()}; {machine()}.", table)


def _write(path: Path, head: str, table: str) -> None:
    files.write_text(path, f"<!-- made by a command, see below; do not edit -->\n{head}\n\n{table}\n")


class GrowingTable:
    """A table whose rows take long: written after each, with the commit of each.

    Rows of earlier runs that the file holds are kept until they are made again.
    """

    def __init__(self, path: Path | None, program: str, columns: tuple[str, ...], order: list[tuple[str, str]]) -> None:
        """path: None prints only.  order: first two cells of all rows that there can be."""
        self._path, self._program, self._order = path, program, order
        self._head = [row([*columns, "commit"]), row(["---"] * (len(columns) + 1))]
        self._rows = {} if path is None or not path.exists() else self._kept(path.read_text(encoding="utf-8"))
        print("\n".join(self._head))

    def add(self, cells: list[str]) -> None:
        """Print a row, and write it."""
        made = [*cells, commit()]
        print(row(made), flush=True)
        self._rows[made[0], made[1]] = made
        if self._path is not None:
            rows = [row(self._rows[key]) for key in self._order if key in self._rows]
            head = f"Rows of `python {self._program}`, each at its commit; the last one made on {machine()}."
            _write(self._path, head, "\n".join([*self._head, *rows]))

    def _kept(self, text: str) -> dict[tuple[str, str], list[str]]:
        lines = [line for line in text.splitlines() if line.startswith("|")]
        rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
        same_columns = bool(rows) and row(rows[0]) == self._head[0]
        return {(cells[0], cells[1]): cells for cells in rows} if same_columns else {}


def row(cells: list[str]) -> str:
    """A row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


@functools.cache
def commit() -> str:
    """Abbreviated commit of the checkout, marked where tracked files differ from it before a table is written."""
    command = ["git", "-C", str(_ROOT), "describe", "--always", "--abbrev=7", "--exclude=*", "--dirty=+changes"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    return found.stdout.strip() or "unknown"


def machine() -> str:
    """Processor, cores that may be used, rate of a matrix product, versions."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("jax", "numpy"))
    return (
        f"{cores} cores of {_processor()}, {matmul_rate() / 1e9:.0f} GFLOP/s (NumPy, float32, {_SIDE} x {_SIDE}"
        f" matrices), Python {platform.python_version()}, {versions}"
    )


def matmul_rate(repeats: int = 5) -> float:
    """FLOP/s of a large float32 matrix product on all cores, the best of several."""
    left = np.ones((_SIDE, _SIDE), np.float32)
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        np.matmul(left, left)
        seconds.append(time.perf_counter() - start)
    return 2.0 * _SIDE**3 / min(seconds)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.machine()
    return next((line.partition(": ")[2] for line in lines if line.startswith("model name")), platform.machine())
