"""Training under the shield, and for several zones: what reaches the replay buffer and the reward."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny

from koz_jax.config.training import TrainConfig
from koz_jax.learning import train_step
from koz_jax.learning.train_step import TrainState
from koz_jax.task import observation_layout

pytestmark = pytest.mark.slow

# Large angles, three zones, and time enough for random torques to drift into one.
SETTINGS = {
    "task": {"scenario": {"max_zones": 3, "max_rate_deg": 6.0}},
    "network": {"observed_zones": 3},
    "curriculum": {"phase1": {"min_angle_deg": ((0.0, 90.0),), "max_angle_deg": ((0.0, 180.0),)}},
    "num_envs": 16,
    "prefill_steps": 100,
    "sac": {"buffer_size": 1600},
    "training_episode_seconds": 5.0,
}


def _config(**shielding: object) -> TrainConfig:
    changes = SETTINGS | {"shielding": shielding}
    return TrainConfig.model_validate(tiny.merged(tiny.CONFIG.model_dump(), changes))


def _filled(config: TrainConfig) -> TrainState:
    return train_step.init(config, jax.random.key(0))


@pytest.fixture(scope="module")
def free() -> TrainState:
    return _filled(_config())


@pytest.fixture(scope="module")
def shielded() -> TrainState:
    return _filled(_config(enabled=True))


def test_random_torques_enter_a_zone_and_with_the_shield_only_from_starts_that_it_does_not_cover(free, shielded):
    without, under = (
        float(np.mean(np.asarray(state.buffer.rows.outcome.zone_margin) <= 0.0)) for state in (free, shielded)
    )
    assert without > 0.01
    # Starts that are too fast to be stopped in time are flown as they are drawn.
    config = _config(enabled=True)
    env = train_step.episodes_at(config, train_step.training_environment(config), jnp.int32(0)).env
    covered = jax.jit(jax.vmap(lambda key: env.covers(env.reset(key))))(jax.random.split(jax.random.key(1), 2000))
    uncovered = 1.0 - float(np.mean(covered))
    assert under <= min(uncovered, 0.5 * without)


def test_the_buffer_holds_the_action_asked_for_and_what_was_changed_of_it(free, shielded):
    assert np.all(np.asarray(free.buffer.rows.outcome.intervention) == 0.0)
    rows = shielded.buffer.rows
    action, changed = np.asarray(rows.action), np.asarray(rows.outcome.intervention)
    assert np.all((action >= -1.0) & (action <= 1.0))
    assert 0.0 < np.mean(changed > 0.0) < 0.5
    # Where nothing was changed, the torque that was measured is that of the action; elsewhere it is another one.
    asked = 2.0 * np.linalg.norm(action, axis=-1)
    unchanged = changed == 0.0
    np.testing.assert_allclose(np.asarray(rows.outcome.torque)[unchanged], asked[unchanged], rtol=1e-5)
    assert np.mean(np.abs(np.asarray(rows.outcome.torque) - asked)[~unchanged] > 1e-3) > 0.9


def test_an_intervention_costs_what_the_settings_say(shielded):
    def mean_reward(cost: float) -> float:
        config = _config(enabled=True, intervention_cost=cost)
        env = train_step.training_environment(config)
        at = train_step.curriculum.difficulty(config.curriculum, jnp.int32(0)).replace(discount=jnp.float32(0.0))
        batch = train_step._rewarded_batch(config, env, shielded.buffer, at, jax.random.key(1))
        return float(jnp.mean(batch.reward))

    base, one, two = (mean_reward(cost) for cost in (0.0, 10.0, 20.0))
    assert one < base
    assert base - two == pytest.approx(2.0 * (base - one), rel=1e-2)


def test_training_runs_on_the_longer_observation(free):
    assert free.buffer.rows.observation.shape[-1] == observation_layout.size(3)
    state, metrics = train_step.train_chunk(_config(), jax.tree.map(jnp.copy, free), jnp.int32(2))
    assert int(state.updates) == 4
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(metrics))
