"""Settings of the shield, also as older versions wrote them."""

import json

import pytest
from pydantic import ValidationError

from koz_jax.config.filters import ZohCbfConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.uncertainty import CERTAIN, UncertaintyConfig
from koz_jax.errors import SettingsError, explain

ERRORS = UncertaintyConfig(inertia_error=0.1, disturbance_torque=0.01)


def test_the_older_name_of_the_error_bounds_is_read():
    """Runs and agents of before say ``withstands``; what is written says ``error_bounds``."""
    old = json.dumps({"margin_deg": 0.2, "withstands": ERRORS.model_dump(), "guide_rate_deg": 6.0, "samples": 12})
    read = ShieldConfig.model_validate_json(old)
    assert read == ShieldConfig(margin_deg=0.2, error_bounds=ERRORS, guide_rate_deg=6.0)
    written = json.loads(read.model_dump_json())
    assert "withstands" not in written and written["error_bounds"] == ERRORS.model_dump()
    assert ShieldConfig.model_validate(written) == read


def test_without_error_bounds_nothing_is_withstood():
    assert ShieldConfig().error_bounds == CERTAIN == UncertaintyConfig()


@pytest.mark.parametrize("name", ["error_bounds", "withstands"])
def test_error_bounds_are_checked_under_either_name(name):
    with pytest.raises(ValidationError) as caught:
        ShieldConfig.model_validate({name: {"inertia_error": 1.5}})
    assert f"{name}.inertia_error: Input should be less than 1 (got 1.5)" in explain(caught.value)


@pytest.mark.parametrize("limits", [(2.0, 2.0, 2.0), (3.0, 2.0, 5.0)])
def test_a_disturbance_must_be_weaker_than_half_of_the_weakest_axis(limits):
    """Weaker than half of it: with more, bodies were found that were pushed into a zone."""
    ShieldConfig(error_bounds=UncertaintyConfig(disturbance_torque=0.99)).check(limits)
    for torque in (1.0, 2.5):
        strong = ShieldConfig(error_bounds=UncertaintyConfig(disturbance_torque=torque))
        with pytest.raises(SettingsError, match=rf"disturbance_torque: must be below .* 2\.0 N m .*, got {torque}"):
            strong.check(limits)


def test_a_delay_is_not_withstood_and_refused_by_name():
    with pytest.raises(ValidationError) as caught:
        ShieldConfig(error_bounds=UncertaintyConfig(delay_steps=1))
    assert "delay_steps: the shield does not withstand a delay; allowed is 0, got 1" in explain(caught.value)


def test_the_other_filter_refuses_what_it_has_no_torque_for():
    with pytest.raises(
        SettingsError, match=r"disturbance_torque: must be below the torque limit of 1\.0 N m.*got 1\.0"
    ):
        ZohCbfConfig(disturbance_torque=1.0).check((2.0, 1.0, 2.0))
    with pytest.raises(SettingsError, match=r"zoh_cbf\.cone_rate_deg: must be at least 0\.5, .* got 0\.1"):
        ZohCbfConfig(cone_rate_deg=0.1).check_cones(0.5)
    with pytest.raises(ValueError, match="samples: must be at least 100, got 99"):
        ZohCbfConfig(samples=99)
