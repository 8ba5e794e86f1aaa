"""``koz fly``, and the figures of ``koz evaluate``: what they write, and what they refuse."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support import tiny

from koz_jax.evaluation import cases


@pytest.mark.slow
@pytest.mark.parametrize("choice", [("--scenario", "paper"), ("--case", 3, "--cases", 5, "--seed", 1, "--gif")])
def test_fly_writes_what_it_says(choice, agent, tmp_path, capsys):
    out = tmp_path / "new" / "out"
    assert tiny.status("fly", "--agent", agent, "--out", out, *choice) == 0
    printed = capsys.readouterr().out
    names = {"history.csv", "sphere.png", "sphere.pdf", "histories.png", "histories.pdf"}
    names |= {"maneuver.gif"} if "--gif" in choice else set()
    assert {path.name for path in out.iterdir()} == names
    assert all((out / name).stat().st_size > 1_000 and str(out / name) in printed for name in names)
    assert printed.startswith("case 3 of seed 1: " if "--case" in choice else "the paper's test scenario: 100.0 deg")
    with Image.open(out / "sphere.png") as picture:
        assert np.ptp(np.asarray(picture.convert("L"))) > 200
    with open(out / "history.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == tiny.CONFIG.task.episode_steps + 1
    if "--case" in choice:  # the same as in the Monte Carlo
        replay = ["--replay-case", 3, "--cases", 5, "--seed", 1, "--history", tmp_path / "replayed.csv"]
        assert tiny.status("evaluate", "--agent", agent, *replay) == 0
        assert (out / "history.csv").read_text() == (tmp_path / "replayed.csv").read_text()


REFUSED = {
    "unknown case": (("--case", 10_000), "case: must be from 0 to cases - 1 = 9999, got 10000"),
    "negative case": (("--case", -1), "case: must be from 0 to cases - 1 = 9999, got -1"),
    "two scenarios": (("--case", 1, "--scenario", "paper"), "scenario: give either --scenario paper or --case"),
    "seed of nothing": (("--seed", 1), "seed: is of the draw, and needs --case"),
    "seed": (("--case", 1, "--seed", -1), "seed: Input should be greater than or equal to 0 (got -1)"),
    "angles": (("--case", 1, "--max-angle-deg", 20, "--min-angle-deg", 0), "max_angle_deg: must be above 34 deg"),
    "agent": (("--agent", "nobody"), "agent: 'nobody' is neither a shipped agent"),
    "folder": (("--out", "file/out"), "out: the folder file/out cannot be written: Not a directory"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_fly_refuses_before_it_flies(name, agent, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cases, "_keep_and_evaluate", lambda *_, **__: pytest.fail("something was flown"))
    Path("file").touch()
    argv, message = REFUSED[name]
    assert tiny.status("fly", "--agent", agent, *argv) == 2
    output = capsys.readouterr()
    assert output.err.startswith(f"error: {message}") and output.out == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["agent", "file"]


@pytest.mark.slow
def test_an_evaluation_draws_the_monte_carlo(agent, tmp_path, capsys):
    out = tmp_path / "figures"
    assert tiny.status("evaluate", "--agent", agent, "--cases", tiny.CASES, "--figures", out) == 0
    assert re.search(r"figure: .*monte-carlo-samples\.png", capsys.readouterr().out)
    assert sorted(path.stem for path in out.iterdir()) == sorted(
        2 * ["monte-carlo-accuracy", "monte-carlo-relations", "monte-carlo-samples"]
    )


@pytest.mark.parametrize(
    "argv, message",
    [
        (("--figures", "file"), "figures: the folder file cannot be written: File exists"),
        (("--figures", "out", "--replay-case", 1), "figures: are of many cases, and not drawn with --replay-case"),
    ],
)
def test_an_evaluation_refuses_figures_that_cannot_be(argv, message, agent, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cases, "_fly_cases", lambda *_, **__: pytest.fail("something was flown"))
    Path("file").touch()
    assert tiny.status("evaluate", "--agent", agent, *argv) == 2
    assert capsys.readouterr().err.startswith(f"error: {message}")
    assert not Path("out").exists()
