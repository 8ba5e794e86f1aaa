"""The stages of a run: where they begin and end, what is the best of each, and what the next one begins from."""

import signal
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import tiny
from support.runs import assert_same_tree, signal_after, state_of
from support.tiny import CONFIG

from koz_jax.agents.agent import load_agent
from koz_jax.config.goal import GoalConfig
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.learning import train_step
from koz_jax.runs import stages
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.stages import Stage
from koz_jax.runs.trainer import train
from koz_jax.task.reward import PAPER_WEIGHTS


@pytest.mark.slow
def test_the_best_learner_of_phase_1_starts_phase_2(tmp_path, monkeypatch):
    # The first evaluation of the phase is made to be the better one.
    scores = iter([2.0, 1.0])
    monkeypatch.setattr(Stage, "score", lambda *_: next(scores))
    folder = RunFolder(tmp_path / "run")
    with signal_after(64, signal.SIGINT):
        assert train(CONFIG, folder.path, progress=False) is None
    snapshot, begun = state_of(folder.snapshot("phase1")), state_of(folder.checkpoints()[0])
    assert (float(snapshot.best_score), int(snapshot.best_at)) == (2.0, 32)
    assert_same_tree(begun.train.learner, snapshot.best)
    assert not np.array_equal(begun.train.learner.trained[-1], snapshot.train.learner.trained[-1])
    assert_same_tree(begun.train.buffer, snapshot.train.buffer)
    assert float(begun.best_score) == -np.inf  # phase 2 judges anew
    agent = load_agent(folder.agent("phase1"))
    assert agent.provenance.updates == 32
    assert_same_tree(agent.controller.policy, snapshot.best.averaged_policy)


def test_of_equal_agents_the_newer_is_the_best_and_refinement_must_do_better():
    *learning, refining = stages.plan(CONFIG)
    assert all(stage.is_better(0.0, 0.0) for stage in learning) and not refining.is_better(0.0, 0.0)
    for stage in (*learning, refining):
        assert stage.is_better(1.0, 0.0) and stage.is_better(0.0, -np.inf) and not stage.is_better(0.0, 1.0)
    *learning, refining = stages.plan(tiny.changed({"refine": {"keep": "last"}}))
    assert refining.is_better(0.0, 1.0) and not any(stage.is_better(0.0, 1.0) for stage in learning)


@pytest.mark.slow
def test_refinement_begins_with_the_best_of_phase_2_and_the_best_of_all_is_returned(tmp_path, monkeypatch):
    scores = iter([1.0, 1.0, 4.0, 3.0, 5.0, 2.0])
    monkeypatch.setattr(Stage, "score", lambda *_: next(scores))
    folder = RunFolder(tmp_path / "run")
    with signal_after(tiny.LEARNED, signal.SIGINT):
        assert train(CONFIG, folder.path, progress=False) is None
    begun = state_of(folder.checkpoints()[0])
    assert int(begun.best_at) == 96
    assert_same_tree(begun.refine.policy, begun.best.averaged_policy)
    assert_same_tree(begun.refine.policy, load_agent(folder.agent("phase2-sac")).controller.policy)
    agent = train(CONFIG, folder.path, resume=True, progress=False)
    assert agent is not None
    assert (agent.provenance.updates, agent.provenance.refinements) == (128, 4)
    assert load_agent(folder.path).provenance == agent.provenance
    assert_same_tree(agent.controller, load_agent(folder.path).controller)


def test_a_training_of_one_phase_returns_its_best(tmp_path, monkeypatch):
    scores = iter([2.0, 1.0])
    monkeypatch.setattr(Stage, "score", lambda *_: next(scores))
    config = tiny.changed({"curriculum": {"phase2": {"updates": 0}}, "refine": {"iterations": 0}})
    # Phase 1 is the same with or without a second phase: use what is compiled already.
    init, train_chunk = train_step.init, train_step.train_chunk
    monkeypatch.setattr(train_step, "init", lambda _, key: init(CONFIG, key))
    monkeypatch.setattr(train_step, "train_chunk", lambda _, state, steps: train_chunk(CONFIG, state, steps))
    folder = RunFolder(tmp_path / "run")
    agent = train(config, folder.path, progress=False)
    assert agent is not None
    assert (agent.provenance.phase, agent.provenance.updates) == (1, 32)
    assert_same_tree(agent.controller, load_agent(folder.path).controller)
    resumed = train(config, folder.path, resume=True, progress=False)
    assert resumed is not None and resumed.provenance.updates == 32


def test_the_score_of_a_phase_counts_what_it_asks_for():
    # One case succeeds, one settles but violates the zone, one does not settle.
    terms = jax.tree.map(lambda _: jnp.zeros(3), PAPER_WEIGHTS).replace(
        attitude=jnp.array([100.0, 10.0, 1.0]), zone=jnp.array([-4.0, -4.0, -4.0])
    )
    results = CaseResult(
        initial_angle=jnp.ones(3),
        reward_terms=terms,
        settling_time=jnp.array([1.0, 1.0, jnp.nan]),
        control_effort=jnp.ones(3),
        control_accuracy=jnp.ones(3),
        min_margin=jnp.array([1.0, -1.0, 1.0]),
        settled=jnp.array([True, True, False]),
        violated=jnp.array([False, True, False]),
        **tiny.unshielded(3),
    )
    # Phase 1 ends with zone weight 0, phase 2 with 1; refinement is scored as phase 2.
    first, second, third = stages.plan(CONFIG)
    assert first.score(results) == pytest.approx((100 + 10) / 3)
    assert second.score(results) == third.score(results) == pytest.approx((100 - 4) / 3)


