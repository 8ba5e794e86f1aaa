"""The Monte Carlo: a case is its index, whatever flies beside it; and the reports say what was flown."""

import csv
import io
import json
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from koz_jax import evaluation, storage, tables
from koz_jax.errors import UserError
from koz_jax.evaluation import MonteCarlo, MonteCarloConfig, monte_carlo
from koz_jax.reward import PAPER_WEIGHTS
from koz_jax.rollout import CaseResult
from koz_jax.scenario import Scenario
from koz_jax.summary import summarise
from koz_jax.task_config import TaskConfig

REPORT_KEYS = [
    "cases",
    "seed",
    "agent",
    "mean_reward",
    "std_reward",
    "settling_time_mean",
    "settling_time_std",
    "control_effort_mean",
    "control_effort_std",
    "control_accuracy_deg_mean",
    "control_accuracy_deg_std",
    "non_settled_rate",
    "violation_rate",
    "success_rate",
    "min_margin_deg",
    "intervention_rate",
    "mean_torque_change",
    "deadlock_rate",
    "compile_s",
    "wall_s",
]

AGENT = tiny.untrained_agent()
CASES = tiny.CASES
SEED = 3
BORESIGHT_B = jnp.array(AGENT.task.spacecraft.boresight)


@pytest.fixture(scope="module")
def flown() -> MonteCarlo:
    """All cases in one call."""
    return monte_carlo(AGENT, CASES, SEED)


def assert_same_cases(found: CaseResult, expected: CaseResult) -> None:
    """Equal to the rounding of float32, the scenarios and the judgements exactly."""
    for name in ("initial_angle", "settled", "violated"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=2e-4, atol=2e-5), found, expected)


def first(results: CaseResult, count: int) -> CaseResult:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:count], results)


@jax.jit
def together(draw: evaluation._Draw, cases: jax.Array) -> Scenario:
    return jax.vmap(lambda case: draw.case(case, BORESIGHT_B))(cases)


@jax.jit
def alone(draw: evaluation._Draw, case: jax.Array) -> Scenario:
    return draw.case(case, BORESIGHT_B)


def draws(*cases: int, **options: Any) -> Scenario:
    """Four scenarios."""
    return together(evaluation._draw(AGENT.task, MonteCarloConfig(CASES, **options)), jnp.array(cases))


def test_a_scenario_is_its_index_and_its_seed():
    found = draws(0, 7, 11, 123_456, seed=SEED)
    for row, case in enumerate((0, 7, 11, 123_456)):
        config = MonteCarloConfig(case + 1, SEED)
        one = alone(evaluation._draw(AGENT.task, config), jnp.int32(case))
        jax.tree.map(lambda x, y, row=row: np.testing.assert_array_equal(np.asarray(x)[row], y), found, one)
    other_neighbours = draws(11, 11, 5, 0, seed=SEED)
    np.testing.assert_array_equal(other_neighbours.initial.q_BN[0], found.initial.q_BN[2])
    np.testing.assert_array_equal(other_neighbours.initial.q_BN[3], found.initial.q_BN[0])


def test_cases_differ_and_seeds_differ():
    found = draws(0, 1, 2, 3, seed=0).initial.q_BN
    others = draws(0, 1, 2, 3, seed=1).initial.q_BN
    far = draws(0, 1, 2, 3, seed=2**32 - 1).initial.q_BN
    assert len(np.unique(np.concatenate([found, others, far])[:, 0])) == 12


def test_neither_the_number_of_cases_nor_the_chunk_size_matters(flown, monkeypatch):
    monkeypatch.setattr(evaluation, "_CHUNK", 4)
    # No other test flies 11 cases here, so this compiles with the new size: 11 = 4 + 4 + 3.
    assert_same_cases(monte_carlo(AGENT, 11, SEED).results, first(flown.results, 11))


def test_the_number_of_devices_does_not_matter(flown, tmp_path):
    code = (
        "import sys, numpy as np, jax\n"
        "jax.config.update('jax_num_cpu_devices', 2)\n"
        "sys.path.insert(0, 'tests')\n"
        "import tiny\n"
        "from koz_jax import evaluation, storage\n"
        "assert jax.local_device_count() == 2\n"
        f"results = evaluation.monte_carlo(tiny.untrained_agent(), {CASES - 1}, {SEED}).results\n"
        "from pathlib import Path\n"
        f"storage.save_tree(Path({str(tmp_path / 'results')!r}), results, {{}})\n"
    )
    done = tiny.run_python("-c", code)
    assert done.returncode == 0, done.stderr
    # An odd number of cases: the second device flies one that is dropped.
    expected = first(flown.results, CASES - 1)
    assert_same_cases(storage.load_tree(tmp_path / "results", expected), expected)


