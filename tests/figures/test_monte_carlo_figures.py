"""Figures of a Monte Carlo: every case is a point, in the colour of its verdict."""

import numpy as np
import pytest
from matplotlib.collections import Collection
from matplotlib.colors import to_hex
from support.drawn import outcomes

from koz_jax.config.task import TaskConfig
from koz_jax.figures import monte_carlo
from koz_jax.figures.monte_carlo import NOT_SETTLED, SETTLED, VERDICTS, VIOLATED

SCATTER_LIMIT = 3_000_000  # bytes


def offsets(cloud: Collection) -> np.ndarray:
    """Points of a scatter, (points, 2)."""
    return np.array(cloud.get_offsets())


def test_cases_are_coloured_by_verdict():
    results = outcomes(500)
    shown = monte_carlo.points(results, TaskConfig())
    settled, violated = np.asarray(results.settled), np.asarray(results.violated)
    wanted = {SETTLED: settled & ~violated, VIOLATED: violated, NOT_SETTLED: ~settled & ~violated}
    figure = monte_carlo.draw_samples(shown)
    for axes, values in zip(figure.axes, (results.reward, shown.settling_time, results.control_effort), strict=True):
        clouds = {to_hex(np.array(cloud.get_facecolor())[0]).upper(): cloud for cloud in axes.collections}
        for verdict, cases in wanted.items():
            expected = np.stack([np.flatnonzero(cases), np.asarray(values)[cases]], axis=1)
            np.testing.assert_allclose(offsets(clouds[verdict.color]), expected)
    assert len({verdict.color for verdict in VERDICTS}) == len({verdict.marker for verdict in VERDICTS}) == 3
    text = figure.legends[0].get_texts()[1].get_text()
    assert text.startswith(f"zone violated: {violated.sum()} ({violated.mean() * 100:.2f} %)")
    assert f"{(violated & ~settled).sum()} of them not settled" in text


def test_what_did_not_settle_is_drawn_at_200_s():
    results = outcomes(500)
    shown = monte_carlo.points(results, TaskConfig())
    settled = np.asarray(results.settled)
    np.testing.assert_array_equal(shown.settling_time[~settled], 200.0)
    np.testing.assert_array_equal(shown.settling_time[settled], np.asarray(results.settling_time)[settled])
    assert "did not settle: drawn at 200 s" in monte_carlo.draw_samples(shown).axes[1].texts[0].get_text()


def test_the_accuracy_of_settled_cases_stands_alone():
    shown = monte_carlo.points(outcomes(500), TaskConfig())
    everything, settled_only = monte_carlo.draw_accuracy(shown, 0.25).axes
    counts = [sum(map(len, map(offsets, axes.collections))) for axes in (everything, settled_only)]
    assert counts == [500, shown.settled.sum()]


@pytest.mark.slow
def test_ten_thousand_cases_make_small_figures(tmp_path):
    files = monte_carlo.write(tmp_path, outcomes(10_000), TaskConfig(), "a title")
    assert sorted(path.suffix for path in files) == [".pdf"] * 3 + [".png"] * 3
    for path in files:
        assert 5_000 < path.stat().st_size <= SCATTER_LIMIT


def test_one_case_can_be_drawn():
    lost = outcomes(1).replace(settled=np.array([False]), settling_time=np.array([np.nan]))
    shown = monte_carlo.points(lost, TaskConfig())
    for figure in (
        monte_carlo.draw_samples(shown),
        monte_carlo.draw_relations(shown),
        monte_carlo.draw_accuracy(shown, 0.25),
    ):
        figure.draw_without_rendering()
