"""The host loop of training: chunks, evaluation, best agents, checkpoints, logs, interrupts."""

import contextlib
import math
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import koz_jax
from koz_jax import curriculum, evaluation, memory, processes, refine, reward, sharding, storage, training, watch
from koz_jax.agent import Agent, PolicyController, Provenance
from koz_jax.config import TrainConfig
from koz_jax.errors import UserError
from koz_jax.evaluation import MonteCarloConfig
from koz_jax.interrupt import StopRequest
from koz_jax.lock import FolderLock
from koz_jax.metrics_log import flatten
from koz_jax.progress import Progress
from koz_jax.rollout import CaseResult
from koz_jax.run_folder import Checkpoint, RunFolder, RunState, load_checkpoint, load_source, record_of
from koz_jax.run_writer import RunWriter
from koz_jax.sac import replay
from koz_jax.sac.learner import LearnerState
from koz_jax.summary import Summary, summarise
from koz_jax.training import TrainState

# Evaluation scenarios during training: the same for every run, and drawn from a seed that people do not type.
_EVAL_SEED = 2_718_281_828


def train(
    config: TrainConfig,
    run: Path | str,
    *,
    resume: bool = False,
    start_from: Path | str | None = None,
    progress: bool = True,
    devices: int = 1,
) -> Agent | None:
    """Train an agent.

    Args:
        config: the run's settings (with ``resume``: those that the run began with).
        run: folder of the run; new or empty unless ``resume``.
        resume: go on exactly where the run stopped.
        start_from: a snapshot (or the checkpoint of another run) whose learner and replay buffer to begin with.
        progress: show a progress bar on stderr.
        devices: divide the environments and the replay buffer among so many devices of this process.  Several
            processes (see ``runtime.join``) divide them among the devices of all; all get the same arguments and need
            a folder that all of them see, and the first one writes.

    Returns:
        The best agent of the last phase, or None if the run was interrupted (its checkpoint is then up to date).

    Raises:
        UserError: the settings ask for the impossible, or a folder is not what it should be; nothing was written.

    """
    if resume and start_from is not None:
        raise UserError(f"start_from: a resumed run goes on from its own checkpoint, got {start_from}")
    folder = RunFolder(Path(run))
    # All of several processes come here, so that they can say it together.
    processes.together(lambda: sharding.check(config, devices))
    processes.require_same("settings", (config, resume, start_from and str(start_from), devices, koz_jax.__version__))
    opening = _resumed(folder, config) if resume else _begun(folder, config, start_from)
    with StopRequest() as stop, opening as saved:
        processes.require_same("checkpoint", (saved.state.done, saved.log))
        with Progress(config, saved.state.done, enabled=progress and processes.leads()) as bar:
            bar.note(f"run folder: {folder.path}")
            with _memory_errors():
                return _Run(config, folder, bar, stop, devices).go(saved)


@contextlib.contextmanager
def _resumed(folder: RunFolder, config: TrainConfig) -> Iterator[Checkpoint]:
    """A run to go on with, locked."""
    with contextlib.ExitStack() as stack:

        def read() -> Checkpoint:
            if not folder.config.is_file():
                raise UserError(f"resume: {folder.path} is not a run folder (it has no {folder.config.name})")
            if processes.leads():
                stack.enter_context(FolderLock(folder.path))
            template = _template(config)
            memory.check(config, template.train.buffer, template)
            return load_checkpoint(folder, config, template)

        yield processes.together(read)


@contextlib.contextmanager
def _begun(folder: RunFolder, config: TrainConfig, start_from: Path | str | None) -> Iterator[Checkpoint]:
    """A new run, locked, with its first checkpoint; on an error before that nothing is left of it."""
    with contextlib.ExitStack() as stack:

        def prepare() -> RunState:
            if processes.leads():
                stack.enter_context(folder.begin())
            source = checked_source(config, start_from)
            with _memory_errors():
                return _begin(config, source)

        def write() -> None:
            if processes.leads():
                storage.save_tree(folder.checkpoint(0), state, record_of(state, config))
                folder.write_config(config)

        state = processes.together(prepare)
        processes.together(write)
        yield Checkpoint(state, "")


def checked_source(config: TrainConfig, start_from: Path | str | None) -> RunState | None:
    """Refuse a run that cannot be.  Returns what it begins with, where that is another run's.

    Raises:
        UserError: there is no room for a zone, too little memory, or nothing to begin with where it should be.

    """
    evaluation.check_feasible(config.task, config.eval_max_angle_deg, "eval_max_angle_deg")
    template = _template(config)
    memory.check(config, template.train.buffer, template)
    return None if start_from is None else load_source(Path(start_from), config, template)


