"""Who learns is a setting: a run with another learner, and what its agent is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydantic import ValidationError
from support import tiny

from koz_jax.agents.agent import load_agent
from koz_jax.config.training import TrainConfig
from koz_jax.errors import SettingsError
from koz_jax.learners.td3 import Td3
from koz_jax.learning import learners
from koz_jax.runs import checkpoint
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.trainer import train
from koz_jax.sac.learner import Sac
from koz_jax.task.reward import Outcome


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A whole run of DDPG, whose second phase draws by priority."""
    config = tiny.changed({"learner": "ddpg", "refine": {"iterations": 0}})
    path = tmp_path_factory.mktemp("runs") / "ddpg"
    train(config, path, progress=False)
    return RunFolder(path)


@pytest.mark.slow
def test_the_agent_of_a_run_is_like_any_other(run):
    agent = load_agent(run.path)
    assert agent.provenance.phase == 2
    observed = np.random.default_rng(0).normal(size=(20, 16)).astype(np.float32)
    np.testing.assert_allclose(agent.to_numpy().predict(observed), agent.predict(observed), atol=1e-5)
    assert "ddpg" in run.config.read_text() and "td3" not in run.config.read_text()


@pytest.mark.slow
def test_another_learner_cannot_begin_from_it(run):
    with pytest.raises(SettingsError, match=r"start_from: learner must be ddpg.*got sac"):
        checkpoint.load_source(run.path, tiny.UNREFINED)


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
