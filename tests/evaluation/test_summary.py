import dataclasses
import math
import re
from typing import Any

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from support import tiny

from koz_jax.evaluation import summary
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.evaluation.summary import PAPER_TABLE, Summary, summarise, table, wilson_interval
from koz_jax.task.reward import RewardTerms

# Terms that the paper's reward does not have.
OURS = ("effort", "intervention")
TERMS = [field.name for field in dataclasses.fields(RewardTerms)]


def _results(settled: np.ndarray, violated: np.ndarray, seed: int = 0) -> CaseResult:
    rng = np.random.default_rng(seed)
    count = len(settled)
    # Results on the host have NumPy leaves, where the declared fields are jax's.
    terms: dict[str, Any] = {name: rng.normal(scale=100.0, size=count).astype(np.float32) for name in TERMS}
    leaves: dict[str, Any] = dict(
        initial_angle=rng.uniform(1.4, 3.1, count).astype(np.float32),
        settling_time=np.where(settled, rng.uniform(15.0, 40.0, count), np.nan).astype(np.float32),
        control_effort=rng.uniform(20.0, 120.0, count).astype(np.float32),
        control_accuracy=np.deg2rad(np.where(settled, rng.uniform(0.0, 0.25, count), 50.0)).astype(np.float32),
        min_margin=np.where(violated, -0.01, 0.1).astype(np.float32),
        settled=settled,
        violated=violated,
        **tiny.unshielded(count),
    )
    return CaseResult(reward_terms=RewardTerms(**terms), **leaves)


@pytest.fixture(scope="module")
def mixed() -> CaseResult:
    """200 cases with all four combinations of settled and violated."""
    rng = np.random.default_rng(1)
    return _results(rng.random(200) < 0.9, rng.random(200) < 0.2)


def _paper_reward(results: CaseResult) -> np.ndarray:
    paid = [np.asarray(getattr(results.reward_terms, name), np.float64) for name in TERMS if name not in OURS]
    return np.sum(paid, axis=0)


def test_reward_is_over_all_cases_and_without_the_terms_that_the_paper_has_not(mixed):
    found = summarise(mixed)
    assert found.mean_reward == pytest.approx(np.mean(_paper_reward(mixed)), rel=1e-5)
    assert found.std_reward == pytest.approx(np.std(_paper_reward(mixed)), rel=1e-5)


def test_time_effort_and_accuracy_are_over_settled_cases_only(mixed):
    found = summarise(mixed)
    for name, values in (
        ("settling_time", mixed.settling_time),
        ("control_effort", mixed.control_effort),
        ("control_accuracy_deg", np.rad2deg(mixed.control_accuracy)),
    ):
        chosen = values[mixed.settled].astype(np.float64)
        assert getattr(found, f"{name}_mean") == pytest.approx(chosen.mean(), rel=1e-6)
        assert getattr(found, f"{name}_std") == pytest.approx(chosen.std(), rel=1e-5)


def test_rates_are_shares_of_all_cases(mixed):
    found = summarise(mixed)
    cases = list(zip(mixed.settled.tolist(), mixed.violated.tolist(), strict=True))
    assert len(set(cases)) == 4
    assert found.non_settled_rate == pytest.approx(sum(not s for s, _ in cases) / 200)
    assert found.violation_rate == pytest.approx(sum(v for _, v in cases) / 200)
    assert found.success_rate == pytest.approx(sum(s and not v for s, v in cases) / 200)


def test_a_case_that_fails_twice_is_a_failure_once():
    found = summarise(_results(np.array([True, True, False, False]), np.array([False, True, False, True])))
    assert (found.success_rate, found.non_settled_rate, found.violation_rate) == (0.25, 0.5, 0.5)


def test_order_of_the_cases_does_not_matter(mixed):
    order = np.random.default_rng(2).permutation(200)
    shuffled = jax.tree.map(lambda leaf: leaf[order], mixed)
    assert vars(summarise(shuffled)) == pytest.approx(vars(summarise(mixed)), rel=1e-6)


