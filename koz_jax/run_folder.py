"""Layout of a run folder, and the checkpoints of a whole training state.

- ``config.json``: resolved configuration; written last when a run begins, so what has one has a checkpoint too
- ``metrics.csv``: training curves; ``tensorboard/`` has the same, and ``timing.csv`` what depends on the machine
- ``checkpoints/``: the two newest whole training states, replay buffer included, named by the updates done; a third is
  there while it is being written
- ``lock``: held by the process that trains
- ``agents/phase1``, ``agents/phase2``: best agent of each phase; ``agents/phase2-sac``: the latter before refinement
- ``snapshots/phase1``: whole training state at the end of the phase, to start other runs from
- ``evaluation.json``: Monte Carlo table of the finished run
"""

import contextlib
import dataclasses
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
from flax import struct, traverse_util
from pydantic import ValidationError

from koz_jax import storage
from koz_jax.config import TrainConfig
from koz_jax.errors import UserError, explain, warn
from koz_jax.lock import LOCK, FolderLock
from koz_jax.refine import RefineState
from koz_jax.sac.learner import LearnerState
from koz_jax.training import TrainState

KEPT = 2  # checkpoints


class RunState(struct.PyTreeNode):
    """What a checkpoint holds."""

    train: TrainState
    best: LearnerState  # best learner of the phase, by evaluation
    best_score: jax.Array  # () float32; -inf before the first evaluation of the phase
    best_at: jax.Array  # () int32, when the best was taken: updates, then refinement iterations
    refine: RefineState

    @property
    def done(self) -> int:
        """How much of the run is done: gradient updates, then refinement iterations."""
        return int(self.train.updates) + int(self.refine.iterations)


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Paths of one run."""

    path: Path

    @property
    def config(self) -> Path:
        """Resolved configuration."""
        return self.path / "config.json"

    def checkpoint(self, done: int) -> Path:
        """Whole training state after so many updates and refinement iterations."""
        return self.path / "checkpoints" / f"{done:010d}"

    def checkpoints(self) -> list[Path]:
        """All checkpoints, the newest first; also damaged ones."""
        found = (self.path / "checkpoints").glob("[0-9]*")
        return sorted((path for path in found if path.name.isdecimal()), key=lambda path: int(path.name), reverse=True)

    def prune(self, newest: int | None = None) -> None:
        """Remove checkpoints that are older than the last two, and those past ``newest``, which training has left."""
        kept = [path for path in self.checkpoints() if newest is None or int(path.name) <= newest][:KEPT]
        unfinished = (self.path / "checkpoints").glob(".*")  # of writes that were killed
        for path in [*unfinished, *self.checkpoints()]:
            if path not in kept:
                shutil.rmtree(path, ignore_errors=True)

    @property
    def evaluation(self) -> Path:
        """Monte Carlo table of the finished run."""
        return self.path / "evaluation.json"

    def agent(self, phase: int) -> Path:
        """Best agent of a phase."""
        return self.path / "agents" / f"phase{phase}"

    @property
    def sac_agent(self) -> Path:
        """Best agent of phase 2 before refinement."""
        return self.path / "agents" / "phase2-sac"

    def snapshot(self, name: str) -> Path:
        """Whole training state at an intermediate point."""
        return self.path / "snapshots" / name

    @contextlib.contextmanager
    def begin(self) -> Iterator[None]:
        """Make and lock the folder of a new run, which has begun when ``config.json`` is written.

        On an error before that, nothing is left of it.

        Raises:
            UserError: there is something already (nothing is ever overwritten), or the folder cannot be made.

        """
        try:
            if self.path.exists() and not (self.path.is_dir() and self._is_unbegun()):
                raise UserError(
                    f"run: {self.path} exists already; resume it with --resume {self.path}, or choose another folder"
                )
            made = [path for path in (self.path, *self.path.parents) if not path.exists()]
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"run: {self.path} cannot be created: {error.strerror}") from None
        try:
            with FolderLock(self.path):
                yield from self._begin_locked()
        finally:
            for folder in made:
                with contextlib.suppress(OSError):  # it is in use, as it should be
                    folder.rmdir()

    def _begin_locked(self) -> Iterator[None]:
        if not self._is_unbegun():  # another trainer came and went
            raise UserError(f"run: {self.path} exists already; resume it with --resume {self.path}")
        try:
            shutil.rmtree(self.path / "checkpoints", ignore_errors=True)  # of a beginning that was killed
            for half_written in self._half_written():
                half_written.unlink()
            yield
        finally:
            if not self.config.exists():
                shutil.rmtree(self.path / "checkpoints", ignore_errors=True)
                (self.path / LOCK).unlink(missing_ok=True)

    def _is_unbegun(self) -> bool:
        """Whether the folder is empty, or holds only what a killed beginning left."""
        first = self.checkpoint(0)
        left_over = {LOCK, first.parent.name, first.name, f".{first.name}.new"}
        left_over |= {path.name for path in self._half_written()}
        places = [self.path, *([first.parent] if first.parent.is_dir() else [])]
        return all(path.name in left_over for place in places for path in place.iterdir())

    def _half_written(self) -> list[Path]:
        """What a kill left of the configuration that was being written."""
        return list(self.path.glob(f".{self.config.name}.*"))

    def write_config(self, config: TrainConfig) -> None:
        """Write the configuration of a run that has begun."""
        storage.write_text(self.config, config.to_json())

    def read_config(self) -> TrainConfig:
        """Read the configuration of an existing run."""
        if not os.path.isfile(self.config):
            raise UserError(f"resume: {self.path} is not a run folder (it has no {self.config.name})")
        try:
            return TrainConfig.model_validate(storage.read_json(self.config))
        except ValidationError as error:
            raise UserError(f"{self.config}: {explain(error)}") from None


def record_of(state: RunState, config: TrainConfig, log: str = "") -> dict[str, Any]:
    """Make what is saved beside a state.  log: ``metrics.csv`` so far."""
    return {"done": state.done, "config": config.model_dump(), "log": log}


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """What a run goes on from."""

    state: RunState
    log: str  # metrics.csv up to the state


@dataclasses.dataclass(frozen=True)
class _Change:
    """A setting in which a run differs from a saved one."""

    name: str
    saved: Any
    given: Any


def load_checkpoint(folder: RunFolder, config: TrainConfig, template: RunState) -> Checkpoint:
    """Read the newest good training state of a run; newer ones that are damaged are named on stderr and left out.

    Raises:
        UserError: there is none, or it was made with other settings than ``config``.

    """

    def refuse(path: Path, changes: list[_Change]) -> None:
        for change in changes:
            raise UserError(
                f"resume: {change.name} is {change.given}, but {folder.path} was begun with {change.saved}; a run keeps"
                f" its settings (undo the change in {folder.config.name}, or begin another run)"
            )

    found = folder.checkpoints()
    if not found:
        raise UserError(
            f"resume: {folder.path} has no checkpoint to go on from; begin again with --run and a new folder"
        )
    path, state = _newest_good(found, config, template, refuse)
    return Checkpoint(state, str(storage.read_record(path).get("log", "")))


def load_source(folder: Path, config: TrainConfig, template: RunState) -> RunState:
    """Read a snapshot, or the newest good checkpoint of a run, for another run with ``config`` to begin from.

    Raises:
        UserError: it is neither, or its networks or its replay buffer do not fit.

    """

    def refuse(path: Path, changes: list[_Change]) -> None:
        for change in changes:
            if change.name.startswith(_SIZES):
                raise UserError(
                    f"start_from: {change.name} must be {change.saved}, as in {path}, so that its networks and its"
                    f" replay buffer fit; got {change.given}"
                )

    sources = RunFolder(folder).checkpoints() or [folder]
    if not any(map(storage.is_saved, sources)):
        raise UserError(f"start_from: {folder} is neither a run with a checkpoint nor a snapshot")
    _, state = _newest_good(sources, config, template, refuse)
    if state.train.buffer.size < config.sac.n_step:
        raise UserError(
            f"sac.n_step: must be at most the {state.train.buffer.size} steps in the replay buffer of {folder}, got"
            f" {config.sac.n_step}"
        )
    return state


def _newest_good(
    paths: list[Path], config: TrainConfig, template: RunState, refuse: Callable[[Path, list[_Change]], None]
) -> tuple[Path, RunState]:
    """Load the first state that is undamaged, and warn of those before it.

    refuse: raises UserError where a state was saved with settings that do not do.
    """
    problems = []
    for path in paths:
        try:
            changes = _changes(path, config)
        except UserError as damage:
            problems.append(str(damage))
            continue
        refuse(path, changes)
        try:
            state = storage.load_tree(path, template)
        except UserError as damage:
            problems.append(str(damage))
            continue
        for problem in problems:
            warn(f"{problem}; going on from {path} instead")
        return path, state
    raise UserError("\n".join(problems))


# Settings (by the beginning of their name) that decide the shapes of a learner and a replay buffer.
_SIZES = ("network.", "num_envs", "sac.buffer_size")


def _changes(folder: Path, config: TrainConfig) -> list[_Change]:
    """Settings in which ``config`` differs from those a state was saved with."""
    record = storage.read_record(folder)
    if "config" not in record:
        raise UserError(f"{folder}: holds an agent alone, not a training state")
    try:
        saved = TrainConfig.model_validate(record["config"])
    except ValidationError as error:
        raise UserError(f"{folder / 'record.json'}: {explain(error)}") from None
    before, after = (traverse_util.flatten_dict(settings.model_dump(), sep=".") for settings in (saved, config))
    return [_Change(name, before[name], after[name]) for name in before if before[name] != after[name]]
