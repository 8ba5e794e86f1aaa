"""Results as text."""

import csv
import io

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny

import koz_jax
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.evaluation import cases, tables
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.evaluation.summary import summarise
from koz_jax.task.reward import PAPER_WEIGHTS

AGENT = tiny.untrained_agent()


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


@pytest.mark.slow
def test_a_history_is_a_row_per_instant():
    history, result = cases.fly_case(AGENT, 0, MonteCarloConfig(cases=tiny.CASES, seed=3))
    rows = list(csv.DictReader(io.StringIO(tables.history_csv(history, AGENT.task))))
    assert len(rows) == AGENT.task.episode_steps + 1
    assert (float(rows[0]["time_s"]), float(rows[-1]["time_s"])) == (0.0, pytest.approx(2.0))
    assert float(rows[-1]["phi_deg"]) == pytest.approx(np.rad2deg(float(result.control_accuracy)), rel=1e-4)
    assert float(rows[0]["phi_deg"]) == pytest.approx(np.rad2deg(float(result.initial_angle)), rel=1e-4)
    quaternion = np.array([[float(row[f"q_e{i}"]) for i in range(4)] for row in rows])
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0, atol=1e-6)
    assert "case 0:" in tables.describe_case(0, result) and "not settled" in tables.describe_case(0, result)


def test_where_there_is_no_zone_none_is_spoken_of():
    flown, absent = (koz_jax.maneuver((0.5, 0.5, 0.5, 0.5), zones=zones) for zones in ([((0, 0, -1), 20.0)], []))
    for drawn, words in ((flown, "the zone (smallest margin "), (absent, "settled, no zone, effort ")):
        _, result = cases.fly_scenario(AGENT, drawn)
        told = tables.describe_result(result)
        assert words in told and ("margin" in told) == (drawn is flown)
