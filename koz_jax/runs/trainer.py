"""The host loop of training: chunks, evaluation, best agents, checkpoints, logs, interrupts."""

import contextlib
import math
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from koz_jax.agents.agent import Agent
from koz_jax.config import plausibility
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import check_feasible
from koz_jax.config.training import TrainConfig
from koz_jax.config.version import version
from koz_jax.control.policy import PolicyController
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases
from koz_jax.evaluation.summary import Summary, summarise
from koz_jax.learning.finite_checks import NO_FAULT
from koz_jax.runs import checkpoint, divergence, memory, metrics_log, provenance, sharding, stages
from koz_jax.runs.checkpoint import Checkpoint, RunState
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.interrupt import GracefulShutdown
from koz_jax.runs.progress import Progress
from koz_jax.runs.stages import Stage
from koz_jax.runs.writer import RunWriter
from koz_jax.sac.actor_critic import LearnerState
from koz_jax.storage import ahead, processes
from koz_jax.storage.lock import FolderLock

# Evaluation scenarios during training: the same for every run, and drawn from a seed that people do not type.
_EVAL_SEED = 2_718_281_828

_EVALUATION = "evaluation"

_EVAL_NAMES = ("eval/score", *(f"eval/{name}" for name in Summary.__dataclass_fields__))


def train(
    config: TrainConfig,
    run: Path | str,
    *,
    resume: bool = False,
    start_from: Path | str | None = None,
    progress: bool = True,
    devices: int = 1,
    command: str = "",
) -> Agent | None:
    """Train an agent.

    Args:
        config: the run's settings (with ``resume``: those that the run began with).
        run: folder of the run; new or empty unless ``resume``.
        resume: go on exactly where the run stopped.
        start_from: a snapshot (or the checkpoint of another run) whose learner and replay buffer to begin with; where
            the settings have no updates, the name or folder of an agent to refine.
        progress: show a progress bar on stderr.
        devices: divide the environments and the replay buffer among so many devices of this process.  Several
            processes (see ``runtime.join``) divide them among the devices of all; all get the same arguments and need
            a folder that all of them see, and the first one writes.
        command: the command line, where there is one; the folder and the records of the agents keep it.

    Returns:
        The best agent of the last phase, or None if the run was interrupted (its checkpoint is then up to date).

    Raises:
        SettingsError: the settings ask for the impossible, or a folder is not what it should be; nothing was written.
        StorageError: a file cannot be written, or all checkpoints are damaged.
        DivergenceError: training came to numbers that are not finite.

    """
    if resume and start_from is not None:
        raise SettingsError(f"start_from: a resumed run goes on from its own checkpoint, got {start_from}")
    folder = RunFolder(Path(run))
    # All of several processes come here, so that they can say it together.
    processes.all_or_none(lambda: sharding.check(config, devices))
    alike = (config, resume, start_from and str(start_from), devices, version())
    processes.assert_equal_across_processes("settings", alike)
    opening = _resumed(folder, config) if resume else _begun(folder, config, start_from, command)
    with ahead.compiling(_programs(config)) as await_program, GracefulShutdown() as shutdown, opening as saved:
        processes.assert_equal_across_processes("checkpoint", (saved.state.done, saved.log))
        shown = progress and processes.is_primary_process()
        with Progress(stages.plan(config), saved.state.done, enabled=shown) as bar:
            bar.note(f"run folder: {folder.path}")
            with memory.exhaustion_in_one_line():
                return _Run(config, folder, bar, shutdown, devices, command).go(saved, await_program)


def _programs(config: TrainConfig) -> dict[str, ahead.Compile]:
    """What a run needs after its first program."""

    def evaluation() -> None:
        policy = checkpoint.template(config).train.learner.averaged_policy
        cases.compile_flight(PolicyController(policy, config.network), config.task, _drawn(config))

    def of(stage: Stage) -> ahead.Compile:
        return lambda: stage.compile(checkpoint.template(config))

    # Stages of one kind share a program.
    return {**{type(stage).__name__: of(stage) for stage in stages.plan(config)}, _EVALUATION: evaluation}


