"""Layout of a run folder, and the checkpoint of a whole training state.

- ``config.json``: resolved configuration
- ``metrics.csv``: training curves; ``tensorboard/`` has the same
- ``checkpoint/``: newest whole training state, replay buffer included
- ``agents/phase1``, ``agents/phase2``: best agent of each phase; ``agents/phase2-sac``: the latter before refinement
- ``snapshots/phase1``: whole training state at the end of the phase, to start other runs from
- ``evaluation.json``: Monte Carlo table of the finished run
"""

import dataclasses
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
from flax import struct, traverse_util
from pydantic import ValidationError

from koz_jax import storage
from koz_jax.config import TrainConfig
from koz_jax.errors import UserError, explain
from koz_jax.refine import RefineState
from koz_jax.sac.learner import LearnerState
from koz_jax.training import TrainState


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

    @property
    def checkpoint(self) -> Path:
        """Newest whole training state."""
        return self.path / "checkpoint"

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

    def create(self, config: TrainConfig) -> None:
        """Make the folder of a new run.

        Raises:
            UserError: there is something already (nothing is ever overwritten), or the folder cannot be made.

        """
        try:
            if self.path.exists() and (not self.path.is_dir() or any(self.path.iterdir())):
                raise UserError(
                    f"run: {self.path} exists already; resume it with --resume {self.path}, or choose another folder"
                )
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"run: {self.path} cannot be created: {error.strerror}") from None
        storage.write_text(self.config, config.model_dump_json(indent=2) + "\n")

    def read_config(self) -> TrainConfig:
        """Read the configuration of an existing run."""
        if not os.path.isfile(self.config):
            raise UserError(f"resume: {self.path} is not a run folder (it has no {self.config.name})")
        try:
            return TrainConfig.model_validate(storage.read_json(self.config))
        except ValidationError as error:
            raise UserError(f"{self.config}: {explain(error)}") from None


def save_state(folder: Path, state: RunState, config: TrainConfig) -> None:
    """Write a whole training state, replacing an older one in one rename."""
    record = {"done": state.done, "config": config.model_dump()}
    storage.save_tree(folder, state, record)


def load_checkpoint(folder: RunFolder, config: TrainConfig, template: RunState) -> RunState:
    """Read the newest training state of a run.

    Raises:
        UserError: there is none, or it was made with other settings than ``config``.

    """
    if not storage.is_saved(folder.checkpoint):
        raise UserError(
            f"resume: {folder.path} has no checkpoint to go on from; begin again with --run and a new folder"
        )
    for name, saved, given in _changes(folder.checkpoint, config):
        raise UserError(
            f"resume: {name} is {given}, but {folder.path} was begun with {saved}; a run keeps its settings (undo the"
            f" change in {folder.config.name}, or begin another run)"
        )
    return storage.load_tree(folder.checkpoint, template)


def load_source(folder: Path, config: TrainConfig, template: RunState) -> RunState:
    """Read a snapshot, or the checkpoint of a run, for another run with ``config`` to begin from.

    Raises:
        UserError: it is neither, or its networks or its replay buffer do not fit.

    """
    source = next((path for path in (folder / "checkpoint", folder) if storage.is_saved(path)), None)
    if source is None:
        raise UserError(f"start_from: {folder} is neither a run with a checkpoint nor a snapshot")
    for name, saved, given in _changes(source, config):
        if name.startswith(_SIZES):
            raise UserError(
                f"start_from: {name} must be {saved}, as in {folder}, so that its networks and its replay buffer fit;"
                f" got {given}"
            )
    state = storage.load_tree(source, template)
    if state.train.buffer.size < config.sac.n_step:
        raise UserError(
            f"sac.n_step: must be at most the {state.train.buffer.size} steps in the replay buffer of {folder}, got"
            f" {config.sac.n_step}"
        )
    return state


# Settings (by the beginning of their name) that decide the shapes of a learner and a replay buffer.
_SIZES = ("network.", "num_envs", "sac.buffer_size")


def _changes(folder: Path, config: TrainConfig) -> Iterator[tuple[str, Any, Any]]:
    """Settings in which ``config`` differs from those a state was saved with: name, saved value, given value."""
    record = storage.read_record(folder)
    if "config" not in record:
        raise UserError(f"{folder}: holds an agent alone, not a training state")
    try:
        saved = TrainConfig.model_validate(record["config"])
    except ValidationError as error:
        raise UserError(f"{folder / 'record.json'}: {explain(error)}") from None
    before, after = (traverse_util.flatten_dict(settings.model_dump(), sep=".") for settings in (saved, config))
    return ((name, before[name], after[name]) for name in before if before[name] != after[name])