@contextlib.contextmanager
def _memory_errors() -> Iterator[None]:
    """Say it in one line when a device runs out of memory."""
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error) and "Out of memory" not in str(error):
            raise
        raise UserError(
            "out of memory: make num_envs, sac.buffer_size, sac.batch_size, network.hidden_sizes, eval_cases or"
            f" refine.scenarios smaller; {str(error).splitlines()[0]}"
        ) from None


def _template(config: TrainConfig) -> RunState:
    """Shapes and types of a run's state, without computing it."""
    return jax.eval_shape(lambda: _fresh(config, training.init(config, jax.random.key(config.seed))))


def _fresh(config: TrainConfig, state: TrainState) -> RunState:
    """A phase about to begin."""
    return RunState(
        train=state,
        best=jax.tree.map(jnp.copy, state.learner),
        best_score=jnp.float32(-jnp.inf),
        best_at=jnp.zeros((), jnp.int32),
        refine=refine.init(config, jax.tree.map(jnp.copy, state.learner.averaged_policy)),
    )


def _begin(config: TrainConfig, source: RunState | None) -> RunState:
    """Make a fresh state, or one that takes learner and replay buffer from another run."""
    state = training.init(config, jax.random.key(config.seed))
    if source is not None:
        state = state.replace(learner=source.train.learner, buffer=replay.seal(source.train.buffer))
    return _fresh(config, state)


def score(results: CaseResult, config: TrainConfig, phase: int) -> float:
    """Compute what the best agent is chosen by: mean reward of the phase's end, cases that failed counting zero.

    In phase 1, which knows no zone, a case fails by not settling; in phase 2 also by violating the zone.
    """
    last = config.curriculum.phase1.updates if phase == 1 else config.curriculum.updates
    weights = curriculum.reward_weights(curriculum.difficulty(config.curriculum, jnp.int32(last - 1)))
    rewards = np.asarray(reward.total(results.reward_terms, weights))
    passed = np.asarray(results.settled if phase == 1 else results.success)
    return float(np.mean(np.where(passed, rewards, 0.0)))


