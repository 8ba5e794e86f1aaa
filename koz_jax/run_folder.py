"""Layout of a run folder, and the checkpoint of a whole training state.

    config.json          resolved configuration
    metrics.csv          training curves; tensorboard/ has the same
    checkpoint/          newest whole training state, replay buffer included
    agents/phase1, ...   best agent of each phase
    snapshots/phase1     whole training state at the end of the phase, to start other runs from
    evaluation.json      Monte Carlo table of the finished run
"""

import dataclasses
from pathlib import Path
from typing import TypeVar

import jax
from flax import struct
from pydantic import ValidationError

from koz_jax import storage
from koz_jax.config import TrainConfig
from koz_jax.errors import UserError, explain
from koz_jax.sac.learner import LearnerState
from koz_jax.training import TrainState

Tree = TypeVar("Tree")


@struct.dataclass
class RunState:
    """What a checkpoint holds."""

    train: TrainState
    best: LearnerState  # best learner of the phase, by evaluation
    best_score: jax.Array  # () float32; -inf before the first evaluation of the phase
    best_updates: jax.Array  # () int32, updates after which the best was taken


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

    def snapshot(self, name: str) -> Path:
        """Whole training state at an intermediate point."""
        return self.path / "snapshots" / name

    def create(self, config: TrainConfig) -> None:
        """Make the folder of a new run.

        Raises:
            UserError: there is something already; nothing is ever overwritten.
        """
        if self.path.exists() and (not self.path.is_dir() or any(self.path.iterdir())):
            raise UserError(f"run: {self.path} exists already; resume it with --resume {self.path}, or choose another")
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"run: {self.path} cannot be created: {error.strerror}") from None
        storage.write_text(self.config, config.model_dump_json(indent=2) + "\n")

    def read_config(self) -> TrainConfig:
        """The configuration of an existing run."""
        if not self.config.is_file():
            raise UserError(f"resume: {self.path} is not a run folder (it has no {self.config.name})")
        try:
            return TrainConfig.model_validate(storage.read_json(self.config))
        except ValidationError as error:
            raise UserError(f"{self.config}: {explain(error)}") from None


def save_state(folder: Path, state: RunState, config: TrainConfig) -> None:
    """Write a whole training state, replacing an older one in one rename."""
    record = {"updates": int(state.train.updates), "config": config.model_dump()}
    storage.save_tree(folder, state, record)


def load_state(folder: Path, template: Tree) -> Tree:
    """Read a training state with the shapes of ``template``."""
    return storage.load_tree(folder, template)
