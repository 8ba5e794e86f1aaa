"""Settings of a Monte Carlo evaluation: refused by name, and read back as they were."""

import math

import pytest
from pydantic import ValidationError

from koz_jax.config.base import checked
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.errors import SettingsError


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"cases": 0}, ["cases: ", "greater than 0", "got 0"]),
        ({"cases": -3}, ["cases: ", "greater than 0", "got -3"]),
        ({"cases": 2**31}, ["cases: ", "less than 2147483648", "got 2147483648"]),
        ({"cases": 1.5}, ["cases: ", "integer", "got 1.5"]),
        ({"seed": -1}, ["seed: ", "greater than or equal to 0", "got -1"]),
        ({"seed": 2**32}, ["seed: ", "less than 4294967296", "got 4294967296"]),
        ({"substeps": 0}, ["substeps: ", "greater than 0", "got 0"]),
        ({"substeps": 101}, ["substeps: ", "less than or equal to 100", "got 101"]),
        ({"first": -1}, ["first: ", "greater than or equal to 0", "got -1"]),
        ({"first": 2**31 - 5, "cases": 6}, ["first must be from 0 to 2^31 - cases = 2147483642", "got 2147483643"]),
        ({"min_angle_deg": -1.0}, ["min_angle_deg: ", "greater than or equal to 0", "got -1.0"]),
        ({"min_angle_deg": math.nan}, ["min_angle_deg: ", "finite", "got nan"]),
        ({"max_angle_deg": math.inf}, ["max_angle_deg: ", "finite", "got inf"]),
        ({"max_angle_deg": 181.0}, ["max_angle_deg: ", "less than or equal to 180", "got 181.0"]),
        ({"max_angle_deg": 79.0}, ["max_angle_deg must be in [min_angle_deg = 80.0, 180]", "got 79.0"]),
        ({"shield": {"margin_deg": 0.0}}, ["shield.margin_deg: ", "greater than 0", "got 0.0"]),
        ({"uncertainty": {"inertia_error": 1.0}}, ["uncertainty.inertia_error: ", "less than 1", "got 1.0"]),
        ({"colour": "red"}, ["colour: ", "not permitted", "red"]),
    ],
    ids=str,
)
def test_what_cannot_be_flown_is_refused_by_name_and_value(fields, words):
    with pytest.raises(SettingsError) as caught:
        checked(MonteCarloConfig, **fields)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    for word in words:
        assert word in message
    with pytest.raises(ValidationError):
        MonteCarloConfig(**fields)


def test_what_can_be_flown_is_allowed_up_to_its_bounds():
    checked(MonteCarloConfig, cases=2**31 - 1)
    checked(MonteCarloConfig, cases=1, first=2**31 - 1)
    checked(MonteCarloConfig, seed=2**32 - 1, substeps=100)
    checked(MonteCarloConfig, min_angle_deg=0.0, max_angle_deg=0.0)
    checked(MonteCarloConfig, min_angle_deg=180.0)


def test_the_defaults_are_the_draw_of_the_paper():
    assert MonteCarloConfig().model_dump() == {
        "cases": 10_000,
        "seed": 0,
        "min_angle_deg": 80.0,
        "max_angle_deg": 180.0,
        "substeps": 1,
        "shield": None,
        "uncertainty": None,
        "first": 0,
    }


def test_fields_are_given_by_name():
    with pytest.raises(TypeError):
        MonteCarloConfig(100)  # pyright: ignore[reportCallIssue]


def test_json_round_trip():
    errors = UncertaintyConfig(inertia_error=0.1)
    config = MonteCarloConfig(cases=5, shield=ShieldConfig(error_bounds=errors), uncertainty=errors)
    assert MonteCarloConfig.model_validate_json(config.model_dump_json()) == config
    assert hash(MonteCarloConfig.model_validate_json(config.model_dump_json())) == hash(config)
