"""What a checkpoint holds; saving one, and going on from one."""

import dataclasses
import functools
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct, traverse_util
from pydantic import ValidationError

from koz_jax.agents import deeper
from koz_jax.agents.agent import load_agent
from koz_jax.config.training import TrainConfig
from koz_jax.control.policy import PolicyController
from koz_jax.errors import DamagedFileError, SettingsError, StorageError, explain
from koz_jax.learning import refinement, train_step
from koz_jax.learning.refinement import RefineState
from koz_jax.learning.train_step import TrainState
from koz_jax.runs.folder import RunFolder
from koz_jax.sac import replay_buffer
from koz_jax.sac.actor_critic import LearnerState
from koz_jax.storage import archive, pytrees

_log = logging.getLogger(__name__)


class RunState(struct.PyTreeNode):
    """Everything of a run that changes, and that a resume needs."""

    train: TrainState
    best: LearnerState  # best learner of the phase, by evaluation
    best_score: jax.Array  # () float32; -inf before the first evaluation of the phase
    best_at: jax.Array  # () int32, when the best was taken: updates, then refinement iterations
    refine: RefineState

    @property
    def done(self) -> int:
        """How much of the run is done: gradient updates, then refinement iterations."""
        return int(self.train.updates) + int(self.refine.iterations)


def begin(config: TrainConfig, source: RunState | PolicyController | None) -> RunState:
    """Make the state that a run begins with; learner and replay buffer, or the policy alone, as in the source."""
    state = train_step.init(config, jax.random.key(config.seed))
    if isinstance(source, PolicyController):
        policy = source.policy
        learner = state.learner.replace(policy=policy, averaged_policy=jax.tree.map(jnp.copy, policy))
        state = state.replace(learner=learner)
    elif source is not None:
        buffer = replay_buffer.truncate_newest(source.train.buffer)
        state = state.replace(learner=source.train.learner, buffer=buffer)
    return begin_phase(config, state)


def begin_phase(config: TrainConfig, state: TrainState) -> RunState:
    """Make the state of a phase that is about to begin: nothing is the best yet, and nothing refined."""
    return RunState(
        train=state,
        best=jax.tree.map(jnp.copy, state.learner),
        best_score=jnp.float32(-jnp.inf),
        best_at=jnp.zeros((), jnp.int32),
        refine=refinement.init(config, jax.tree.map(jnp.copy, state.learner.averaged_policy)),
    )


def template(config: TrainConfig) -> RunState:
    """Shapes and types of a run's state, without computing it."""
    return jax.eval_shape(lambda: begin_phase(config, train_step.init(config, jax.random.key(config.seed))))


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """What a run goes on from."""

    state: RunState
    log: str  # metrics.csv up to the state


@dataclasses.dataclass(frozen=True)
class HostCopy:
    """A checkpoint that has been copied to the host: training can go on while it is written."""

    arrays: Mapping[str, np.ndarray]
    record: Mapping[str, Any]

    def write(self, folder: Path) -> None:
        """Write the checkpoint as a folder, whole or not at all.

        Raises:
            StorageError: the folder cannot be written.

        """
        archive.save_arrays(folder, self.arrays, self.record)


def copy_to_host(state: RunState, config: TrainConfig, log: str = "") -> HostCopy:
    """Copy a state, and what is saved beside it.  log: ``metrics.csv`` so far."""
    record = {"done": state.done, "config": config.model_dump(), "log": log}
    return HostCopy(pytrees.to_arrays(state), record)


def save(folder: Path, state: RunState, config: TrainConfig) -> None:
    """Write a checkpoint from before the first row of the log.

    Raises:
        StorageError: the folder cannot be written.

    """
    copy_to_host(state, config).write(folder)


@dataclasses.dataclass(frozen=True)
class _Change:
    """A setting in which a run differs from a saved one."""

    name: str
    saved: Any
    given: Any


def load(folder: RunFolder, config: TrainConfig) -> Checkpoint:
    """Read the newest good checkpoint of a run; newer ones that are damaged are warned of and left out.

    Raises:
        SettingsError: there is none, or it was made with other settings than ``config``.
        StorageError: all are damaged.

    """

    def refuse(path: Path, changes: list[_Change]) -> None:
        for change in changes:
            raise SettingsError(
                f"resume: {change.name} is {change.given}, but {folder.path} was begun with {change.saved}; a run keeps"
                f" its settings (undo the change in {folder.config.name}, or begin another run)"
            )

    found = folder.checkpoints()
    if not found:
        raise SettingsError(
            f"resume: {folder.path} has no checkpoint to go on from; begin again with --run and a new folder"
        )
    path, state = _newest_good(found, config, refuse)
    return Checkpoint(state, str(archive.read_record(path).get("log", "")))