def test_a_run_has_the_stages_that_its_settings_ask_for():
    first, second, third = stages.plan(CONFIG)
    assert [(stage.start, stage.end) for stage in (first, second, third)] == [(0, 64), (64, 128), (128, 136)]
    assert [stage.agent for stage in (first, second, third)] == ["phase1", "phase2", "phase2"]
    assert (first.snapshot, second.agent_at_end, third.agent_at_end) == ("phase1", "phase2-sac", None)
    (only,) = stages.plan(tiny.changed({"curriculum": {"phase2": {"updates": 0}}, "refine": {"iterations": 0}}))
    assert (only.title, only.start, only.end) == ("phase 1", 0, 64)
    (only,) = stages.plan(tiny.changed({"curriculum": {"phase1": {"updates": 0}}, "refine": {"iterations": 0}}))
    assert (only.title, only.start, only.end, only.agent_at_end) == ("phase 2", 0, 64, None)


def test_a_moment_belongs_to_one_stage_before_and_one_after_it():
    planned = stages.plan(CONFIG)
    found = {
        done: (stages.before(planned, done).title, getattr(stages.after(planned, done), "title", None))
        for done in (0, 63, 64, 127, 128, 135, 136)
    }
    assert found == {
        0: ("phase 1", "phase 1"),
        63: ("phase 1", "phase 1"),
        64: ("phase 1", "phase 2"),
        127: ("phase 2", "phase 2"),
        128: ("phase 2", "refine"),
        135: ("refine", "refine"),
        136: ("refine", None),
    }
    assert [stages.split(planned, done) for done in (0, 96, 128, 130, 136)] == [
        *((0, 0), (96, 0), (128, 0), (128, 2), (128, 8))
    ]


COUNTS = st.integers(1, 40)


@given(st.integers(0, 60), COUNTS, st.integers(0, 30), st.tuples(COUNTS, COUNTS, COUNTS, COUNTS))
def test_chunks_end_at_rows_of_the_log_evaluations_and_stages(phase1, phase2, iterations, every):
    names = ("log_every", "eval_every", "refine_log_every", "refine_eval_every")
    changes: dict[str, Any] = dict(zip(names, every, strict=True))
    changes["curriculum"] = {"phase1": {"updates": phase1}, "phase2": {"updates": phase2}}
    config = tiny.changed(changes | {"refine": {"iterations": iterations}, "updates_per_step": 1})
    planned, learned, length = stages.plan(config), phase1 + phase2, phase1 + phase2 + iterations
    evaluations = {
        *range(config.eval_every, learned, config.eval_every),
        *range(learned + config.refine_eval_every, length, config.refine_eval_every),
        *(end for end in (phase1, learned, length) if end > 0),
    }
    logged = {*range(0, learned, config.log_every)}
    logged |= {done for done in range(learned + 1, length) if done % config.refine_log_every == 0}
    done, ends, evaluated = 0, [], []
    while (stage := stages.after(planned, done)) is not None:
        done = stage.chunk_end(done)
        ends.append(done)
        evaluated += [done] if stage.is_evaluated_at(done) else []
    assert ends == sorted((evaluations | logged) - {0})
    assert evaluated == sorted(evaluations)


def _outcome(success: float, settling: float, effort: float) -> dict[str, float]:
    names = ("success_rate", "settling_time_mean", "control_effort_mean")
    return {f"eval/{name}": value for name, value in zip(names, (success, settling, effort), strict=True)}


def test_a_stage_ends_early_only_by_its_best_agent_that_reaches_every_goal():
    until = ["success=99", "settling=20"]
    goals = [dict(zip(("quantity", "bound"), goal.split("="), strict=True)) for goal in until]
    stage = stages.plan(tiny.changed({"until": goals}))[-1]
    assert [str(goal) for goal in stage.config.until] == until
    done = stage.start + 2
    assert stage.ends_early(done, done, _outcome(0.99, 20.0, 1e9))
    assert not stage.ends_early(done, done, _outcome(0.9899, 20.0, 1.0))
    assert not stage.ends_early(done, done, _outcome(1.0, 20.01, 1.0))
    assert not stage.ends_early(done, done, _outcome(1.0, np.nan, 1.0))
    assert not stage.ends_early(done, done, {})  # a row without an evaluation
    assert not stage.ends_early(done, done - 1, _outcome(1.0, 1.0, 1.0))
    assert not stage.ends_early(stage.start, stage.start, _outcome(1.0, 1.0, 1.0))
    assert not stages.plan(CONFIG)[-1].ends_early(done, done, _outcome(1.0, 1.0, 1.0))  # without goals


@pytest.mark.slow
def test_a_run_that_reached_its_goals_is_finished_and_stays_so(tmp_path, monkeypatch):
    scores = iter([1.0, 1.0, 1.0, 1.0, 2.0])
    monkeypatch.setattr(Stage, "score", lambda *_: next(scores))
    monkeypatch.setattr(GoalConfig, "is_met", lambda *_: True)
    config = tiny.changed({"until": [{"quantity": "success", "bound": 99.0}]})
    folder = RunFolder(tmp_path / "run")
    agent = train(config, folder.path, progress=False)
    assert agent is not None and agent.provenance.refinements == config.refine_eval_every < config.refine.iterations
    assert agent.provenance.refinements_tried == agent.provenance.refinements
    log = (folder.path / "metrics.csv").read_bytes()
    again = train(config, folder.path, resume=True, progress=False)  # no score is left to take
    assert again is not None and again.provenance == agent.provenance
    assert_same_tree(again.controller, agent.controller)
    assert (folder.path / "metrics.csv").read_bytes() == log
