"""Numbers for people: of any size they show their digits."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from koz_jax.evaluation.digits import percent, percent_between, significant


@pytest.mark.parametrize(
    ("value", "decimals", "shown"),
    [
        (7281.91, 2, "7281.91"),
        (27.81, 2, "27.81"),
        (76.02, 0, "76.0"),
        (0.0291, 4, "0.0291"),
        (0.00213, 2, "0.00213"),
        (-0.0617, 3, "-0.0617"),
        (0.000008, 2, "8.00e-06"),
        (2.5e-5, 2, "0.0000250"),
        (1.2e9, 2, "1.20e+09"),
        (0.0, 2, "0.00"),
        (math.nan, 2, "nan"),
        (math.inf, 2, "inf"),
    ],
)
def test_ordinary_sizes_keep_their_decimals_and_others_get_digits(value, decimals, shown):
    assert significant(value, decimals) == shown


@given(st.floats(1e-12, 1e12), st.sampled_from([-1.0, 1.0]), st.integers(0, 4))
def test_any_size_is_shown_to_three_digits(size, sign, decimals):
    assert float(significant(sign * size, decimals)) == pytest.approx(sign * size, rel=5.1e-3)


@pytest.mark.parametrize(
    ("rate", "shown"), [(0.0, "0.00 %"), (0.0266, "2.66 %"), (1.0, "100.00 %"), (1e-6, "0.0001 %"), (3e-5, "0.003 %")]
)
def test_a_share_that_is_not_zero_does_not_look_like_it(rate, shown):
    assert percent(rate) == shown


def test_an_interval_has_the_decimals_of_its_share():
    assert percent_between(0.0011, 0.0006, 0.002) == "0.11 %  [0.06, 0.20]"
    assert percent_between(0.0, 0.0, 3.8e-4) == "0.00 %  [0.00, 0.04]"
    assert percent_between(0.0, 0.0, 3.8e-6) == "0.0000 %  [0.0000, 0.0004]"
