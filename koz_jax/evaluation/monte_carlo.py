"""Monte Carlo evaluation: cases of a draw in blocks, with bounded memory, progress, and finished blocks kept on disk.

A case is its index, and blocks consist of the chunks that one single flight would consist of, so that the results are
the same to the last bit.
"""

import dataclasses
import hashlib
import json
import logging
import math
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from koz_jax import devices
from koz_jax.config.base import checked
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig, check_feasible, is_paper_task
from koz_jax.control.base import Controller, TaskController
from koz_jax.control.registry import as_task_controller
from koz_jax.errors import SettingsError, StorageError
from koz_jax.evaluation import cases, cautions
from koz_jax.evaluation.cases import Flown
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.evaluation.summary import Summary
from koz_jax.storage import archive, files, processes, pytrees
from koz_jax.storage.lock import LOCK, FolderLock

BLOCK = 50_000  # cases
BLOCK_ON_GPU = 500_000  # cases; of such a block a GPU has the results in a second

_log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class MonteCarlo:
    """The outcome of every case, and what it took."""

    agent: str  # name of the agent, or the folder it came from
    task: TaskConfig  # that was flown
    config: MonteCarloConfig
    results: CaseResult  # NumPy leaves (cases,)
    compile_s: float  # [s] tracing and compiling
    wall_s: float  # [s] flying

    @property
    def label(self) -> str:
        """Who flew, for tables and titles."""
        return self.agent if self.config.shield is None else f"{self.agent} + {self.config.shield.name}"

    @property
    def is_of_paper(self) -> bool:
        """Whether the paper's numbers are of the same task."""
        return self.config.is_papers_draw and is_paper_task(self.task)


def monte_carlo(
    agent: TaskController | Controller,
    cases: int = 10_000,
    seed: int = 0,
    task: TaskConfig | None = None,
    *,
    partial: Path | None = None,
    progress: bool = False,
    **options: Any,
) -> MonteCarlo:
    """Fly an agent over ``cases`` random cases of the task it was trained for (or of another one).

    Args:
        agent: who flies; a controller without a task flies the paper's.
        cases: number of cases.
        seed: seed of the draw; case i of a seed is always the same.
        task: what is flown; by default what the agent was made for.
        partial: folder for finished blocks of cases, from which an interrupted evaluation goes on.
        progress: show a progress bar on stderr where there is more than one block.
        options: further fields of ``MonteCarloConfig``.

    Raises:
        SettingsError: an option is not allowed, or the controller cannot fly.

    """
    config = checked(MonteCarloConfig, cases=cases, seed=seed, **options)
    flying = as_task_controller(agent, task)
    return run_cases(flying, task or flying.task, config, partial=partial, progress=progress)


def report(flown: MonteCarlo, summary: Summary) -> dict[str, float | int | str | None]:
    """Put the results into a JSON object (keys as in the documentation of ``eval_mc.py``); nan becomes null."""
    scaled = {
        "settling_time_scaled_mean": summary.settling_time_mean * flown.task.time_to_paper,
        "control_effort_scaled_mean": summary.control_effort_mean * flown.task.effort_to_paper,
    }
    rows = {name: None if math.isnan(value) else value for name, value in (vars(summary) | scaled).items()}
    return {
        "cases": flown.config.cases,
        "seed": flown.config.seed,
        "agent": flown.agent,
        **rows,
        "compile_s": flown.compile_s,
        "wall_s": flown.wall_s,
    }


def run_cases(
    agent: TaskController,
    task: TaskConfig,
    config: MonteCarloConfig,
    *,
    partial: Path | None = None,
    block: int | None = None,
    progress: bool = True,
) -> MonteCarlo:
    """Fly cases as settings say, in blocks.

    Args:
        agent: who flies.
        task: what is flown.
        config: which cases.
        partial: folder for finished blocks; those that are there already are not flown again.  Several processes
            (see ``runtime.join``) need one that all of them see: each flies its share of the blocks.
        block: cases per block, a multiple of 500; by default what takes seconds to minutes.
        progress: show a progress bar on stderr where there is more than one block.

    Raises:
        SettingsError: the folder holds something else, or blocks of another flight.

    """
    block = block or (BLOCK_ON_GPU if devices.on_gpu() else BLOCK)
    check_feasible(task, config.max_angle_deg)
    cautions.warn_of_task(agent, task, config)
    count = jax.process_count()
    if count > 1 and partial is None:
        raise SettingsError(f"partial: {count} processes need a folder that all of them see, got none")
    identity = {} if partial is None else _identity(agent, task, config)
    processes.assert_equal_across_processes("what is flown", (identity, config.first, config.cases, block))
    parts = _parts(config, block)
    mine = parts[jax.process_index() :: count]
    with ExitStack() as stack:
        if partial is not None:
            processes.all_or_none(lambda: _open(partial, stack))
        shown = progress and len(parts) > 1 and processes.is_primary_process()
        total = sum(part.cases for part in mine)
        bar = stack.enter_context(tqdm(total=total, unit="case", file=sys.stderr, disable=not shown))
        start = time.perf_counter()
        flown = processes.all_or_none(lambda: list(_counted(_fly(agent, task, mine, partial, identity), bar)))
        compile_s = sum(done.compile_s for done in flown)
        wall_s = sum(done.wall_s for done in flown)
        if count > 1:
            wall_s = time.perf_counter() - start - compile_s  # of the slowest
            flown = list(_fly(agent, task, parts, partial, identity))  # all are there to be read
    results = jax.tree.map(lambda *leaves: np.concatenate(leaves), *(done.results for done in flown))
    return MonteCarlo(agent.name, task, config, results, compile_s, wall_s)


