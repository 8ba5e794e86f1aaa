"""The stages of a run: phase 1 (no zone), phase 2 (around the zone), refinement.

A run is a list of stages, made from its settings by ``plan``.  How far it has come is one number, ``done``: gradient
updates, then refinement iterations.  A stage knows where it begins and ends in ``done``, how a piece of it is computed,
by what its best agent is chosen, and what it makes of the state that the stage before has ended with.
"""

import abc
import dataclasses
import math
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from koz_jax.config.training import TrainConfig
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.learning import curriculum, finite_checks, refinement, train_step
from koz_jax.runs import checkpoint, divergence, sharding
from koz_jax.runs.checkpoint import RunState
from koz_jax.runs.metrics_log import flatten
from koz_jax.sac.actor_critic import LearnerState
from koz_jax.storage import processes
from koz_jax.task import reward

# How often a program is told to do what it does.
_COUNT = jax.ShapeDtypeStruct((), jnp.int32)


@dataclasses.dataclass(frozen=True)
class Chunk:
    """What a piece of a stage has come to."""

    state: RunState
    values: dict[str, float]  # for the log, by the names of their columns
    warning: str | None = None


@dataclasses.dataclass(frozen=True)
class Stage(abc.ABC):
    """One stage of a run."""

    config: TrainConfig
    title: str  # for people
    phase: int  # of the curriculum, as the records of agents have it
    start: int  # where it begins
    length: int
    log_every: int
    eval_every: int
    eval_from: int  # where the evaluations are counted from
    agent: str  # name of its best agent; a later stage may replace it
    agent_at_end: str | None = None  # name under which its best agent is kept from that
    snapshot: str | None = None  # name of the whole training state at its end, to start other runs from

    @property
    def end(self) -> int:
        """Where it ends."""
        return self.start + self.length

    def chunk_end(self, done: int) -> int:
        """Where the chunk ends that begins at ``done``: at the next row of the log or the next evaluation."""
        next_log = (done // self.log_every + 1) * self.log_every
        next_evaluation = done + self.eval_every - (done - self.eval_from) % self.eval_every
        return min(next_log, next_evaluation, self.end)

    def is_evaluated_at(self, done: int) -> bool:
        """Whether the policy is evaluated, and a checkpoint made, at ``done``; in any case at the end."""
        return done == self.end or (done - self.eval_from) % self.eval_every == 0

    def evaluations_between(self, begin: int, end: int) -> int:
        """Number of evaluations after ``begin`` up to ``end``, both within the stage."""

        def due(done: int) -> int:
            return (done - self.eval_from) // self.eval_every

        at_the_end = end == self.end > begin and (end - self.eval_from) % self.eval_every != 0
        return due(end) - due(begin) + at_the_end

    def ends_early(self, done: int, best_at: int, evaluated: Mapping[str, float]) -> bool:
        """Whether it, the last one, has just evaluated an agent that is its best and all that the run goes on until.

        best_at: when the best was taken; evaluated: the last row of the log, by the names of its columns.
        """
        goals, is_best = self.config.until, self.start < best_at == done
        names = ("success_rate", "settling_time_mean", "control_effort_mean")
        outcome = [evaluated.get(f"eval/{name}", math.nan) for name in names]
        return bool(goals) and is_best and all(goal.is_met(*outcome) for goal in goals)

    @property
    def improves_on_the_one_before(self) -> bool:
        """Whether it polishes the agent of the stage before, which stays the best until one is better."""
        return False

    def is_in_vain(self, best_at: int) -> bool:
        """Whether the stage gave no better agent.  best_at: when the best was taken."""
        return self.improves_on_the_one_before and best_at <= self.start

    @property
    def is_of_zones(self) -> bool:
        """Whether its agents are to avoid zones."""
        return self.phase == 2

    @property
    @abc.abstractmethod
    def rewarded_as_at(self) -> int:
        """Update whose difficulty gives the weights of the reward in ``score``."""

    def score(self, results: CaseResult) -> float:
        """Compute what the best agent is chosen by: mean reward at the phase's end, cases that failed counting zero.

        A case fails by not settling, and where the stage is of zones also by violating one.
        """
        at = curriculum.difficulty(self.config.curriculum, jnp.int32(self.rewarded_as_at))
        rewards = np.asarray(reward.total(results.reward_terms, curriculum.reward_weights(at)))
        passed = np.asarray(results.success if self.is_of_zones else results.settled)
        return float(np.mean(np.where(passed, rewards, 0.0)))

    def is_better(self, score: float, best: float) -> bool:
        """Tell whether an agent takes the place of the best: of equal ones, as where no case succeeds, the newer.

        Refinement must do better than what it was given, unless its last agent is asked for.
        """
        if self.improves_on_the_one_before:
            return self.config.refine.keep == "last" or score > best
        return score >= best

    @abc.abstractmethod
    def begin_from(self, state: RunState) -> RunState:
        """Make the state that this stage begins with of the one that the stage before has ended with."""

    @abc.abstractmethod
    def advance(self, state: RunState, devices: int) -> Chunk:
        """Compute the next chunk, on so many devices of each process.

        Raises:
            DivergenceError: it came to numbers that are not finite.

        """

    @abc.abstractmethod
    def compile(self, shapes: RunState) -> None:
        """Compile the program of ``advance`` ahead of it, on one device.  shapes: of the state."""

    @abc.abstractmethod
    def learner(self, state: RunState, devices: int) -> LearnerState:
        """Take what is evaluated out of a state, whole on one device."""


class Learning(Stage):
    """A phase of the curriculum, by gradient updates of Soft Actor-Critic or another learner."""

    @property
    def rewarded_as_at(self) -> int:
        """The last update of the phase."""
        return self.end - 1

    def begin_from(self, state: RunState) -> RunState:
        """Go on with the best learner of the phase before; its successors are compared anew."""
        best = jax.tree.map(jnp.copy, state.best)
        return checkpoint.begin_phase(self.config, state.train.replace(learner=best))

    def advance(self, state: RunState, devices: int) -> Chunk:
        """Take environment steps and gradient updates."""
        config, done = self.config, state.done
        end = self.chunk_end(done)
        steps = (end - done) // config.updates_per_step
        placed = sharding.place(state.train, devices)
        with processes.collective_errors():
            trained = train_step.train_chunk(config, placed, np.int32(steps))  # pyright: ignore[reportArgumentType]
            train_state, metrics = processes.wait_for_devices(trained)
        metrics = jax.device_get(metrics)
        parts = {"learner": train_state.learner, "environments": train_state.env_states}
        processes.all_or_none(lambda: divergence.check_finite(end, int(metrics.fault), parts))
        at = curriculum.difficulty(config.curriculum, jnp.int32(end))
        values = {
            "env_steps": (config.prefill_steps + end // config.updates_per_step) * config.num_envs,
            **flatten("train", metrics.learner),
            **flatten("reward", metrics.reward),
            **flatten("curriculum", jax.device_get(at)),
        }
        return Chunk(state.replace(train=train_state), values, divergence.critic_warning(config, metrics.learner))

    def compile(self, shapes: RunState) -> None:
        """The same for both phases."""
        train_step.train_chunk.lower(self.config, shapes.train, _COUNT).compile()

    def learner(self, state: RunState, devices: int) -> LearnerState:
        """The learner as it is now."""
        return sharding.on_one_device(state.train.learner, devices)


class Refinement(Stage):
    """Polishing the best policy of the phase before by first-order gradients."""

    @property
    def improves_on_the_one_before(self) -> bool:
        """It does."""
        return True

    @property
    def rewarded_as_at(self) -> int:
        """The end of the phase before."""
        return max(self.start - 1, 0)

    def begin_from(self, state: RunState) -> RunState:
        """Go on with the best policy so far; the refined ones are compared with it."""
        policy = jax.tree.map(jnp.copy, state.best.averaged_policy)
        return state.replace(refine=refinement.init(self.config, policy))

    def advance(self, state: RunState, devices: int) -> Chunk:
        """Take gradient steps; every process takes the same ones, on one device."""
        done = state.done
        end = self.chunk_end(done)
        refined, cost = refinement.refine_chunk(self.config, state.refine, jnp.int32(end - done))
        parts = {"refine/cost": cost, "refine/state": refined}
        processes.all_or_none(lambda: divergence.check_finite(end, finite_checks.NO_FAULT, parts))
        return Chunk(state.replace(refine=refined), {"refine/cost": float(cost)})

    def compile(self, shapes: RunState) -> None:
        """That of a gradient step."""
        refinement.refine_chunk.lower(self.config, shapes.refine, _COUNT).compile()

    def learner(self, state: RunState, devices: int) -> LearnerState:
        """The best learner with the refined policy in the place of its own."""
        return state.best.replace(averaged_policy=state.refine.policy)


def plan(config: TrainConfig) -> tuple[Stage, ...]:
    """List the stages of a run; those of no length are left out."""
    phases, iterations = config.curriculum, config.refine.iterations
    first = Learning(
        config,
        title="phase 1",
        phase=1,
        start=0,
        length=phases.phase1.updates,
        log_every=config.log_every,
        eval_every=config.eval_every,
        eval_from=0,
        agent="phase1",
        snapshot="phase1",
    )
    second = Learning(
        config,
        title="phase 2",
        phase=2,
        start=first.end,
        length=phases.phase2.updates,
        log_every=config.log_every,
        eval_every=config.eval_every,
        eval_from=0,
        agent="phase2",
        agent_at_end=f"phase2-{config.learner}" if iterations else None,
    )
    third = Refinement(
        config,
        title="refine",
        phase=2,
        start=second.end,
        length=iterations,
        log_every=config.refine_log_every,
        eval_every=config.refine_eval_every,
        eval_from=second.end,
        agent="phase2",
    )
    return tuple(stage for stage in (first, second, third) if stage.length)


def after(planned: Sequence[Stage], done: int) -> Stage | None:
    """Find the stage that goes on from ``done``; None at the end of the run."""
    return next((stage for stage in planned if done < stage.end), None)


def before(planned: Sequence[Stage], done: int) -> Stage:
    """Find the stage that has led to ``done``; the first one at the beginning."""
    return next(stage for stage in planned if done <= stage.end)


def split(planned: Sequence[Stage], done: int) -> tuple[int, int]:
    """Tell gradient updates from refinement iterations in ``done``.  Returns how many of each there are."""
    updates = iterations = 0
    for stage in planned:
        part = min(max(done - stage.start, 0), stage.length)
        if isinstance(stage, Refinement):
            iterations += part
        else:
            updates += part
    return updates, iterations