def test_without_a_settled_case_the_settled_rows_are_nan_and_the_others_are_not():
    found = summarise(_results(np.zeros(5, bool), np.ones(5, bool)))
    undefined = {name for name, value in vars(found).items() if math.isnan(value)}
    assert undefined == {
        f"{row}_{part}"
        for row in ("settling_time", "control_effort", "control_accuracy_deg")
        for part in ("mean", "std")
    }
    assert found.non_settled_rate == 1.0
    assert found.success_rate == 0.0


def test_a_single_case_has_no_spread():
    found = summarise(_results(np.array([True]), np.array([False])))
    assert (found.std_reward, found.settling_time_std, found.control_effort_std) == (0.0, 0.0, 0.0)
    assert found.success_rate == 1.0


def test_means_of_many_cases_keep_their_digits():
    """Summed in float32, 10,000 rewards of 7,500 would lose the last printed digit."""
    count = 10_000
    results = _results(np.ones(count, bool), np.zeros(count, bool))
    terms = jax.tree.map(np.zeros_like, results.reward_terms).replace(settled=np.full(count, 7543.21, np.float32))
    found = summarise(results.replace(reward_terms=terms))
    assert found.mean_reward == pytest.approx(float(np.float32(7543.21)), abs=1e-6)
    assert found.std_reward == pytest.approx(0.0, abs=1e-6)


