"""Learning curves: the values of every run, at common instants; and logs that cannot be drawn."""

import numpy as np
import pytest
from support import tiny
from support.drawn import crowded_labels, metrics_log

from koz_jax.config.presets.named import preset
from koz_jax.figures import learning


def test_curves_keep_the_values_of_every_run(tmp_path):
    logs = [learning.read_metrics(metrics_log(tmp_path / str(factor), factor)) for factor in (1.0, 2.0, 4.0)]
    shown = learning.curves(logs)
    np.testing.assert_array_equal(shown.done, [10, 20, 30, 40, 41, 42])
    rewards = shown.values["eval/mean_reward"]
    np.testing.assert_array_equal(rewards, np.outer([1.0, 2.0, 4.0], [1, 2, 3, 4, 9, 9]))
    assert shown.stages == learning.Stages(phase1=20, learned=40, length=42)
    figure = learning.draw(shown)
    line = next(line for line in figure.axes[0].lines if str(line.get_label()).startswith("median"))
    np.testing.assert_array_equal(line.get_ydata(), rewards[1])
    x = np.array(line.get_xdata(), float)
    assert np.all(np.diff(x) > 0) and x[-1] == 1.0
    (band,) = figure.axes[0].collections
    assert band.get_paths()[0].get_extents().y1 == 36.0
    ticks = [tick.get_text() for tick in figure.axes[-1].get_xticklabels()]
    assert ticks == ["0", "20", "40", "+2"]


PAPERS_TASK = preset("fast")
OWN_TASK = tiny.changed({"task": {"spacecraft": {"torque_limit": 0.004}}})


@pytest.mark.parametrize(
    ("configs", "expected"),
    [
        ([PAPERS_TASK], True),
        ([PAPERS_TASK, PAPERS_TASK], True),
        ([OWN_TASK], False),
        ([PAPERS_TASK, OWN_TASK], False),
        ([None], False),
    ],
)
def test_the_papers_lines_are_drawn_for_the_papers_task_only(configs, expected, tmp_path):
    runs = [metrics_log(tmp_path / str(number)) for number in range(len(configs))]
    for run, config in zip(runs, configs, strict=True):
        if config is not None:
            (run / "config.json").write_text(config.to_json())
    shown = learning.read_curves(runs)
    assert shown.is_paper_task == expected
    figure = learning.draw(shown)
    papers = {
        axes.get_ylabel().split(" [")[0]: np.array(line.get_ydata(), float)[0]
        for axes in figure.axes
        for line in axes.lines
        if str(line.get_label()).startswith("paper")
    }
    assert papers == (
        {
            "mean reward": 7281.91,
            "success": 97.0,
            "zone violated": pytest.approx(2.66),
            "settling time": 27.81,
            "control effort": 76.02,
            "control accuracy": 0.08,
        }
        if expected
        else {}
    )


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1e-9, 1e-6, 0.01, 1.0, 1e4])
def test_numbers_are_apart_and_in_one_form(factor, tmp_path):
    shown = learning.read_curves([metrics_log(tmp_path / "run", factor)])
    figure = learning.draw(shown)
    assert crowded_labels(figure) == []
    for axes in figure.axes:
        low, high = axes.get_ylim()
        texts = [tick.label1.get_text() for tick in axes.yaxis.get_major_ticks() if low <= tick.get_loc() <= high]
        assert len({"^" in text for text in texts if text}) == 1, "either all plain, or all powers of ten"
        assert not any(tick.label1.get_text() for tick in axes.yaxis.get_minor_ticks())


def test_the_time_axis_is_named_once(tmp_path):
    figure = learning.draw(learning.read_curves([metrics_log(tmp_path / "run")]))
    names = [axes.get_xlabel() for axes in figure.axes] + [legend.get_title().get_text() for legend in figure.legends]
    assert [name for name in names if name] == ["gradient updates, + refinement iterations"]


def test_runs_with_other_instants_are_interpolated_but_not_extended(tmp_path):
    logs = [
        learning.read_metrics(metrics_log(tmp_path / "a", refined=0)),
        learning.read_metrics(metrics_log(tmp_path / "b", updates=(5, 15, 25), refined=0)),
    ]
    shown = learning.curves(logs)
    np.testing.assert_array_equal(shown.done, [5, 10, 15, 20, 25, 30, 40])
    np.testing.assert_allclose(
        shown.values["eval/success_rate"], [[np.nan, 1, 1.5, 2, 2.5, 3, 4], [1, 1.5, 2, 2.5, 3, np.nan, np.nan]]
    )


def test_runs_of_other_lengths_are_not_mixed(tmp_path, capsys):
    runs = [metrics_log(tmp_path / "a"), metrics_log(tmp_path / "b", updates=(10, 20))]
    assert tiny.status("curves", *runs, "--out", tmp_path / "out") == 2
    assert capsys.readouterr().err == (
        "error: runs: draw runs of one preset together; these learned for [20, 40] updates\n"
    )


@pytest.mark.slow
def test_learning_curves_are_written(tmp_path, capsys):
    out = tmp_path / "new" / "out"
    runs = [metrics_log(tmp_path / "a"), metrics_log(tmp_path / "b", 2.0)]
    assert tiny.status("curves", *runs, "--out", out) == 0
    for suffix in ("png", "pdf"):
        assert (out / f"learning.{suffix}").stat().st_size > 5_000
    assert "learning.png" in capsys.readouterr().out


@pytest.mark.slow
def test_the_columns_are_those_that_a_training_writes():
    written = (tiny.finished_run().path / "metrics.csv").read_text().splitlines()[0].split(",")
    assert {*learning.COLUMNS} <= {*written}


def test_a_line_that_is_still_being_written_is_left_out(tmp_path):
    run = metrics_log(tmp_path / "run")
    whole = learning.read_metrics(run)
    with open(run / "metrics.csv", "a") as file:
        file.write("43,1,,7.")
    np.testing.assert_array_equal(learning.read_metrics(run)["updates"], whole["updates"])


BROKEN_LOGS = {
    "nothing": (None, "is not a run folder (it has no metrics.csv)"),
    "empty": (b"", "has no rows yet"),
    "header": (",".join(learning.COLUMNS).encode() + b"\n", "has no rows yet"),
    "other": (b"a,b\n1,2\n", "has no column 'updates'"),
    "words": (",".join(learning.COLUMNS).encode() + b"\n" + b"x," * 8 + b"x\n", "a cell is not a number"),
    "short": (",".join(learning.COLUMNS).encode() + b"\n,1,,1\n", "has a row without its number of updates"),
    "bytes": (b"\xff\xfe\x00\n\xff\n", "cannot be read as CSV"),
    "quote": (b'updates,"x\n1,2\n', "cannot be read as CSV"),
    "no evaluation": (",".join(learning.COLUMNS).encode() + b"\n10,1" + b"," * 7 + b"\n", "no evaluation in"),
}


@pytest.mark.parametrize("name", BROKEN_LOGS)
def test_a_log_that_cannot_be_drawn_is_refused(name, tmp_path, capsys):
    content, message = BROKEN_LOGS[name]
    run = tmp_path / "run"
    run.mkdir()
    if content is not None:
        (run / "metrics.csv").write_bytes(content)
    assert tiny.status("curves", run, "--out", tmp_path / "out") == 2
    output = capsys.readouterr()
    assert message in output.err and str(run) in output.err
    assert len(output.err.splitlines()) == 1 and not (tmp_path / "out").exists()
