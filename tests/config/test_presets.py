"""The presets: the paper's numbers to the letter, and what every preset must be able to do."""

import json

import numpy as np
import pytest

from koz_jax.config.base import ramp_value
from koz_jax.config.curriculum import PhaseConfig
from koz_jax.config.presets import named as presets
from koz_jax.config.presets import sizes
from koz_jax.config.presets.spacecraft import for_spacecraft
from koz_jax.config.task import ScenarioConfig, TaskConfig
from koz_jax.config.training import EncodingConfig, TrainConfig
from koz_jax.errors import SettingsError

PAPER = presets.preset("paper")
FRACTIONS = np.linspace(0.0, 1.0, 101)


def values(ramp):
    return np.array([ramp_value(ramp, fraction) for fraction in FRACTIONS])


def test_paper_sac_table_2():
    sac = PAPER.sac
    assert sac.batch_size == 256
    assert sac.buffer_size == 10**6
    assert sac.soft_update == 0.005
    assert sac.target_entropy == -3.0
    assert sac.initial_entropy_coefficient == 1.0
    assert sac.n_step == 1
    assert sac.reward_scale == 1.0
    assert sac.policy_average == 1.0


def test_paper_networks():
    assert PAPER.network.hidden_sizes == (256, 256)
    assert PAPER.network.encoding == EncodingConfig(attitude_scales=(), rate_scales=(), zone_margin_scales=())


def test_paper_loop():
    assert PAPER.num_envs == 1
    assert PAPER.updates_per_step == 1
    assert PAPER.training_episode_seconds == 100.0
    assert PAPER.training_episode_steps == 1000
    assert PAPER.buffer_steps == 10**6
    assert PAPER.refine.iterations == 0  # the paper knows no such stage
    assert (PAPER.eval_min_angle_deg, PAPER.eval_max_angle_deg) == (80.0, 180.0)


def test_paper_phase_1():
    phase = PAPER.curriculum.phase1
    assert set(values(phase.min_angle_deg)) == {0.0}
    assert values(phase.max_angle_deg)[0] == 25.0
    assert values(phase.max_angle_deg)[-1] == 180.0
    assert np.all(np.diff(values(phase.max_angle_deg)) >= 0.0)
    assert set(values(phase.zone_weight)) == {0.0}


def test_paper_phase_2():
    phase = PAPER.curriculum.phase2
    assert set(values(phase.min_angle_deg)) == {80.0}
    assert values(phase.max_angle_deg)[0] == 80.0
    assert values(phase.max_angle_deg)[-1] == 180.0
    assert np.all(np.diff(values(phase.max_angle_deg)) >= 0.0)
    assert set(values(phase.zone_weight)) == {1.0}


@pytest.mark.parametrize("number", [1, 2])
def test_paper_phases_add_nothing_of_ours(number):
    phase = getattr(PAPER.curriculum, f"phase{number}")
    assert phase.updates > 0
    assert set(values(phase.learning_rate)) == {1e-4}
    assert set(values(phase.discount)) == {0.99}
    assert set(values(phase.angle_bias)) == {1.0}
    assert set(values(phase.zone_tightening_deg)) == {0.0}
    assert set(values(phase.zone_steepness)) == {1.0}
    assert set(values(phase.effort_weight)) == {0.0}
    tested = {"updates", "min_angle_deg", "max_angle_deg", "zone_weight", "learning_rate", "discount"}
    tested |= {"angle_bias", "zone_tightening_deg", "zone_steepness", "effort_weight"}
    assert set(PhaseConfig.model_fields) == tested  # a new knob needs its paper value here


@pytest.mark.parametrize("name", presets.PRESETS)
def test_spacecraft_of_the_paper(name):
    task = presets.preset(name).task
    assert task.spacecraft.inertia == ((60.0, 5.0, 1.0), (5.0, 50.0, 2.0), (1.0, 2.0, 70.0))
    assert task.spacecraft.boresight == (1.0, 0.0, 0.0)
    assert task.spacecraft.torque_limit == 2.0
    assert task.step_seconds == 0.1
    assert task.episode_seconds == 100.0
    assert task.episode_steps == (1000 if name != "universal" else round(100.0 / (0.016 * 30.0**0.5)))
    assert task.angle_convention == "full"


@pytest.mark.parametrize("name", presets.PRESETS)
def test_reward_of_the_paper(name):
    reward = presets.preset(name).task.reward
    assert reward.attitude_scale == 0.14 * 2.0 * np.pi
    assert reward.settled_angle_deg == 0.25
    assert reward.settled_bonus == 9.0
    assert reward.torque_cost == 0.05
    assert reward.torque_change_cost == 0.005
    assert reward.zone_height == 10.0
    assert reward.zone_decay == 66.0
    assert reward.no_progress_cost == 1.0
    assert reward.progress_tolerance_deg == 0.0


@pytest.mark.parametrize("name", presets.PRESETS)
def test_scenarios_of_the_paper(name):
    assert presets.preset(name).task.scenario == ScenarioConfig(
        max_rate_deg=0.001,
        min_half_angle_deg=15.0,
        max_half_angle_deg=30.0,
        separation_deg=2.0,
        infeasible_zone="resample",
    )


