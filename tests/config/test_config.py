"""Settings: what is allowed, what is said when it is not, and the way to JSON and back."""

import json
from collections.abc import Iterator
from typing import Any, ClassVar

import pytest
from pydantic import ValidationError

from koz_jax.config.base import Settings, checked, constant, ramp_value
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.presets import named as presets
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import RewardConfig, SpacecraftConfig, TaskConfig, check_deviations, is_paper_task
from koz_jax.config.training import TrainConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.errors import KozError, SettingsError, explain

FAST = presets.preset("fast")


def changed(name: str, value: Any) -> TrainConfig:
    """The fast preset with one field changed, by its dotted name."""
    content = FAST.model_dump()
    *sections, field = name.split(".")
    place = content
    for section in sections:
        place = place[section]
    place[field] = value
    return TrainConfig.model_validate(content)


def sections(settings: Settings, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """All fields of a settings object, sections included: dotted name, declaration, value."""
    for name, field in type(settings).model_fields.items():
        value = getattr(settings, name)
        yield prefix + name, field, value
        if isinstance(value, Settings):
            yield from sections(value, f"{prefix}{name}.")


# name, value, and what the message must hold besides the name: the value as given, and what is allowed.
BAD = [
    ("task.spacecraft.inertia", ((1, 0, 0), (0, 1, 0), (0, 0, -1)), ["positive definite", "-1"]),
    ("task.spacecraft.inertia", ((1, 2, 0), (2, 1, 0), (0, 0, 2)), ["positive definite", "-1"]),
    ("task.spacecraft.inertia", ((0, 0, 0), (0, 0, 0), (0, 0, 0)), ["positive definite", "0.0"]),
    ("task.spacecraft.inertia", ((1, 0.5, 0), (0, 1, 0), (0, 0, 1)), ["symmetric", "0.5"]),
    ("task.spacecraft.inertia", ((1, 0, 0), (0, 1, 0), (0, 0, 2.1)), ["triangle inequality", "2.1"]),
    ("task.spacecraft.inertia", ((1, 0), (0, 1)), ["inertia"]),
    ("task.spacecraft.boresight", (1, 1, 0), ["unit vector", "1.41421"]),
    ("task.spacecraft.boresight", (0, 0, 0), ["unit vector", "length 0"]),
    ("task.spacecraft.boresight", (float("nan"), 0, 0), ["finite", "nan"]),
    ("task.spacecraft.torque_limit", 0, ["greater than 0"]),
    ("task.spacecraft.torque_limit", (1.0, 2.0), ["torque_limit"]),
    ("task.spacecraft.torque_limit", (1.0, -2.0, 3.0), ["greater than 0", "-2"]),
    ("task.spacecraft.torque_limit", (1.0, 2.0, 3.0), None),  # one for each axis
    ("task.scenario.max_half_angle_deg", 180, ["less than 180", "180"]),
    ("task.scenario.min_half_angle_deg", 0, ["greater than 0", "0"]),
    ("task.scenario.min_half_angle_deg", -5, ["greater than 0", "-5"]),
    ("task.scenario.min_half_angle_deg", 40, ["at most max_half_angle_deg", "40", "30"]),
    ("task.scenario.infeasible_zone", "skip", ["resample", "shrink", "skip"]),
    ("task.angle_convention", "quarter", ["full", "half", "quarter"]),
    ("task.step_seconds", 0, ["greater than 0"]),
    ("task.step_seconds", 1e-300, ["episode_seconds", "2^31 - 1 steps", "100"]),
    ("task.episode_seconds", 0.01, ["1 to 2^31 - 1 steps of step_seconds = 0.1", "0.01"]),
    ("task.reward.zone_decay", float("inf"), ["finite", "inf"]),
    ("network.hidden_sizes", (128, 0), ["greater than 0", "0"]),
    ("network.encoding.rate_scales", (0.1, -0.1), ["greater than 0", "-0.1"]),
    ("sac.batch_size", 512_001, ["at most sac.buffer_size", "512001", "512000"]),
    ("sac.buffer_size", 100, ["sac.batch_size", "128", "100"]),
    ("sac.n_step", 1001, ["sac.buffer_size", "num_envs = 512", "n_step = 1001"]),
    ("sac.reward_scale", float("nan"), ["finite", "nan"]),
    ("sac.soft_update", 1.5, ["less than or equal to 1", "1.5"]),
    ("prefill_steps", 2, ["at least sac.n_step", "2"]),
    ("num_envs", 0, ["greater than 0", "0"]),
    ("num_envs", "abc", ["integer", "abc"]),
    ("num_envs", 2**31, ["less than 2147483648", "2147483648"]),
    ("seed", -1, ["greater than or equal to 0", "-1"]),
    ("seed", 2**32, ["less than 4294967296", "4294967296"]),
    ("seed", 1.5, ["integer", "1.5"]),
    ("eval_max_angle_deg", 181, ["less than or equal to 180", "181"]),
    ("eval_min_angle_deg", 170.0, None),  # allowed: the range is not empty
    ("eval_max_angle_deg", 79.0, ["eval_min_angle_deg must be at most", "80", "79"]),
    ("eval_every", 4001, ["multiple of updates_per_step = 8", "4001"]),
    ("log_every", 0, ["greater than 0", "0"]),
    ("training_episode_seconds", 0.04, ["1 to 2^31 - 1 steps of step_seconds = 0.1", "0.04"]),
    ("curriculum.phase1.updates", -8, ["greater than or equal to 0", "-8"]),
    ("curriculum.phase2.updates", 2**31 - 8, ["less than 2^31 updates"]),
    ("curriculum.phase1.max_angle_deg", (), ["one or more (fraction, value) pairs"]),
    ("curriculum.phase1.max_angle_deg", ((0, 10), (0.5, 300)), ["must stay in [0.0, 180.0]", "300"]),
    ("curriculum.phase1.max_angle_deg", ((0, 10), (2.0, 100)), ["fractions rising strictly in [0, 1]", "2.0"]),
    ("curriculum.phase1.max_angle_deg", ((0.5, 10), (0.5, 100)), ["fractions rising strictly", "0.5"]),
    ("curriculum.phase1.max_angle_deg", ((0, float("inf")),), ["finite", "inf"]),
    ("curriculum.phase1.min_angle_deg", ((0, 90),), ["min_angle_deg must not exceed max_angle_deg", "90"]),
    ("curriculum.phase2.learning_rate", ((0, -1e-4),), ["must stay in [0.0, 1.0]", "-0.0001"]),
    ("curriculum.phase2.zone_weight", ((0, -1),), ["must stay in [0.0, ", "-1"]),
    ("curriculum.phase2.discount", ((0, 1.0),), ["must stay in [0.0, 0.99999]", "1.0"]),
    ("refine.max_maneuver_gradient", 0.0, ["violator_weight: needs", "above 0", "8.0"]),
]


@pytest.mark.parametrize(("name", "value", "words"), BAD)
def test_what_is_not_allowed_is_refused_by_name_and_value(name, value, words):
    if words is None:
        changed(name, value)
        return
    with pytest.raises(ValidationError) as caught:
        changed(name, value)
    message = explain(caught.value)
    for word in [name.rsplit(".", 1)[-1].removesuffix("_size"), *words]:
        assert word in message
    assert len(message) < 250 * len(message.splitlines())
    assert "pydantic" not in message and "input_type" not in message


def test_an_empty_training_is_refused():
    content = FAST.model_dump()
    for phase in content["curriculum"].values():
        phase["updates"] = 0
    content["refine"]["iterations"] = 0
    with pytest.raises(ValidationError, match="at least one update"):
        TrainConfig.model_validate(content)


def test_a_message_has_one_line_per_bad_setting_with_its_full_name():
    content = FAST.model_dump()
    content["num_envs"] = 0
    content["task"]["scenario"]["max_half_angle_deg"] = 200.0
    content["sac"]["discont"] = 0.9
    with pytest.raises(ValidationError) as caught:
        TrainConfig.model_validate(content)
    assert sorted(line.split(":")[0] for line in explain(caught.value).splitlines()) == [
        "num_envs",
        "sac.discont",
        "task.scenario.max_half_angle_deg",
    ]


def test_a_huge_bad_value_does_not_fill_the_screen():
    with pytest.raises(ValidationError) as caught:
        changed("network.hidden_sizes", "x" * 10_000)
    assert len(explain(caught.value)) < 200


def test_boundaries_of_the_physics_are_allowed():
    # A flat body has its largest moment equal to the sum of the others: the limit of what exists.
    changed("task.spacecraft.inertia", ((1, 0, 0), (0, 1, 0), (0, 0, 2)))
    changed("task.spacecraft.boresight", (0.6, 0.0, -0.8))
    changed("task.scenario.max_half_angle_deg", 179.9)
    changed("sac.batch_size", 512_000)
    changed("eval_max_angle_deg", 80.0)
    changed("seed", 2**32 - 1)


@pytest.mark.parametrize("name", presets.PRESETS)
def test_json_round_trip(name):
    config = presets.preset(name)
    text = config.model_dump_json()
    assert TrainConfig.model_validate_json(text) == config
    assert TrainConfig.model_validate(json.loads(text)) == config
    assert hash(TrainConfig.model_validate_json(text)) == hash(config)


@pytest.mark.parametrize("section", ["", "task", "task.spacecraft", "sac", "curriculum.phase1"])
def test_an_unknown_field_is_refused(section):
    name = f"{section}.colour".lstrip(".")
    with pytest.raises(ValidationError) as caught:
        changed(name, "red")
    assert explain(caught.value).startswith(f"{name}: Extra inputs are not permitted (got 'red')")


def test_settings_cannot_be_changed_after_their_check():
    with pytest.raises(ValidationError, match="frozen"):
        FAST.num_envs = 3


def test_every_field_has_a_description():
    everything = (FAST, MonteCarloConfig(shield=ShieldConfig(), uncertainty=UncertaintyConfig()))
    assert [name for settings in everything for name, field, _ in sections(settings) if not field.description] == []


def test_an_unknown_preset_is_refused_and_the_known_are_listed():
    with pytest.raises(SettingsError, match=f"preset: unknown preset 'quick'; allowed: {', '.join(presets.PRESETS)}"):
        presets.preset("quick")


def test_rules_are_changed_and_checked():
    task = TaskConfig()
    assert task.with_rules(None, None) == task
    other = task.with_rules("half", "shrink")
    assert (other.angle_convention, other.scenario.infeasible_zone) == ("half", "shrink")
    assert other.with_rules("full", "resample") == task
    with pytest.raises(ValidationError, match="quarter"):
        task.with_rules("quarter", None)  # pyright: ignore[reportArgumentType]


def test_a_ramp_is_linear_between_its_points_and_constant_outside():
    ramp = ((0.2, 10.0), (0.6, 30.0))
    assert [ramp_value(ramp, fraction) for fraction in (0.0, 0.2, 0.4, 0.6, 1.0)] == [10, 10, 20, 30, 30]
    assert ramp_value(constant(7.0), 0.3) == 7


def test_a_torque_limit_is_one_number_for_all_axes_or_one_for_each():
    assert SpacecraftConfig(torque_limit=0.3).torque_limits == (0.3, 0.3, 0.3)
    assert SpacecraftConfig(torque_limit=(1.0, 2.0, 3.0)).torque_limits == (1.0, 2.0, 3.0)
    for wrong, message in (
        (0, "torque_limit.all_axes: Input should be greater than 0 (got 0)"),
        ((1.0, -2.0, 3.0), "torque_limit.each_axis.1: Input should be greater than 0 (got -2.0)"),
    ):
        with pytest.raises(SettingsError) as caught:
            checked(SpacecraftConfig, torque_limit=wrong)
        assert str(caught.value) == message
    # What was given is kept, so that records of old agents stay as they are.
    assert SpacecraftConfig().model_dump()["torque_limit"] == 2.0
    again = SpacecraftConfig.model_validate_json(SpacecraftConfig(torque_limit=(1.0, 2.0, 3.0)).model_dump_json())
    assert again.torque_limit == (1.0, 2.0, 3.0) and hash(again) == hash(SpacecraftConfig(torque_limit=(1.0, 2.0, 3.0)))


@pytest.mark.parametrize(
    ("angles", "message"),
    [
        ((-1.0, 90.0), r"min_angle_deg: must be in \[0, 180\], got -1.0"),
        ((181.0, 182.0), r"min_angle_deg: must be in \[0, 180\], got 181.0"),
        ((float("nan"), 90.0), r"min_angle_deg: must be in \[0, 180\], got nan"),
        ((80.0, 79.0), r"max_angle_deg: must be in \[min_angle_deg = 80.0, 180\], got 79.0"),
        ((80.0, float("inf")), r"max_angle_deg: must be in \[min_angle_deg = 80.0, 180\], got inf"),
    ],
)
def test_deviations_that_cannot_be_are_refused(angles, message):
    with pytest.raises(SettingsError, match=message):
        check_deviations(*angles)
    check_deviations(0.0, 180.0)
    check_deviations(90.0, 90.0)


def test_settings_of_a_caller_are_refused_with_an_error_of_ours():
    """``checked`` makes of what pydantic says one line per setting, in an error that is a ``ValueError`` too."""
    assert checked(TaskConfig, step_seconds=0.2) == TaskConfig(step_seconds=0.2)
    with pytest.raises(SettingsError) as caught:
        checked(TaskConfig, step_seconds=-1.0, colour="red")
    assert isinstance(caught.value, ValueError) and isinstance(caught.value, KozError)
    assert str(caught.value).splitlines() == [
        "step_seconds: Input should be greater than 0 (got -1.0)",
        "colour: Extra inputs are not permitted (got 'red')",
    ]
    assert caught.value.__cause__ is None and caught.value.__suppress_context__


@pytest.mark.parametrize(
    ("changes", "papers"),
    [
        ({}, True),
        ({"angle_convention": "half"}, True),
        ({"scenario": {"infeasible_zone": "shrink"}}, True),
        ({"spacecraft": {"torque_limit": (2.0, 2.0, 2.0)}}, True),
        ({"reward": {"progress_tolerance_deg": 0.01}}, True),
        ({"step_seconds": 0.2}, False),
        ({"episode_seconds": 50.0}, False),
        ({"spacecraft": {"torque_limit": 1.0}}, False),
        ({"spacecraft": {"boresight": (0.0, 0.0, 1.0)}}, False),
        ({"reward": {"settled_angle_deg": 0.5}}, False),
        ({"scenario": {"max_zones": 3}}, False),
        ({"scenario": {"max_rate_deg": 1.0}}, False),
    ],
)
def test_the_papers_numbers_are_of_its_task_only(changes, papers):
    assert is_paper_task(TaskConfig.model_validate(changes)) == papers


def test_a_constant_of_the_reward_that_came_later_is_written_only_where_it_is_set():
    class Extended(RewardConfig):
        later: ClassVar = ("nearness_cost",)

        nearness_cost: float = 0.0

    assert Extended().model_dump() == RewardConfig().model_dump()
    assert Extended(nearness_cost=0.5).model_dump() == RewardConfig().model_dump() | {"nearness_cost": 0.5}
    assert Extended.model_validate(RewardConfig().model_dump()) == Extended()
