"""Very many cases in blocks: memory is bounded, progress is shown, and finished blocks can be kept on disk.

A case is its index, and blocks consist of the chunks that one single flight would consist of, so that the results are
the same to the last bit.
"""

import dataclasses
import hashlib
import json
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from koz_jax import evaluation, processes, storage
from koz_jax.controllers.base import Pilot
from koz_jax.errors import UserError, warn
from koz_jax.evaluation import MonteCarlo, MonteCarloConfig
from koz_jax.lock import LOCK, FolderLock
from koz_jax.rollout import CaseResult
from koz_jax.task_config import TaskConfig

BLOCK = 50_000  # cases


@dataclasses.dataclass(frozen=True)
class _Flown:
    """A block of cases."""

    results: CaseResult  # NumPy leaves (cases,)
    compile_s: float
    wall_s: float


def run_cases(
    pilot: Pilot,
    task_config: TaskConfig,
    config: MonteCarloConfig,
    *,
    partial: Path | None = None,
    block: int = BLOCK,
    progress: bool = True,
) -> MonteCarlo:
    """Fly cases as ``evaluation.run_cases`` does, in blocks.

    Args:
        pilot: who flies.
        task_config: what is flown.
        config: which cases.
        partial: folder for finished blocks; those that are there already are not flown again.  Several processes
            (see ``runtime.join``) need one that all of them see: each flies its share of the blocks.
        block: cases per block, a multiple of 500.
        progress: show a progress bar on stderr where there is more than one block.

    Raises:
        UserError: the folder holds something else, or blocks of another flight.

    """
    evaluation.check_feasible(task_config, config.max_angle_deg)
    count = jax.process_count()
    if count > 1 and partial is None:
        raise UserError(f"partial: {count} processes need a folder that all of them see, got none")
    identity = {} if partial is None else _identity(pilot, task_config, config)
    processes.require_same("what is flown", (identity, config.first, config.cases, block))
    parts = _parts(config, block)
    mine = parts[jax.process_index() :: count]
    with ExitStack() as stack:
        if partial is not None:
            processes.together(lambda: _open(partial, stack))
        shown = progress and len(parts) > 1 and processes.leads()
        cases = sum(part.cases for part in mine)
        bar = stack.enter_context(tqdm(total=cases, unit="case", file=sys.stderr, disable=not shown))

        def fly_mine() -> list[_Flown]:
            found = []
            for done in _fly(pilot, task_config, mine, partial, identity):
                found.append(done)
                bar.update(len(done.results.settled))
            return found

        start = time.perf_counter()
        flown = processes.together(fly_mine)
        compile_s = sum(done.compile_s for done in flown)
        wall_s = sum(done.wall_s for done in flown)
        if count > 1:
            wall_s = time.perf_counter() - start - compile_s  # of the slowest
            flown = list(_fly(pilot, task_config, parts, partial, identity))  # all are there to be read
    results = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(done.results for done in flown))
    return MonteCarlo(pilot.name, config, results, compile_s, wall_s)


def _open(partial: Path, stack: ExitStack) -> None:
    """Take the folder of blocks: the first process does for all."""
    if processes.leads():
        _check_folder(partial)
        stack.enter_context(FolderLock(partial, "partial"))


def _parts(config: MonteCarloConfig, block: int) -> list[MonteCarloConfig]:
    """The flight's blocks."""
    starts = range(config.first, config.first + config.cases, block)
    end = config.first + config.cases
    return [dataclasses.replace(config, first=first, cases=min(block, end - first)) for first in starts]


def _fly(
    pilot: Pilot,
    task_config: TaskConfig,
    parts: list[MonteCarloConfig],
    partial: Path | None,
    identity: dict[str, Any],
) -> Iterator[_Flown]:
    compiled = False
    for part in parts:
        folder = None if partial is None else partial / f"block-{part.first:010d}"
        found = None if folder is None else _read(folder, pilot, task_config, part, identity)
        if found is None:
            found = _fly_block(pilot, task_config, part, compiled=compiled)
            compiled = True
            if folder is not None:
                record = {"cases": part.cases, "flight": identity, "wall_s": found.wall_s}
                storage.save_tree(folder, found.results, record)
        yield found


def _fly_block(pilot: Pilot, task_config: TaskConfig, part: MonteCarloConfig, *, compiled: bool) -> _Flown:
    """Fly one block; the first one is compiled, and timed apart from that."""
    if not compiled:
        first = evaluation.run_cases(pilot, task_config, part)
        return _Flown(first.results, first.compile_s, first.wall_s)
    start = time.perf_counter()
    results = evaluation.fly_cases(pilot.controller, task_config, part)
    return _Flown(results, 0.0, time.perf_counter() - start)


def _read(
    folder: Path, pilot: Pilot, task_config: TaskConfig, part: MonteCarloConfig, identity: dict[str, Any]
) -> _Flown | None:
    """Read a finished block; None if there is none, or a damaged one (which is named), or one of fewer cases."""
    if not folder.exists():
        return None
    try:
        record = storage.read_record(folder)
        saved = record.get("flight")
        if record.get("cases") == part.cases and saved == identity:
            shapes = evaluation.result_shapes(pilot.controller, task_config, part)
            results = jax.tree.map(np.asarray, storage.load_tree(folder, shapes))
            return _Flown(results, 0.0, float(record["wall_s"]))
    except UserError as damage:
        warn(f"{damage}; these cases are flown again")
        return None
    other = [name for name in identity if not isinstance(saved, dict) or saved.get(name) != identity[name]]
    if other:
        raise UserError(
            f"partial: {folder.parent} holds cases of another flight (another {', '.join(other)}); choose another"
            " folder"
        )
    return None


def _identity(pilot: Pilot, task_config: TaskConfig, config: MonteCarloConfig) -> dict[str, Any]:
    """What results depend on, besides the cases' numbers; as JSON gives it back."""
    arrays = storage.to_arrays(pilot.controller)
    digest = hashlib.sha256(str(jax.tree.structure(pilot.controller)).encode())
    for name, array in arrays.items():
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    settings = {
        field.name: getattr(config, field.name)
        for field in dataclasses.fields(config)
        if field.name not in ("cases", "first")
    }
    flight = {"controller": digest.hexdigest(), "task": task_config, **settings}
    return json.loads(json.dumps(flight, default=lambda value: value.model_dump()))


def _check_folder(folder: Path) -> None:
    """Make the folder, or refuse one with other things in it."""
    storage.make_folder("partial", folder)
    others = sorted(path.name for path in folder.iterdir() if "block-" not in path.name and path.name != LOCK)
    if others:
        raise UserError(f"partial: {folder} holds other things ({', '.join(others[:3])}); choose another folder")