@pytest.mark.parametrize("name", presets.PRESETS)
def test_presets_are_hashable_named_and_survive_json(name):
    config = presets.preset(name)
    assert config.preset == name
    assert hash(config) == hash(presets.preset(name))
    back = TrainConfig.model_validate_json(config.model_dump_json())
    assert back == config and hash(back) == hash(config)
    assert TrainConfig.model_validate(json.loads(json.dumps(config.model_dump()))) == config


@pytest.mark.parametrize("name", presets.PRESETS)
def test_presets_cannot_be_changed(name):
    with pytest.raises(ValueError, match="frozen"):
        presets.preset(name).seed = 1
    with pytest.raises(ValueError, match="frozen"):
        presets.preset(name).sac.n_step = 5


@pytest.mark.parametrize("name", presets.PRESETS)
def test_presets_go_from_small_angles_without_a_zone_to_large_ones_with_it(name):
    phase1, phase2 = presets.preset(name).curriculum.phase1, presets.preset(name).curriculum.phase2
    assert np.all(values(phase1.zone_weight) == 0.0)
    assert np.all(values(phase2.zone_weight) > 0.0)
    for phase in (phase1, phase2):
        assert values(phase.max_angle_deg)[-1] == 180.0
        assert np.all(np.diff(values(phase.max_angle_deg)) >= 0.0)
        assert np.all(np.diff(values(phase.effort_weight)) >= 0.0)
        assert np.all(values(phase.learning_rate) > 0.0)


def test_presets_differ():
    assert len({hash(config) for config in presets.PRESETS.values()}) == len(presets.PRESETS)


@pytest.mark.parametrize("name", ["Paper", "", "slow"])
def test_an_unknown_preset_names_those_that_exist(name):
    with pytest.raises(SettingsError) as caught:
        presets.preset(name)
    for known in presets.PRESETS:
        assert known in str(caught.value)


# --- for another spacecraft, and on a GPU ---


def _twice_as_slow() -> TaskConfig:
    """The paper's spacecraft with four times its inertia, and a time step twice as long: T is twice as long too."""
    paper = TaskConfig()
    heavy = tuple(tuple(4.0 * entry for entry in row) for row in paper.spacecraft.inertia)
    return TaskConfig.model_validate(
        {
            "spacecraft": {"inertia": heavy},
            "scenario": {"max_rate_deg": paper.scenario.max_rate_deg / 2.0},
            "step_seconds": 2.0 * paper.step_seconds,
            "episode_seconds": 2.0 * paper.episode_seconds,
        }
    )


@pytest.mark.parametrize("name", ["fast", "universal"])
def test_a_spacecraft_that_is_twice_as_slow_is_trained_over_the_same_steps(name):
    given, own = presets.preset(name), for_spacecraft(presets.preset(name), _twice_as_slow())
    assert own.task.spacecraft.time_unit == pytest.approx(2.0 * given.task.spacecraft.time_unit)
    assert own.training_episode_steps == given.training_episode_steps
    assert own.refine_steps == given.refine_steps
    # Gradients of a policy in units of its spacecraft are bounded; a preset that is for one bounds them itself.
    assert own.refine.max_maneuver_gradient > 0.0 and own.refine.state_gradient is not None
    same = own.refine.model_copy(update={"horizon_seconds": given.refine.horizon_seconds}) == given.refine
    assert same == given.network.scaled
    assert own.task.episode_steps == round(given.task.episode_seconds / given.task.step_seconds)
    assert own.network.scaled and not own.task.spread.spacecraft
    limits = given.task.spread.max_rate_deg
    assert own.task.spread.max_rate_deg == (limits and tuple(pytest.approx(limit / 2.0) for limit in limits))
    assert own.task.spread.errors.rate_noise_deg == pytest.approx(given.task.spread.errors.rate_noise_deg / 2.0)
    assert own.task.spread.errors.disturbance_torque == given.task.spread.errors.disturbance_torque
    of_paper = given.network.encoding.rate_scales
    unit = 1.0 if given.network.scaled else given.task.spacecraft.time_unit
    assert own.network.encoding.rate_scales == pytest.approx([unit * scale for scale in of_paper])


def test_sizes_of_a_gpu_leave_what_was_set_by_hand():
    fast = presets.preset("fast")
    sized, changed = sizes.for_gpu(fast)
    assert sized.sac.batch_size > fast.sac.batch_size
    assert sized.refine.scenarios > fast.refine.scenarios and sized.refine.iterations < fast.refine.iterations
    assert changed["sac.batch_size"] == sized.sac.batch_size
    by_hand = fast.model_copy(update={"num_envs": 64})
    again, changed = sizes.for_gpu(by_hand)
    assert again == sized.model_copy(update={"num_envs": 64}) and "num_envs" not in changed
    for other in ("paper", "smoke"):
        assert sizes.for_gpu(presets.preset(other)) == (presets.preset(other), {})
