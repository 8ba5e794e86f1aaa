"""The host loop of training: chunks, evaluation, best agents, checkpoints, logs, interrupts."""

import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import koz_jax
from koz_jax import curriculum, evaluation, reward, training
from koz_jax.agent import Agent, PolicyController, Provenance
from koz_jax.config import TrainConfig
from koz_jax.errors import UserError
from koz_jax.interrupt import StopRequest
from koz_jax.metrics_log import MetricsLog, flatten
from koz_jax.evaluation import MonteCarloConfig
from koz_jax.progress import Progress
from koz_jax.rollout import CaseResult
from koz_jax.run_folder import RunFolder, RunState, load_state, save_state
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
) -> Agent | None:
    """Train an agent.

    Args:
        config: the run's settings (with ``resume``: those that the run began with).
        run: folder of the run; new or empty unless ``resume``.
        resume: go on exactly where the run stopped.
        start_from: a snapshot (or the checkpoint of another run) whose learner and replay buffer to begin with.
        progress: show a progress bar on stderr.

    Returns:
        The best agent of the last phase, or None if the run was interrupted (its checkpoint is then up to date).
    """
    folder = RunFolder(Path(run))
    if not resume:
        evaluation.check_feasible(config.task, config.eval_max_angle_deg)
        source = None if start_from is None else _checked_source(Path(start_from), config)
        folder.create(config)
        state = _begin(config, source)
    else:
        state = load_state(folder.checkpoint, _template(config))
    with Progress(config, int(state.train.updates), enabled=progress) as bar, StopRequest() as stop:
        return _Run(config, folder, bar, stop).go(state)


def _template(config: TrainConfig) -> RunState:
    """Shapes and types of a run's state, without computing it."""
    return jax.eval_shape(lambda: _fresh(training.init(config, jax.random.key(config.seed))))


def _fresh(state: TrainState) -> RunState:
    return RunState(
        train=state,
        best=jax.tree.map(jnp.copy, state.learner),
        best_score=jnp.float32(-jnp.inf),
        best_updates=jnp.zeros((), jnp.int32),
    )


def _checked_source(folder: Path, config: TrainConfig) -> RunState:
    source = folder / "checkpoint" if (folder / "checkpoint").is_dir() else folder
    if not (source / "record.json").is_file():
        raise UserError(f"start_from: {folder} is neither a run nor a snapshot (no record.json)")
    return load_state(source, _template(config))


def _begin(config: TrainConfig, source: RunState | None) -> RunState:
    """A fresh state, or one that takes learner and replay buffer from another run."""
    state = training.init(config, jax.random.key(config.seed))
    if source is not None:
        state = state.replace(learner=source.train.learner, buffer=source.train.buffer)
    return _fresh(state)


class _Evaluation(NamedTuple):
    score: float
    summary: Summary


def score(results: CaseResult, config: TrainConfig, phase: int) -> float:
    """What the best agent is chosen by: mean reward of the phase's end, cases that failed counting zero.

    In phase 1, which knows no zone, a case fails by not settling; in phase 2 also by violating the zone.
    """
    last = config.curriculum.phase1.updates if phase == 1 else config.curriculum.updates
    weights = curriculum.reward_weights(curriculum.difficulty(config.curriculum, jnp.int32(last - 1)))
    rewards = np.asarray(reward.total(results.reward_terms, weights))
    passed = np.asarray(results.settled if phase == 1 else results.success)
    return float(np.mean(np.where(passed, rewards, 0.0)))