@given(st.integers(1, 20_000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_interval_agrees_with_scipy(counts):
    successes, cases = counts
    low, high = wilson_interval(successes / cases, cases)
    expected = stats.binomtest(successes, cases).proportion_ci(0.95, "wilson")
    assert low == pytest.approx(expected.low, abs=1e-6)
    assert high == pytest.approx(expected.high, abs=1e-6)


@given(st.integers(1, 20_000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_interval_holds_the_rate_and_mirrors_that_of_the_complement(counts):
    rate, cases = counts[0] / counts[1], counts[1]
    low, high = wilson_interval(rate, cases)
    assert 0.0 <= low <= rate + 1e-12
    assert rate - 1e-12 <= high <= 1.0
    other_low, other_high = wilson_interval(1.0 - rate, cases)
    assert (1.0 - other_high, 1.0 - other_low) == pytest.approx((low, high), abs=1e-9)


def test_wilson_interval_is_honest_at_none_of_n():
    assert wilson_interval(0.0, 1000)[0] == pytest.approx(0.0, abs=1e-15)
    assert 0.003 < wilson_interval(0.0, 1000)[1] < 0.004


def test_wilson_interval_narrows_with_the_number_of_cases():
    widths = [high - low for low, high in (wilson_interval(0.03, n) for n in (10, 100, 1000, 10_000))]
    assert widths == sorted(widths, reverse=True)


# The printed table


def _cells(text: str) -> dict[str, list[str]]:
    rows = [re.split(r"  +", line.strip()) for line in text.splitlines() if not line.startswith(("-", "*"))]
    return {row[0]: row[1:] for row in rows}


@pytest.fixture(scope="module")
def ours() -> Summary:
    values = np.array([7495.123, 412.345, 19.512, 2.216, 82.951, 11.127, 0.02912, 0.01234, 0.0011, 0.0052, 0.9937])
    return Summary(*values.tolist())


def test_table_prints_every_number_of_the_summary(ours):
    rows = _cells(table(ours, 10_000, "mine"))
    printed = {
        "mean reward": (7495.12, 412.35),
        "settling time* [s]": (19.51, 2.22),
        "control effort* [N2 m2 s]": (82.95, 11.13),
        "control accuracy* [deg]": (0.0291, 0.0123),
    }
    for label, numbers in printed.items():
        found = [float(x) for x in rows[label][1].split(" +- ")]
        assert found == pytest.approx(numbers, abs=1e-2 if numbers[0] > 1 else 1e-4)
    for label, rate in (("not settled", 0.0011), ("violated", 0.0052), ("success", 0.9937)):
        share, bounds = " ".join(rows[label][1:]).removesuffix("]").split(" % [")
        assert float(share) == pytest.approx(100 * rate, abs=5e-3)
        expected = stats.binomtest(round(rate * 10_000), 10_000).proportion_ci(0.95, "wilson")
        assert [float(x) for x in bounds.split(",")] == pytest.approx(
            [100 * expected.low, 100 * expected.high], abs=6e-3
        )


def test_table_has_the_numbers_of_the_paper_beside_ours(ours):
    rows = _cells(table(ours, 10_000, "mine"))
    assert {label: cells[0] for label, cells in rows.items() if not label.endswith("cases")} == {
        "mean reward": "7281.91 +- 688.85",
        "settling time* [s]": "27.81 +- 5.24",
        "control effort* [N2 m2 s]": "76.02 +- 25.76",
        "control accuracy* [deg]": "0.08 +- 0.04",
        "not settled": "0.32 %",
        "violated": "2.66 %",
        "success": "97 %",
        "smallest margin [deg]": "-",
    }


def test_table_names_the_number_of_cases_and_the_agent(ours):
    assert _cells(table(ours, 123, "mine"))["123 cases"] == ["paper", "mine"]


def test_columns_of_the_table_are_aligned(ours):
    lines = [line for line in table(ours, 10_000, "mine").splitlines() if not line.startswith(("-", "*"))]
    assert len({next(re.finditer(r"(?<=  )\S", line)).start() for line in lines}) == 1


def test_table_without_a_settled_case_says_nan_rather_than_a_number():
    rows = _cells(table(summarise(_results(np.zeros(5, bool), np.ones(5, bool))), 5, "mine"))
    assert rows["settling time* [s]"][1] == "nan +- nan"


def test_rates_of_the_paper_agree_with_its_success():
    assert PAPER_TABLE.success_rate == pytest.approx(
        1.0 - PAPER_TABLE.non_settled_rate - PAPER_TABLE.violation_rate, abs=5e-3
    )
    assert summary.PAPER_TABLE.mean_reward == 7281.91


def test_small_numbers_show_their_digits(ours):
    """A CubeSat's effort is not zero."""
    small = dataclasses.replace(
        ours, control_effort_mean=2.13e-4, control_effort_std=0.00451, mean_torque_change=3.1e-5, intervention_rate=1e-3
    )
    rows = _cells(table(small, 10_000, "mine"))
    assert rows["control effort* [N2 m2 s]"][1] == "0.000213 +- 0.00451"
    assert rows["mean change of torque [N m]"][1] == "0.0000310"


def test_starts_that_the_shield_does_not_cover_have_a_row(ours):
    rows = _cells(table(dataclasses.replace(ours, unsafe_start_rate=0.061), 10_000, "mine", shielded=True))
    assert rows["start not covered by the shield"] == ["-", "6.10 %"]
    assert "start not covered by the shield" not in _cells(table(ours, 10_000, "mine", shielded=False))


def test_the_papers_column_can_be_left_out(ours):
    text = table(ours, 10_000, "mine", paper=False)
    assert "paper" not in text and "7281.91" not in text
    assert _cells(text)["mean reward"] == ["7495.12 +- 412.35"]


def test_steps_without_a_solution_have_rows_where_there_are_some(ours):
    rows = _cells(
        table(dataclasses.replace(ours, infeasible_steps_mean=0.25, infeasible_case_rate=0.01), 10_000, "mine")
    )
    assert rows["steps without a solution, per case"] == ["-", "0.250"]
    assert rows["cases with such a step"] == ["-", "1.00 %"]
    assert "cases with such a step" not in _cells(table(ours, 10_000, "mine"))


def test_steps_without_a_solution_are_counted(mixed):
    steps = np.array([0, 3, *[0] * 197, 5], np.int32)
    found = summarise(mixed.replace(infeasible_steps=steps))
    assert (found.infeasible_steps_mean, found.infeasible_case_rate) == (8 / 200, 2 / 200)
