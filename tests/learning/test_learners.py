"""Who learns is a setting: what it makes of a run, and of its agent."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydantic import ValidationError
from support import tiny

from koz_jax.agents.agent import Agent
from koz_jax.agents.numpy_policy import load_policy
from koz_jax.agents.record import Provenance
from koz_jax.config.training import TrainConfig
from koz_jax.control.policy import PolicyController
from koz_jax.errors import SettingsError
from koz_jax.learners.td3 import Td3
from koz_jax.learning import learners, train_step
from koz_jax.runs import checkpoint
from koz_jax.sac.learner import Sac
from koz_jax.task.reward import Outcome


@pytest.mark.slow
def test_ddpg_learns_by_priority_and_its_agent_is_like_any_other(tmp_path):
    config = tiny.changed({"learner": "ddpg", "curriculum": {"phase1": {"updates": 0}}, "refine": {"iterations": 0}})
    begun = checkpoint.begin(config, None)
    before = jax.tree.map(np.array, begun.train.learner.averaged_policy)
    trained, metrics = train_step.train_chunk(config, begun.train, jnp.int32(4))
    policy = trained.learner.averaged_policy
    assert not any(np.array_equal(*pair) for pair in zip(*map(_weights, (before, policy)), strict=True))
    assert all(np.isfinite(jax.tree.leaves(metrics.learner)))

    agent = Agent(PolicyController(policy, config.network), config.task, Provenance(), "ddpg")
    agent.save(tmp_path / "agent")
    observed = np.random.default_rng(0).normal(size=(20, 16)).astype(np.float32)
    np.testing.assert_allclose(load_policy(tmp_path / "agent").predict(observed), agent.predict(observed), atol=1e-5)

    checkpoint.save(tmp_path / "snapshot", begun.replace(train=trained), config)
    with pytest.raises(SettingsError, match=r"start_from: learner must be ddpg.*got sac"):
        checkpoint.load_source(tmp_path / "snapshot", tiny.UNREFINED)


def _weights(policy):
    """Matrices of the hidden layers; of the last, half is for a deviation that has no gradient."""
    return [policy["params"]["Mlp_0"][f"Dense_{i}"]["kernel"] for i in range(2)]


def test_the_setting_says_who_learns():
    assert isinstance(learners.make(tiny.CONFIG), Sac)
    td3, ddpg = (learners.make(tiny.changed({"learner": name})) for name in ("td3", "ddpg"))
    assert isinstance(td3, Td3) and (td3.critics, td3.policy_delay, td3.target_noise) == (2, 2, 0.2)
    assert isinstance(ddpg, Td3) and (ddpg.critics, ddpg.policy_delay, ddpg.target_noise) == (1, 1, 0.0)
    with pytest.raises(ValidationError, match="learner"):
        tiny.changed({"learner": "a2c"})
    with pytest.raises(ValidationError, match="zone_priority must be below"):
        tiny.changed({"learner": "ddpg", "ddpg": {"zone_priority": 2**21}})


def test_the_settings_of_a_run_say_nothing_of_learners_that_it_does_not_use():
    """So that the hash of a run of Soft Actor-Critic is what it was before there were others."""
    text = tiny.CONFIG.to_json()
    assert not any(f'"{name}"' in text for name in ("learner", "td3", "ddpg"))
    for config in (tiny.CONFIG, tiny.changed({"learner": "td3", "td3": {"policy_delay": 3}})):
        assert TrainConfig.model_validate_json(config.to_json()) == config


def test_priority_is_of_phase_two_near_zones_and_of_ddpg():
    margin = jnp.deg2rad(jnp.array([-3.0, 4.0, 6.0]))
    outcome = Outcome(*(margin if name == "zone_margin" else jnp.zeros(3) for name in Outcome.__dataclass_fields__))
    config = tiny.changed({"learner": "ddpg", "ddpg": {"zone_priority": 7, "zone_margin_deg": 5.0}})
    for phase, expected in ((1, [1, 1, 1]), (2, [7, 7, 1])):
        found = learners.priority(config, outcome, jnp.int32(phase))
        assert isinstance(found, jax.Array) and found.tolist() == expected
    assert learners.priority(tiny.CONFIG, outcome, jnp.int32(2)) is None