def _open(partial: Path, stack: ExitStack) -> None:
    """Take the folder of blocks: the first process does for all."""
    if processes.is_primary_process():
        _check_folder(partial)
        stack.enter_context(FolderLock(partial, "partial"))


def _parts(config: MonteCarloConfig, block: int) -> list[MonteCarloConfig]:
    """The flight's blocks."""
    starts = range(config.first, config.first + config.cases, block)
    end = config.first + config.cases
    return [config.model_copy(update={"first": first, "cases": min(block, end - first)}) for first in starts]


def _fly(
    agent: TaskController,
    task: TaskConfig,
    parts: list[MonteCarloConfig],
    partial: Path | None,
    identity: dict[str, Any],
) -> Iterator[Flown]:
    compiled = False
    for part in parts:
        folder = None if partial is None else partial / f"block-{part.first:010d}"
        found = None if folder is None else _read(folder, agent, task, part, identity)
        if found is None:
            found = _fly_block(agent, task, part, compiled=compiled)
            compiled = True
            if folder is not None:
                record = {"cases": part.cases, "flight": identity, "wall_s": found.wall_s}
                archive.save_tree(folder, found.results, record)
        yield found


def _counted(flown: Iterator[Flown], bar: tqdm) -> Iterator[Flown]:
    """The same blocks, their cases counted as they come."""
    for done in flown:
        bar.update(len(done.results.settled))
        yield done


def _fly_block(agent: TaskController, task: TaskConfig, part: MonteCarloConfig, *, compiled: bool) -> Flown:
    """Fly one block; the first one is compiled, and timed apart from that."""
    if not compiled:
        return cases.fly_timed(agent.controller, task, part)
    start = time.perf_counter()
    results = cases.fly_cases(agent.controller, task, part)
    return Flown(results, 0.0, time.perf_counter() - start)


def _read(
    folder: Path, agent: TaskController, task: TaskConfig, part: MonteCarloConfig, identity: dict[str, Any]
) -> Flown | None:
    """Read a finished block; None if there is none, or a damaged one (which is named), or one of fewer cases."""
    if not folder.exists():
        return None
    try:
        record = archive.read_record(folder)
        saved = record.get("flight")
        if record.get("cases") == part.cases and saved == identity:
            shapes = cases.result_shapes(agent.controller, task, part)
            results = jax.tree.map(np.asarray, archive.load_tree(folder, shapes))
            return Flown(results, 0.0, float(record["wall_s"]))
    except StorageError as damage:
        _log.warning("%s; these cases are flown again", damage)
        return None
    other = [name for name in identity if not isinstance(saved, dict) or saved.get(name) != identity[name]]
    if other:
        raise SettingsError(
            f"partial: {folder.parent} holds cases of another flight (another {', '.join(other)}); choose another"
            " folder"
        )
    return None


def _identity(agent: TaskController, task: TaskConfig, config: MonteCarloConfig) -> dict[str, Any]:
    """What results depend on, besides the cases' numbers; as JSON gives it back."""
    arrays = pytrees.to_arrays(agent.controller)
    digest = hashlib.sha256(str(jax.tree.structure(agent.controller)).encode())
    for name, array in arrays.items():
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    flight = {
        "controller": digest.hexdigest(),
        "task": task.model_dump(mode="json"),
        **config.model_dump(mode="json", exclude={"cases", "first"}),
    }
    return json.loads(json.dumps(flight))


def _check_folder(folder: Path) -> None:
    """Make the folder, or refuse one with other things in it."""
    files.make_folder("partial", folder)
    others = sorted(path.name for path in folder.iterdir() if "block-" not in path.name and path.name != LOCK)
    if others:
        raise SettingsError(f"partial: {folder} holds other things ({', '.join(others[:3])}); choose another folder")