def test_one_case_flown_again_ends_like_its_row(flown):
    for case in (0, 9):
        history, result = evaluation.fly_case(AGENT, case, flown.config)
        row = jax.tree.map(lambda leaf, case=case: np.asarray(leaf)[case], flown.results)
        assert_same_cases(result, row)
        steps = AGENT.task.episode_steps
        assert history.torque_B.shape == (steps + 1, 3)
        np.testing.assert_allclose(history.pointing_error[-1], row.control_accuracy, rtol=1e-4)
        np.testing.assert_allclose(np.min(history.zone_margin), row.min_margin, rtol=1e-4, atol=1e-6)
        effort = np.sum(np.asarray(history.torque_B[:-1], np.float64) ** 2) * AGENT.task.step_seconds
        np.testing.assert_allclose(effort, row.control_effort, rtol=1e-4)


def test_the_angle_convention_reaches_the_judgement(flown):
    halved = evaluation.run_cases(AGENT, AGENT.task.with_rules("half", None), flown.config).results
    np.testing.assert_allclose(halved.control_accuracy, 0.5 * np.asarray(flown.results.control_accuracy), rtol=1e-6)
    np.testing.assert_array_equal(halved.initial_angle, flown.results.initial_angle)  # the full angle, always


def test_substeps_reach_the_flight(monkeypatch):
    def seen(*arguments: Any) -> None:
        raise InterruptedError(arguments[3:5])

    monkeypatch.setattr(evaluation.rollout, "run_case", seen)
    with pytest.raises(InterruptedError, match=r"\(20, 3\)"):
        monte_carlo(AGENT, CASES, SEED, substeps=3)
    with pytest.raises(InterruptedError, match=r"\(20, 4\)"):
        evaluation.fly_case(AGENT, 0, MonteCarloConfig(CASES, SEED, substeps=4))


def test_other_seeds_ranges_and_weights_do_not_compile_again(flown, monkeypatch):
    monkeypatch.setattr(evaluation.rollout, "run_case", lambda *_: pytest.fail("was traced again"))
    again = [
        monte_carlo(AGENT, CASES, SEED),
        monte_carlo(AGENT, CASES, SEED + 1),
        monte_carlo(AGENT, CASES, SEED, min_angle_deg=100.0),
        monte_carlo(tiny.untrained_agent(1), CASES, SEED),
    ]
    assert len({float(run.results.initial_angle[0]) for run in again}) == 3


def test_the_range_of_deviations_is_kept(flown):
    degrees = np.rad2deg(flown.results.initial_angle)
    assert np.all((degrees > 80) & (degrees < 180))
    q_e0 = np.asarray(draws(0, 1, 2, 3, min_angle_deg=100.0, max_angle_deg=101.0).initial.q_BN)[:, 0]
    assert np.all(np.abs(2 * np.rad2deg(np.arccos(np.abs(q_e0))) - 100.5) < 0.51)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"cases": 0}, "cases: must be from 1 to 2^31 - 1, got 0"),
        ({"cases": -3}, "cases: must be from 1 to 2^31 - 1, got -3"),
        ({"cases": 2**31}, "cases: must be from 1 to 2^31 - 1, got 2147483648"),
        ({"seed": -1}, "seed: must be from 0 to 2^32 - 1, got -1"),
        ({"seed": 2**32}, "seed: must be from 0 to 2^32 - 1, got 4294967296"),
        ({"substeps": 0}, "substeps: must be from 1 to 100, got 0"),
        ({"min_angle_deg": -1.0}, "min_angle_deg: must be in [0, 180], got -1.0"),
        ({"min_angle_deg": math.nan}, "min_angle_deg: must be in [0, 180], got nan"),
        ({"max_angle_deg": math.inf}, "max_angle_deg: must be in [min_angle_deg = 80.0, 180], got inf"),
        ({"max_angle_deg": 79.0}, "max_angle_deg: must be in [min_angle_deg = 80.0, 180], got 79.0"),
    ],
)
def test_what_cannot_be_flown_is_refused(fields, message):
    with pytest.raises(UserError) as caught:
        MonteCarloConfig(**fields)
    assert str(caught.value) == message
    with pytest.raises(UserError):
        monte_carlo(AGENT, **fields)