def _drawn(config: TrainConfig) -> MonteCarloConfig:
    """The cases that policies are compared by."""
    return MonteCarloConfig(
        cases=config.eval_cases,
        seed=_EVAL_SEED,
        min_angle_deg=config.eval_min_angle_deg,
        max_angle_deg=config.eval_max_angle_deg,
        shield=config.shielding.in_force,
    )


@contextlib.contextmanager
def _resumed(folder: RunFolder, config: TrainConfig) -> Iterator[Checkpoint]:
    """A run to go on with, locked."""
    with contextlib.ExitStack() as stack:

        def read() -> Checkpoint:
            if not folder.config.is_file():
                raise SettingsError(f"resume: {folder.path} is not a run folder (it has no {folder.config.name})")
            if processes.is_primary_process():
                stack.enter_context(FolderLock(folder.path))
            _check_memory(config)
            return checkpoint.load(folder, config)

        yield processes.all_or_none(read)


@contextlib.contextmanager
def _begun(folder: RunFolder, config: TrainConfig, start_from: Path | str | None, command: str) -> Iterator[Checkpoint]:
    """A new run, locked, with its first checkpoint; on an error before that nothing is left of it."""
    with contextlib.ExitStack() as stack:

        def prepare() -> RunState:
            if processes.is_primary_process():
                stack.enter_context(folder.begin())
            source = checked_source(config, start_from)
            with memory.exhaustion_in_one_line():
                return checkpoint.begin(config, source)

        def write() -> None:
            if processes.is_primary_process():
                checkpoint.save(folder.checkpoint(0), state, config)
                folder.write_config(config)
                folder.write_command(command)

        state = processes.all_or_none(prepare)
        processes.all_or_none(write)
        yield Checkpoint(state, "")


def checked_source(config: TrainConfig, start_from: Path | str | None) -> RunState | PolicyController | None:
    """Refuse a run that cannot be.  Returns what it begins with, where that is another run's.

    Raises:
        SettingsError: there is no room for a zone, nothing that can be learned, too little memory, or nothing to begin
            with where it should be.
        StorageError: what it should begin with is damaged.

    """
    check_feasible(config.task, config.eval_max_angle_deg, "eval_max_angle_deg")
    plausibility.check_training(config)
    _check_memory(config)
    if config.refines_alone:
        if start_from is None:
            raise SettingsError("start_from: must name an agent where curriculum has no updates, got none")
        return checkpoint.load_agent_source(start_from, config)
    return None if start_from is None else checkpoint.load_source(Path(start_from), config)


def _check_memory(config: TrainConfig) -> None:
    shapes = checkpoint.template(config)
    memory.check(config, shapes.train.buffer, shapes)