def load_agent_source(name: str | Path, config: TrainConfig) -> PolicyController:
    """Load an agent for a run with ``config``, which only refines it; hidden layers that it has not are added.

    Raises:
        SettingsError: there is no such agent, or its network is another.
        StorageError: its files are damaged.

    """
    controller = load_agent(name).controller
    if not deeper.can_become(controller.network, config.network):
        raise SettingsError(
            f"start_from: network must be that of {name}, {controller.network}, or have further hidden layers of the"
            f" last one's size; got {config.network}"
        )
    return deeper.deepened(controller, config.network)


def load_source(folder: Path, config: TrainConfig) -> RunState:
    """Read a snapshot, or the newest good checkpoint of a run, for another run with ``config`` to begin from.

    Raises:
        SettingsError: it is neither, or its networks or its replay buffer do not fit.
        StorageError: it is damaged.

    """

    def refuse(path: Path, changes: list[_Change]) -> None:
        for change in changes:
            if change.name.startswith(_SIZES):
                raise SettingsError(
                    f"start_from: {change.name} must be {change.saved}, as in {path}, so that its networks and its"
                    f" replay buffer fit; got {change.given}"
                )

    sources = RunFolder(folder).checkpoints() or [folder]
    if not any(map(archive.is_saved, sources)):
        raise SettingsError(f"start_from: {folder} is neither a run with a checkpoint nor a snapshot")
    _, state = _newest_good(sources, config, refuse)
    if state.train.buffer.size < config.sac.n_step:
        raise SettingsError(
            f"sac.n_step: must be at most the {state.train.buffer.size} steps in the replay buffer of {folder}, got"
            f" {config.sac.n_step}"
        )
    return state


def _newest_good(
    paths: list[Path], config: TrainConfig, refuse: Callable[[Path, list[_Change]], None]
) -> tuple[Path, RunState]:
    """Load the first state that is undamaged, and warn of those before it.

    refuse: raises SettingsError where a state was saved with settings that do not do.
    """
    problems = []
    for path in paths:
        try:
            saved = _settings_of(path)
        except StorageError as damage:
            problems.append(str(damage))
            continue
        refuse(path, _changes(saved, config))
        try:
            state = archive.load_tree(path, template(config), functools.partial(upgrade, config=saved))
        except StorageError as damage:
            problems.append(str(damage))
            continue
        for problem in problems:
            _log.warning("%s; going on from %s instead", problem, path)
        return path, state
    raise StorageError("\n".join(problems))


# Settings (by the beginning of their name) that decide the shapes of a learner and a replay buffer.
_SIZES = ("learner", "network.", "num_envs", "sac.buffer_size")


def _settings_of(folder: Path) -> TrainConfig:
    """Settings that a state was saved with."""
    record = archive.read_record(folder)
    if "config" not in record:
        raise StorageError(f"{folder}: holds an agent alone, not a training state")
    try:
        return TrainConfig.model_validate(record["config"])
    except ValidationError as error:
        raise DamagedFileError(f"{folder / 'record.json'}: {explain(error)}") from None


def _changes(saved: TrainConfig, given: TrainConfig) -> list[_Change]:
    """Settings in which a run differs from a saved one."""
    before, after = (traverse_util.flatten_dict(settings.model_dump(), sep=".") for settings in (saved, given))
    return [_Change(name, before[name], after[name]) for name in before if before[name] != after[name]]


_OLD_ZONES, _CONSTRAINTS = "train/env_states/scenario/zones/", "train/env_states/scenario/constraints/"


def upgrade(arrays: dict[str, np.ndarray], config: TrainConfig) -> dict[str, np.ndarray]:
    """Make arrays by today's names of those of a checkpoint, which may be of version 0.1.0.

    There, a scenario had zones, and the one boresight was known from the settings.
    """
    if not any(name.startswith(_OLD_ZONES) for name in arrays):
        return arrays
    renamed = {name.replace(_OLD_ZONES, _CONSTRAINTS): array for name, array in arrays.items()}
    axes_N = renamed.get(f"{_CONSTRAINTS}axis_N")
    if axes_N is not None:
        boresight_B = np.array(config.task.spacecraft.boresight, np.float32)
        renamed[f"{_CONSTRAINTS}boresight_B"] = np.broadcast_to(boresight_B, (*axes_N.shape[:-1], 3))
    return renamed
