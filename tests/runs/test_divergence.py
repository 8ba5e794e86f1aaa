"""Divergence: whatever is not finite is named, and nothing of it is kept; a diverging critic is warned of."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny
from support.tiny import CONFIG

from koz_jax.config.training import TrainConfig
from koz_jax.errors import DivergenceError
from koz_jax.learning import finite_checks, refinement, train_step
from koz_jax.learning.refinement import RefineState
from koz_jax.learning.train_step import TrainState
from koz_jax.runs import divergence
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.trainer import train
from koz_jax.sac import losses
from koz_jax.sac.actor_critic import LearnerMetrics
from koz_jax.task.reward import PAPER_WEIGHTS

NAN = float("nan")


def first_with(tree: Any, value: float) -> Any:
    """A tree with a value in the first element of its first leaf."""
    leaves, structure = jax.tree.flatten(tree)
    leaves[0] = leaves[0].at[(0,) * leaves[0].ndim].set(value)
    return jax.tree.unflatten(structure, leaves)


def bad_policy(state: TrainState) -> TrainState:
    return state.replace(learner=state.learner.replace(policy=first_with(state.learner.policy, NAN)))


def bad_critic(state: TrainState) -> TrainState:
    return state.replace(learner=state.learner.replace(critic=first_with(state.learner.critic, math.inf)))


def bad_observation(state: TrainState) -> TrainState:
    body = state.env_states.body
    omega_BN_B = body.omega_BN_B.at[3, 1].set(NAN)
    return state.replace(env_states=state.env_states.replace(body=body.replace(omega_BN_B=omega_BN_B)))


def bad_drawn_reward(state: TrainState) -> TrainState:
    outcome = state.buffer.rows.outcome
    rows = state.buffer.rows.replace(outcome=outcome.replace(torque=jnp.full_like(outcome.torque, math.inf)))
    return state.replace(buffer=state.buffer.replace(rows=rows))


def bad_optimizer(state: TrainState) -> TrainState:
    return state.replace(learner=state.learner.replace(target_critic=first_with(state.learner.target_critic, NAN)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("corrupt", "name"),
    [
        (bad_policy, "parameters"),
        (bad_critic, "parameters"),
        (bad_observation, "observation"),
        (bad_drawn_reward, "reward of the drawn transitions"),
        (bad_optimizer, "train/critic_loss"),
    ],
)
def test_a_fault_is_named_and_the_run_goes_on_from_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, corrupt: Callable[[TrainState], TrainState], name: str
):
    run = tiny.finished_run()
    folder = RunFolder(tmp_path / "run")
    train_chunk = train_step.train_chunk

    def corrupted(config: TrainConfig, state: TrainState, steps: jax.Array) -> Any:
        return train_chunk(config, corrupt(state) if int(state.updates) == 80 else state, steps)

    with monkeypatch.context() as patch:
        patch.setattr(train_step, "train_chunk", corrupted)
        with pytest.raises(
            DivergenceError, match=rf"^{name}: not finite in the chunk that ends at update 96; the run ends"
        ):
            train(CONFIG, folder.path, progress=False)
    assert [path.name for path in folder.checkpoints()] == ["0000000064", "0000000032"]
    assert (folder.path / "metrics.csv").read_text().splitlines()[-1].startswith("80,")
    assert train(CONFIG, folder.path, resume=True, progress=False) is not None
    assert (folder.path / "metrics.csv").read_bytes() == (run.path / "metrics.csv").read_bytes()


@pytest.mark.slow
def test_a_fault_in_refinement_is_named(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run")
    refine_chunk = refinement.refine_chunk

    def corrupted(config: TrainConfig, state: RefineState, iterations: jax.Array) -> Any:
        bad = state.replace(policy=first_with(state.policy, NAN)) if int(state.iterations) == 4 else state
        return refine_chunk(config, bad, iterations)

    monkeypatch.setattr(refinement, "refine_chunk", corrupted)
    with pytest.raises(
        DivergenceError, match=r"^refine/cost, refine/state/.* and \d+ more: not finite .* update 134; "
    ):
        train(CONFIG, folder.path, progress=False)
    assert folder.checkpoints()[0].name == "0000000132"


def chunk(monkeypatch: pytest.MonkeyPatch, seed: int, module: Any, name: str, broken: Callable[..., Any]) -> str:
    """Name of what a chunk ends with when a function that it is compiled from is broken."""
    config = CONFIG.model_copy(update={"seed": seed})  # another static argument: compiled anew, and for this alone
    state = train_step.init(CONFIG, jax.random.key(0))
    with monkeypatch.context() as patch:
        patch.setattr(module, name, broken)
        _, metrics = train_step.train_chunk(config, state, jnp.int32(4))
    return finite_checks.fault_name(int(metrics.fault))


@pytest.mark.slow
def test_a_reward_that_is_no_number_is_named(monkeypatch):
    terms = train_step.reward.terms

    def broken(*args: Any) -> Any:
        found = terms(*args)
        return found.replace(zone=found.zone / 0.0 * 0.0)

    assert chunk(monkeypatch, 1001, train_step.reward, "terms", broken) == "reward/zone"


@pytest.mark.slow
def test_a_gradient_that_is_no_number_is_named(monkeypatch):
    # Its value is right; the derivative of the square root at zero is not finite.
    critic_loss = losses.critic_loss

    def broken(q: jax.Array, target: jax.Array) -> jax.Array:
        return critic_loss(q, target) + jnp.sqrt(jnp.sum(0.0 * q))

    assert chunk(monkeypatch, 1002, losses, "critic_loss", broken) == "train/critic_gradient"


def metrics(**fields: Any) -> Any:
    sound: dict[str, Any] = dict.fromkeys(LearnerMetrics.__dataclass_fields__, np.zeros(2))
    return LearnerMetrics(**(sound | fields))


def watched(**fields: Any) -> finite_checks.Watched:
    terms = jax.tree.map(lambda _: np.ones(2), PAPER_WEIGHTS)
    sound: dict[str, Any] = {"parameters": {"a": np.ones(3)}, "observation": np.ones((2, 4)), "reward": terms}
    return finite_checks.Watched(**(sound | {"drawn_reward": np.ones(5), "train": metrics()} | fields))


def name_of(fault: finite_checks.Watched) -> str:
    return finite_checks.fault_name(int(finite_checks.first_fault(fault)))


def test_the_first_fault_in_the_order_of_the_computation_is_found():
    late = metrics(critic_loss=np.array([0.0, NAN]), policy_gradient=np.array([math.inf, 0.0]))
    assert int(finite_checks.first_fault(watched())) == finite_checks.NO_FAULT
    # The gradient of the first update broke before the loss of the second.
    assert name_of(watched(train=late)) == "train/policy_gradient"
    both = watched(train=late, drawn_reward=np.array([0.0, -math.inf]))
    assert finite_checks.fault_name(int(finite_checks.first_fault(both))) == "reward of the drawn transitions"
    assert (
        finite_checks.fault_name(int(finite_checks.first_fault(both.replace(observation=np.full((2, 4), NAN)))))
        == "observation"
    )


def test_keys_and_counters_are_no_faults():
    divergence.check_finite(
        1, finite_checks.NO_FAULT, {"key": jax.random.key(3), "steps": jnp.arange(3), "done": jnp.array([True])}
    )


def test_no_value_exceeds_what_the_reward_can_give():
    # The best that can happen is 10 per step for ever; with a scale and a discount that is
    phase = {"discount": ((0.0, 0.9),), "zone_weight": ((0.0, 0.0),)}
    config = TrainConfig.model_validate(
        tiny.merged(CONFIG.model_dump(), {"curriculum": {"phase1": phase, "phase2": phase}, "sac": {"reward_scale": 2}})
    )
    assert divergence.largest_value(config) == pytest.approx(2 * 10 / (1 - 0.9))
    assert divergence.largest_value(config, 1.0) == pytest.approx((2 * 10 + 1) / (1 - 0.9))
    zone = tiny.merged(config.model_dump(), {"curriculum": {"phase2": {"zone_weight": ((0.0, 5.0),)}}})
    reward = config.task.reward
    most = 5 * reward.zone_height + reward.no_progress_cost + reward.torque_cost
    most += reward.torque_change_cost * 2 * math.hypot(*config.task.spacecraft.torque_limits)
    assert divergence.largest_value(TrainConfig.model_validate(zone)) == pytest.approx(2 * most / (1 - 0.9))


@pytest.mark.slow
def test_a_diverging_critic_is_warned_of_once(tmp_path, monkeypatch, capsys):
    limit = divergence.largest_value(CONFIG)
    for value, warned in [(limit, False), (-limit, False), (2.1 * limit, True), (-2.1 * limit, True)]:
        assert (divergence.critic_warning(CONFIG, metrics(q_mean=value, alpha=0.0, entropy=0.0)) is not None) == warned
    monkeypatch.setattr(divergence, "largest_value", lambda *_: 1e-9)
    assert train(CONFIG, tmp_path / "run", progress=False) is not None
    warnings = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert len(warnings) == 1 and warnings[0].startswith("warning: update 16: train/q_mean is ")