@pytest.mark.parametrize("case", [-1, CASES])
def test_a_case_outside_the_draw_is_refused(flown, case):
    with pytest.raises(UserError, match=f"case: must be from 0 to cases - 1 = 11, got {case}"):
        evaluation.fly_case(AGENT, case, flown.config)


def test_a_range_without_room_for_a_zone_is_refused():
    with pytest.raises(UserError, match=r"max_angle_deg: must be above 34 deg.*got 34"):
        monte_carlo(AGENT, 3, min_angle_deg=10.0, max_angle_deg=34.0)
    evaluation.check_feasible(TaskConfig(), 34.1)
    evaluation.check_feasible(TaskConfig().with_rules(None, "shrink"), 10.0)


def test_the_report_has_the_documented_keys_in_order(flown):
    summary = summarise(flown.results)
    report = evaluation.report(flown, summary)
    assert list(report) == REPORT_KEYS
    assert (report["cases"], report["seed"], report["agent"]) == (CASES, SEED, "untrained")
    for name, value in vars(summary).items():
        assert report[name] == value or (report[name] is None and math.isnan(value))
    assert isinstance(report["wall_s"], float) and report["wall_s"] > 0
    assert isinstance(report["compile_s"], float) and report["compile_s"] > 0
    # Two seconds are too short to settle: there is no settling time, and JSON has no nan.
    assert report["non_settled_rate"] == 1.0 and report["settling_time_mean"] is None
    assert json.loads(json.dumps(report, allow_nan=False)) == report


def test_the_table_of_cases_agrees_with_the_summary():
    results = _results(50)
    rows = list(csv.DictReader(io.StringIO(tables.cases_csv(results))))
    assert [int(row["case"]) for row in rows] == list(range(50))
    column = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    settled = column["settled"] == 1
    assert 0 < settled.sum() < 50
    np.testing.assert_array_equal(np.isnan(column["settling_time_s"]), ~settled)
    summary = summarise(results)
    for found, expected in [
        (column["reward"].mean(), summary.mean_reward),
        (column["reward"].std(), summary.std_reward),
        (column["settling_time_s"][settled].mean(), summary.settling_time_mean),
        (column["control_effort_N2m2s"][settled].std(), summary.control_effort_std),
        (column["control_accuracy_deg"][settled].mean(), summary.control_accuracy_deg_mean),
        (1 - column["settled"].mean(), summary.non_settled_rate),
        (column["violated"].mean(), summary.violation_rate),
        ((settled & (column["violated"] == 0)).mean(), summary.success_rate),
        ((column["min_margin_deg"] <= 0).mean(), summary.violation_rate),
    ]:
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def _results(cases: int) -> CaseResult:
    """Made-up outcomes, settled and not."""
    draw = np.random.default_rng(0)
    settled = draw.random(cases) < 0.7
    margin = draw.normal(size=cases).astype(np.float32)
    terms = jax.tree.map(lambda _: jnp.asarray(draw.normal(size=cases), jnp.float32), PAPER_WEIGHTS)
    return CaseResult(
        initial_angle=jnp.asarray(draw.random(cases)),
        reward_terms=terms,
        settling_time=jnp.asarray(np.where(settled, draw.random(cases), np.nan)),
        control_effort=jnp.asarray(draw.random(cases)),
        control_accuracy=jnp.asarray(draw.random(cases)),
        min_margin=jnp.asarray(margin),
        settled=jnp.asarray(settled),
        violated=jnp.asarray(margin <= 0),
        **tiny.unshielded(cases),
    )


def test_a_history_is_a_row_per_instant(flown):
    history, result = evaluation.fly_case(AGENT, 0, flown.config)
    rows = list(csv.DictReader(io.StringIO(tables.history_csv(history, AGENT.task))))
    assert len(rows) == AGENT.task.episode_steps + 1
    assert (float(rows[0]["time_s"]), float(rows[-1]["time_s"])) == (0.0, pytest.approx(2.0))
    assert float(rows[-1]["phi_deg"]) == pytest.approx(np.rad2deg(float(result.control_accuracy)), rel=1e-4)
    assert float(rows[0]["phi_deg"]) == pytest.approx(np.rad2deg(float(result.initial_angle)), rel=1e-4)
    quaternion = np.array([[float(row[f"q_e{i}"]) for i in range(4)] for row in rows])
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, atol=1e-6)
    assert "case 0:" in tables.describe_case(0, result) and "not settled" in tables.describe_case(0, result)
