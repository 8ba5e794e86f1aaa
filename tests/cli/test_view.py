"""``koz view``: the page shows the case that the Monte Carlo flies, and what cannot be shown is refused."""

import json
import re
import sys
from typing import Any

import numpy as np
import pytest
from support import tiny
from support.tiny import untrained_agent

from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.evaluation.cases import fly_case


def content_of(text: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="content">(.*?)</script>', text, re.DOTALL)
    assert found
    return json.loads(found[1])


def attitude(maneuver):
    """Of the body, at every frame."""
    return maneuver["scene"]["turning"][-1]["turns"]


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """An agent's folder."""
    folder = tmp_path_factory.mktemp("agents") / "untrained"
    untrained_agent().save(folder)
    return str(folder)


@pytest.mark.slow
def test_command_draws_the_case_of_the_monte_carlo(saved, tmp_path, capsys):
    out = tmp_path / "maneuver.html"
    assert tiny.status("view", "--agent", saved, saved, "--case", 3, "--seed", 5, "--out", out) == 0
    printed = capsys.readouterr().out
    assert printed.count("deg, ") >= 2 and "maneuver.html" in printed
    (left, right) = content_of(out.read_text())["maneuvers"]
    assert left["label"] == right["label"] == "untrained"
    history, _ = fly_case(untrained_agent(), 3, MonteCarloConfig(seed=5))
    np.testing.assert_allclose(attitude(left)[0], history.state.body.q_BN[0], atol=1e-5)
    np.testing.assert_allclose(attitude(left)[-1], history.state.body.q_BN[-1], atol=1e-3)
    assert "case 3 of seed 5" in out.read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--agent", "no-such-agent"], "agent: 'no-such-agent' is neither"),
        (["--case", "10000"], "case: must be from 0 to cases - 1 = 9999, got 10000"),
        (["--case", "-1"], "case: must be"),
        (["--seed", "1"], "seed: is of the draw, and needs --case"),
        (["--seconds", "0"], "seconds: Input should be greater than 0"),
        (["--seconds", "nan"], "seconds: Input should be a finite number"),
        (["--robust"], "robust: is of the shield, and needs --shield"),
        (["--zones", "2"], "zones: is of the draw, and needs --case"),
        (["--agent", "SAVED", "--controller", "nobody"], "controller: must be one of pd"),
        (["--agent", "SAVED", "--urgency", "0.5"], "untrained was trained for one trade"),
        (["--urgency", "1.5"], "urgency.0: Input should be less than or equal to 1"),
        (["--urgency", *["0.5"] * 9], "agent: one page shows 1 to 8, got 9"),
        (["--agent", *["x"] * 9], "agent: one page shows 1 to 8, got 9"),
        (["--agent", *["x"] * 8, "--controller", "pd"], "agent: one page shows 1 to 8, got 9"),
        (["--case", "1", "--cases", "0"], "cases: Input should be greater than 0"),
        (
            ["--case", "1", "--min-angle-deg", "170", "--max-angle-deg", "160", "--agent", "SAVED"],
            "max_angle_deg must",
        ),
        (["--case", "1", "--min-angle-deg", "0", "--max-angle-deg", "10", "--agent", "SAVED"], "max_angle_deg: must"),
        (["--out", "no/such/folder/x.html"], "out: the folder no/such/folder"),
        (["--out", "."], "out: . must be a new or an ordinary file"),
    ],
)
def test_bad_input_is_named(arguments, message, saved, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert tiny.status("view", *(saved if argument == "SAVED" else argument for argument in arguments)) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("error: ") and message in printed and "Traceback" not in printed
    assert not list(tmp_path.iterdir())


def test_missing_plotly_is_named(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in [*(name for name in sys.modules if name.startswith("plotly")), "plotly"]:
        monkeypatch.setitem(sys.modules, name, None)
    assert tiny.status("view") == 2
    assert "pip install 'koz_jax[viz]'" in capsys.readouterr().err


@pytest.mark.slow
def test_controllers_shields_and_zones_are_shown(saved, tmp_path, capsys):
    out = tmp_path / "maneuver.html"
    argv = ["--agent", saved, "--controller", "pd", "--shield", "--case", 3, "--zones", 2, "--out", out]
    assert tiny.status("view", *argv) == 0
    found = content_of(out.read_text())["maneuvers"]
    assert [maneuver["label"] for maneuver in found] == ["untrained + shield", "pd + shield"]
    for maneuver in found:
        assert sum(trace["name"] == "zone edge" for trace in maneuver["scene"]["data"]) == 2
    assert capsys.readouterr().out.count("stayed clear of the zone") == 2


@pytest.mark.slow
def test_a_maneuver_of_ones_own_is_shown_as_it_is_flown(saved, tmp_path):
    """By who is named; where nobody is, by who was made for the spacecraft."""
    text = tiny.MANEUVER_FILES["calaon1"].read_text()
    (tmp_path / "mine.toml").write_text(
        text.replace("step_seconds = 0.2", "step_seconds = 0.2\nduration_seconds = 2.0")
    )
    argv = [tmp_path / "mine.toml", "--out", tmp_path / "x.html"]
    assert tiny.status("view", *argv) == 0
    (shown,) = content_of((tmp_path / "x.html").read_text())["maneuvers"]
    assert shown["label"] == "universal"
    assert tiny.status("view", *argv, "--urgency", 0, 1) == 0
    thrifty, fast = content_of((tmp_path / "x.html").read_text())["maneuvers"]
    assert (thrifty["label"], fast["label"]) == ("universal, urgency 0", "universal, urgency 1")
    assert attitude(thrifty)[-1] != attitude(fast)[-1]
    assert tiny.status("view", *argv, "--controller", "pd") == 0
    (shown,) = content_of((tmp_path / "x.html").read_text())["maneuvers"]
    assert shown["label"] == "pd"
    np.testing.assert_allclose(attitude(shown)[0], [0.98019802, 0, 0, 0.1980198], atol=1e-4)
    assert "3U CubeSat, one cone" in (tmp_path / "x.html").read_text()