class _Run:
    """One run under way; everything that survives it is in ``RunState`` and on disk."""

    def __init__(
        self,
        config: TrainConfig,
        folder: RunFolder,
        bar: Progress,
        shutdown: GracefulShutdown,
        devices: int,
        command: str,
    ) -> None:
        self.config = config
        self.folder = folder
        self.bar = bar
        self.shutdown = shutdown
        self.devices = devices
        self.stages = stages.plan(config)
        self.provenance = provenance.collect(config, command)
        self.warned = False  # that the critic diverges
        self.reached = False  # what the run goes on until

    def go(self, saved: Checkpoint, await_program: ahead.Await) -> Agent | None:
        """Train to the end, or until asked to stop."""
        state = saved.state
        self.reached = self.stages[-1].ends_early(state.done, int(state.best_at), metrics_log.last_row(saved.log))
        if self._stage_at(state.done):
            with RunWriter(self.folder, self.config, saved) as out:
                state = self._train(state, out, await_program)
        return None if self._stage_at(state.done) else self._best_agent(state, self.stages[-1])

    def _stage_at(self, done: int) -> Stage | None:
        return None if self.reached else stages.after(self.stages, done)

    def _train(self, state: RunState, out: RunWriter, await_program: ahead.Await) -> RunState:
        """Go on chunk by chunk; log, evaluate and checkpoint on the way."""
        self.bar.compiling()
        # The first row of a log names its columns.
        blank = dict.fromkeys(("refine/cost", *_EVAL_NAMES), math.nan)
        done = saved_at = state.done
        begun_at = stages.after(self.stages, done)
        if begun_at is not None and begun_at.improves_on_the_one_before and not np.isfinite(state.best_score):
            state, _ = self._evaluate(state, begun_at, out)  # what is refined must be improved on
        while (stage := self._stage_at(done)) and not processes.any_process(self.shutdown.requested):
            await_program(type(stage).__name__)
            start = time.perf_counter()
            chunk = stage.advance(state, self.devices)
            state, before, done = chunk.state, done, chunk.state.done
            speed = {"updates_per_second": (done - before) / (time.perf_counter() - start)}
            values = chunk.values | blank | chunk.values  # what is measured stands first, and is not blanked
            blank = {}
            self._warn_once(done, chunk.warning)
            self.bar.advance(done)
            if stage.is_evaluated_at(done):
                await_program(_EVALUATION)
                state, evaluated = self._evaluate(state, stage, out)
                out.row(done, values | evaluated, speed)
                out.checkpoint(sharding.gather(state))
                saved_at = done
            else:
                out.row(done, values, speed)
            processes.raise_in_all(out.error)
        if saved_at < done:
            out.checkpoint(sharding.gather(state))
        return state

    def _warn_once(self, done: int, warning: str | None) -> None:
        if warning is not None and not self.warned:
            self.bar.warn(f"update {done}: {warning}")
            self.warned = True

    def _evaluate(self, state: RunState, stage: Stage, out: RunWriter) -> tuple[RunState, dict[str, float]]:
        """Evaluate the policy, keep the best, and at the end of a stage hand it on."""
        done, learner = state.done, stage.learner(state, self.devices)
        evaluated = self._fly(learner, stage) if processes.is_primary_process() else {"eval/score": math.nan}
        score = float(processes.broadcast_from_primary(np.float32(evaluated["eval/score"])))
        divergence.check_finite(done, NO_FAULT, {"eval/score": jnp.float32(score)})
        if stage.is_better(score, float(state.best_score)):
            best = jax.tree.map(jnp.copy, learner)
            state = state.replace(best=best, best_score=jnp.float32(score), best_at=jnp.int32(done))
            out.agent(stage.agent, self._best_agent(state, stage))
        if stage is self.stages[-1]:
            self.reached = processes.any_process(stage.ends_early(done, int(state.best_at), evaluated))
        return (self._hand_on(state, stage, out) if self.reached or done == stage.end else state), evaluated

    def _hand_on(self, state: RunState, stage: Stage, out: RunWriter) -> RunState:
        """End a stage: keep what others may start from, and begin the next one."""
        if stage.snapshot is not None:
            out.snapshot(stage.snapshot, sharding.gather(state))
        if stage.agent_at_end is not None:
            out.agent(stage.agent_at_end, self._best_agent(state, stage))
        if stage.improves_on_the_one_before:
            out.agent(stage.agent, self._best_agent(state, stage))  # which now tells how much was tried
        if self.reached:
            self.bar.note(f"{stage.title}: reached {', '.join(map(str, self.config.until))}")
        if stage.is_in_vain(int(state.best_at)):
            self.bar.note(f"{stage.title}: gave no better agent; kept the one of update {int(state.best_at)}")
        following = stages.after(self.stages, stage.end)
        return state if following is None else following.begin_from(state)

    def _fly(self, learner: LearnerState, stage: Stage) -> dict[str, float]:
        """Fly the policy; score and summary by the names of their columns."""
        controller = PolicyController(learner.averaged_policy, self.config.network)
        results = cases.fly_cases(controller, self.config.task, _drawn(self.config))
        summary = summarise(results)
        self.bar.evaluated(summary)
        values = {f"eval/{name}": value for name, value in vars(summary).items()}
        return {"eval/score": stage.score(results), **values}

    def _best_agent(self, state: RunState, stage: Stage) -> Agent:
        """The best agent so far."""
        updates, refinements = stages.split(self.stages, int(state.best_at))
        taken = {
            "phase": stage.phase,
            "updates": updates,
            "refinements": refinements,
            "refinements_tried": int(state.refine.iterations),
        }
        controller = PolicyController(state.best.averaged_policy, self.config.network)
        return Agent(controller, self.config.task, self.provenance.model_copy(update=taken), str(self.folder.path))