class _Run:
    """One run under way; everything that survives it is in ``RunState`` and on disk."""

    def __init__(self, config: TrainConfig, folder: RunFolder, bar: Progress, stop: StopRequest, devices: int) -> None:
        self.config = config
        self.devices = devices
        self.folder = folder
        self.bar = bar
        self.stop = stop
        self.warned = False  # that the critic diverges
        phase1, learned = config.curriculum.phase1.updates, config.curriculum.updates
        self.evaluations = sorted(
            {
                *range(config.eval_every, learned, config.eval_every),
                *range(learned + config.refine_eval_every, config.length, config.refine_eval_every),
                *(end for end in (phase1, learned, config.length) if end > 0),
            }
        )
        self.commit = _commit()

    def go(self, saved: Checkpoint) -> Agent | None:
        """Train to the end, or until asked to stop."""
        state = saved.state
        if state.done < self.config.length:
            with RunWriter(self.folder, self.config, saved) as out:
                state = self._train(state, out)
        if state.done < self.config.length:
            return None
        return self._agent(state, 2 if self.config.curriculum.phase2.updates else 1)

    def _train(self, state: RunState, out: RunWriter) -> RunState:
        """Go on chunk by chunk; log, evaluate and checkpoint on the way."""
        self.bar.compiling()
        # The first row of a log names its columns.
        blank = dict.fromkeys(("refine/cost", *_EVAL_NAMES), math.nan)
        saved_at = state.done
        while state.done < self.config.length and not processes.any_of(self.stop.requested):
            learning = state.done < self.config.curriculum.updates
            before, start = state.done, time.perf_counter()
            state, measured = self._learn(state) if learning else self._refine(state)
            speed = {"updates_per_second": (state.done - before) / (time.perf_counter() - start)}
            values = measured | blank | measured  # what is measured stands first, and is not blanked
            blank = {}
            self.bar.advance(state.done)
            if state.done in self.evaluations:
                state, evaluated = self._evaluate(state, out)
                out.row(state.done, values | evaluated, speed)
                out.checkpoint(sharding.gather(state))
                saved_at = state.done
            else:
                out.row(state.done, values, speed)
            processes.raise_together(out.error)
        if saved_at < state.done:
            out.checkpoint(sharding.gather(state))
        return state

    def _chunk_end(self, done: int, log_every: int) -> int:
        """Where the next chunk ends: at the next line of the log or the next evaluation."""
        next_log = (done // log_every + 1) * log_every
        return min([next_log, *(point for point in self.evaluations if point > done)])

    def _learn(self, state: RunState) -> tuple[RunState, dict[str, float]]:
        """One chunk of Soft Actor-Critic."""
        done = state.done
        end = self._chunk_end(done, self.config.log_every)
        steps = (end - done) // self.config.updates_per_step
        placed = sharding.place(state.train, self.devices)
        with processes.exchange():
            train_state, metrics = processes.finished(training.train_chunk(self.config, placed, np.int32(steps)))
        metrics = jax.device_get(metrics)
        parts = {"learner": train_state.learner, "environments": train_state.env_states}
        processes.together(lambda: watch.check(end, int(metrics.fault), parts))
        warning = watch.divergence(self.config, metrics.learner)
        if warning is not None and not self.warned:
            self.bar.warn(f"update {end}: {warning}")
            self.warned = True
        at = curriculum.difficulty(self.config.curriculum, jnp.int32(end))
        values = {
            "env_steps": (self.config.prefill_steps + end // self.config.updates_per_step) * self.config.num_envs,
            **flatten("train", metrics.learner),
            **flatten("reward", metrics.reward),
            **flatten("curriculum", jax.device_get(at)),
        }
        return state.replace(train=train_state), values

    def _refine(self, state: RunState) -> tuple[RunState, dict[str, float]]:
        """One chunk of refinement."""
        done = state.done
        end = self._chunk_end(done, self.config.refine_log_every)
        refined, cost = refine.refine_chunk(self.config, state.refine, jnp.int32(end - done))
        parts = {"refine/cost": cost, "refine/state": refined}
        processes.together(lambda: watch.check(end, watch.SOUND, parts))
        return state.replace(refine=refined), {"refine/cost": float(cost)}

    def _evaluate(self, state: RunState, out: RunWriter) -> tuple[RunState, dict[str, float]]:
        """Judge the policy, keep the best, and at the end of a stage hand it on."""
        done, curriculum_config = state.done, self.config.curriculum
        phase = 1 if done <= curriculum_config.phase1.updates else 2
        learned = done <= curriculum_config.updates
        learner = (
            sharding.whole(state.train.learner, self.devices)
            if learned
            else state.best.replace(averaged_policy=state.refine.policy)
        )
        judged = self._judge(learner, phase) if processes.leads() else {"eval/score": math.nan}
        found = float(processes.from_first(np.float32(judged["eval/score"])))
        watch.check(done, watch.SOUND, {"eval/score": jnp.float32(found)})
        if found > float(state.best_score):
            best = jax.tree.map(jnp.copy, learner)
            state = state.replace(best=best, best_score=jnp.float32(found), best_at=jnp.int32(done))
            out.agent(self.folder.agent(phase), self._agent(state, phase))
        if done == curriculum_config.phase1.updates:
            out.snapshot("phase1", sharding.gather(state))
            if curriculum_config.phase2.updates:
                learner = jax.tree.map(jnp.copy, state.best)
                state = _fresh(self.config, state.train.replace(learner=learner))
        elif done == curriculum_config.updates and self.config.refine.iterations:
            out.agent(self.folder.sac_agent, self._agent(state, phase))
            policy = jax.tree.map(jnp.copy, state.best.averaged_policy)
            state = state.replace(refine=refine.init(self.config, policy))
        return state, judged

    def _judge(self, learner: LearnerState, phase: int) -> dict[str, float]:
        """Fly the policy; score and summary by the names of their columns."""
        cases = MonteCarloConfig(
            self.config.eval_cases,
            _EVAL_SEED,
            self.config.eval_min_angle_deg,
            self.config.eval_max_angle_deg,
            shield=self.config.shielding.in_force,
        )
        controller = PolicyController(learner.averaged_policy, self.config.network)
        results = evaluation.fly_cases(controller, self.config.task, cases)
        summary = summarise(results)
        self.bar.evaluated(summary)
        values = {f"eval/{name}": value for name, value in vars(summary).items()}
        return {"eval/score": score(results, self.config, phase), **values}

    def _agent(self, state: RunState, phase: int) -> Agent:
        """The best agent of the phase so far."""
        best_at, learned = int(state.best_at), self.config.curriculum.updates
        provenance = Provenance(
            command=shlex.join(["python", *sys.argv]),
            commit=self.commit,
            version=koz_jax.__version__,
            config_sha256=self.config.sha256,
            seed=self.config.seed,
            phase=phase,
            updates=min(best_at, learned),
            refinements=max(best_at - learned, 0),
        )
        controller = PolicyController(state.best.averaged_policy, self.config.network)
        return Agent(controller, self.config.task, provenance, str(self.folder.path))


_EVAL_NAMES = ("eval/score", *(f"eval/{name}" for name in Summary.__dataclass_fields__))


def _commit() -> str:
    """Commit of the checkout that this code runs from, marked when it has changes; empty outside a checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:  # there is no git
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