class _Run:
    """One run under way; everything that survives it is in ``RunState`` and on disk."""

    def __init__(self, config: TrainConfig, folder: RunFolder, bar: Progress, stop: StopRequest) -> None:
        self.config = config
        self.folder = folder
        self.bar = bar
        self.stop = stop
        phase1, total = config.curriculum.phase1.updates, config.curriculum.updates
        self.phase_ends = {end for end in (phase1, total) if end > 0}
        self.evaluations = sorted({*range(config.eval_every, total, config.eval_every), *self.phase_ends})

    def go(self, state: RunState) -> Agent | None:
        """Train to the end, or until asked to stop."""
        updates = int(state.train.updates)
        log = MetricsLog(self.folder.path, updates)
        self.bar.compiling()
        try:
            while updates < self.config.curriculum.updates and not self.stop.requested:
                state, values = self._chunk(state, updates)
                updates = int(state.train.updates)
                if updates in self.evaluations:
                    state, evaluated = self._evaluate(state, updates)
                    values |= evaluated
                    log.write(updates, values)
                    save_state(self.folder.checkpoint, state, self.config)
                else:
                    log.write(updates, values | {name: None for name in _EVAL_NAMES})
            if updates < self.config.curriculum.updates:
                save_state(self.folder.checkpoint, state, self.config)
                return None
        finally:
            log.close()
        return self._agent(state.best, 2 if self.config.curriculum.phase2.updates else 1, int(state.best_updates))

    def _chunk(self, state: RunState, updates: int) -> tuple[RunState, dict[str, float | None]]:
        """Train until the next line of the log or the next evaluation."""
        next_log = (updates // self.config.log_every + 1) * self.config.log_every
        end = min([next_log, *(point for point in self.evaluations if point > updates)])
        steps = (end - updates) // self.config.updates_per_step
        start = time.perf_counter()
        train_state, metrics = training.train_chunk(self.config, state.train, jnp.int32(steps))
        metrics = jax.device_get(metrics)
        seconds = time.perf_counter() - start
        self.bar.advance(end)
        at = jax.device_get(_difficulty(self.config, end))
        values: dict[str, float | None] = {
            "env_steps": (self.config.prefill_steps + end // self.config.updates_per_step) * self.config.num_envs,
            "updates_per_second": (end - updates) / seconds,
            **flatten("train", metrics.learner),
            **flatten("reward", metrics.reward),
            **flatten("curriculum", at),
        }
        return state.replace(train=train_state), values

    def _evaluate(self, state: RunState, updates: int) -> tuple[RunState, dict[str, float | None]]:
        """Judge the averaged policy, keep the best, and at the end of a phase hand it on."""
        phase = 1 if updates <= self.config.curriculum.phase1.updates else 2
        controller = PolicyController(state.train.learner.averaged_policy, self.config.network)
        cases = MonteCarloConfig(
            self.config.eval_cases, _EVAL_SEED, self.config.eval_min_angle_deg, self.config.eval_max_angle_deg
        )
        results = evaluation.fly_cases(controller, self.config.task, cases)
        found = _Evaluation(score(results, self.config, phase), summarise(results))
        self.bar.evaluated(found.summary)
        if found.score > float(state.best_score):
            state = state.replace(
                best=jax.tree.map(jnp.copy, state.train.learner),
                best_score=jnp.float32(found.score),
                best_updates=jnp.int32(updates),
            )
            self._agent(state.best, phase, updates).save(self.folder.agent(phase))
        if updates == self.config.curriculum.phase1.updates:
            save_state(self.folder.snapshot("phase1"), state, self.config)
            state = _fresh(state.train.replace(learner=jax.tree.map(jnp.copy, state.best)))
        return state, {"eval/score": found.score, **{f"eval/{k}": v for k, v in vars(found.summary).items()}}

    def _agent(self, learner: LearnerState, phase: int, updates: int) -> Agent:
        provenance = Provenance(
            command=shlex.join(["python", *sys.argv]),
            commit=_commit(),
            version=koz_jax.__version__,
            seed=self.config.seed,
            phase=phase,
            updates=updates,
        )
        controller = PolicyController(learner.averaged_policy, self.config.network)
        return Agent(controller, self.config.task, provenance, str(self.folder.path))


_EVAL_NAMES = ("eval/score", *(f"eval/{name}" for name in Summary.__dataclass_fields__))


def _difficulty(config: TrainConfig, updates: int) -> curriculum.Difficulty:
    return curriculum.difficulty(config.curriculum, jnp.int32(updates))


def _commit() -> str:
    """Commit of the checkout that this code runs from, marked when it has changes; empty outside a checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=40"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else ""
