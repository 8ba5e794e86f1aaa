"""Figures of a Monte Carlo: every case is a point, in the colour of its verdict."""

import numpy as np
import pytest
from matplotlib.collections import Collection
from matplotlib.colors import to_hex
from support.drawn import crowded_labels, outcomes

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


def labels_of(axis):
    return [label.get_text() for label in axis.get_ticklabels()]


def test_what_did_not_settle_has_a_strip_of_its_own():
    results = outcomes(500)
    shown = monte_carlo.points(results, TaskConfig())
    settled = np.asarray(results.settled)
    times = np.asarray(results.settling_time)[settled]
    np.testing.assert_array_equal(shown.settling_time[settled], times)
    (place,) = {*shown.settling_time[~settled]}
    assert times.max() < place < times.max() + 0.25 * np.ptp(times)
    samples, relations = monte_carlo.draw_samples(shown), monte_carlo.draw_relations(shown)
    for axis in (samples.axes[1].yaxis, relations.axes[0].xaxis, relations.axes[1].xaxis):
        low, high = axis.get_view_interval()
        assert low < times.min() and place < high < times.max() + 0.35 * np.ptp(times)
        ticks = dict(zip(labels_of(axis), axis.get_ticklocs(), strict=True))
        assert ticks.pop("never") == place
        assert len(ticks) > 2 and max(ticks.values()) <= times.max() + 0.1 * np.ptp(times)


def test_where_all_settle_there_is_no_strip():
    results = outcomes(500, all_settle=True)
    figure = monte_carlo.draw_samples(monte_carlo.points(results, TaskConfig()))
    times = np.asarray(results.settling_time)
    assert figure.axes[1].get_ylim()[1] < times.max() + 0.1 * np.ptp(times)
    assert "never" not in labels_of(figure.axes[1].yaxis)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effort", "all_settle"), [(1e-9, False), (3.4e-6, False), (1.0, False), (1e4, False), (1.0, True)]
)
def test_no_numbers_of_an_axis_touch(effort, all_settle):
    shown = monte_carlo.points(outcomes(300, all_settle=all_settle, effort=effort), TaskConfig())
    for figure in (monte_carlo.draw_samples(shown), monte_carlo.draw_relations(shown)):
        assert crowded_labels(figure) == []
    assert crowded_labels(monte_carlo.draw_accuracy(shown, 0.25)) == []


def test_the_legend_is_within_the_picture():
    shown = monte_carlo.points(outcomes(10_000), TaskConfig())
    assert shown.violated_unsettled
    for figure in (monte_carlo.draw_samples(shown), monte_carlo.draw_relations(shown)):
        figure.draw_without_rendering()
        box = figure.legends[0].get_window_extent()
        assert box.x0 >= 0.0 and box.x1 <= figure.bbox.x1


def test_efforts_of_a_cubesat_have_a_unit_that_suits_them():
    results = outcomes(300, effort=3.4e-6)
    figure = monte_carlo.draw_samples(monte_carlo.points(results, TaskConfig()))
    assert figure.axes[2].get_ylabel() == "control effort [(mN m)² s]"
    largest = max(offsets(cloud)[:, 1].max() for cloud in figure.axes[2].collections)
    assert largest == pytest.approx(1e6 * np.max(results.control_effort))


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


@pytest.mark.slow
def test_one_case_can_be_drawn():
    lost = outcomes(1).replace(settled=np.array([False]), settling_time=np.array([np.nan]))
    shown = monte_carlo.points(lost, TaskConfig())
    for figure in (
        monte_carlo.draw_samples(shown),
        monte_carlo.draw_relations(shown),
        monte_carlo.draw_accuracy(shown, 0.25),
    ):
        figure.draw_without_rendering()
