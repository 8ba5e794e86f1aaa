"""Cases in blocks: the same, case by case, as in one flight; interrupted, damaged, resumed, or on several devices."""

import dataclasses
import json
import logging
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from support import tiny

from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import TaskConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases, monte_carlo
from koz_jax.evaluation.monte_carlo import MonteCarlo
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.evaluation.summary import summarise, table
from koz_jax.storage import archive
from koz_jax.storage.lock import FolderLock

CASES, BLOCK = 2300, 1000  # blocks of two chunks, and a last one that is not whole
CONFIG = MonteCarloConfig(cases=CASES, seed=3)
AGENT = tiny.untrained_agent()
HERE = Path(__file__).parent

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
    "unsafe_start_rate",
    "infeasible_steps_mean",
    "infeasible_case_rate",
    "settling_time_scaled_mean",
    "control_effort_scaled_mean",
    "compile_s",
    "wall_s",
]


def run_in_blocks(partial: Path | None = None, **changes: Any) -> MonteCarlo:
    config = CONFIG.model_copy(update=changes)
    return monte_carlo.run_cases(AGENT, AGENT.task, config, partial=partial, block=BLOCK, progress=False)


def assert_same(found: CaseResult, expected: CaseResult) -> None:
    """The same verdicts, and numbers that differ by rounding only, as of another place in a batch.

    Whether a body at rest makes progress is a matter of rounding.
    """
    for (path, one), (_, other) in zip(
        jax.tree_util.tree_leaves_with_path(found), jax.tree_util.tree_leaves_with_path(expected), strict=True
    ):
        if jax.tree_util.keystr(path).endswith(".no_progress"):
            continue
        floats = np.issubdtype(np.asarray(one).dtype, np.floating)
        rtol, atol = (1e-5, 1e-5) if floats else (0, 0)
        np.testing.assert_allclose(one, other, rtol, atol, err_msg=jax.tree_util.keystr(path), strict=True)


@pytest.fixture(scope="module")
def single() -> CaseResult:
    """One flight of all cases."""
    return cases.fly_cases(AGENT.controller, AGENT.task, CONFIG)


@pytest.fixture
def no_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases, "_fly_cases", lambda *_, **__: pytest.fail("something was flown"))


@pytest.mark.slow
def test_blocks_give_the_results_of_one_flight(single):
    flown = run_in_blocks()
    assert_same(flown.results, single)
    assert (flown.agent, flown.config) == (AGENT.name, CONFIG)
    assert flown.wall_s > 0 and flown.compile_s > 0


@pytest.mark.slow
@pytest.mark.parametrize("first", [500, 1000, 2000])
def test_a_range_of_cases_is_a_part_of_the_flight(single, first):
    part = CONFIG.model_copy(update={"first": first, "cases": min(1000, CASES - first)})
    found = cases.fly_cases(AGENT.controller, AGENT.task, part)
    assert_same(found, jax.tree.map(lambda leaf: leaf[first : first + part.cases], single))


@pytest.mark.slow
def test_finished_blocks_are_kept_and_not_flown_again(single, tmp_path, monkeypatch):
    fly, flown = cases.fly_cases, []

    def interrupted(controller: Any, task: Any, config: MonteCarloConfig) -> CaseResult:
        flown.append(config.first)
        if len(flown) == 2:
            raise KeyboardInterrupt
        return fly(controller, task, config)

    monkeypatch.setattr(cases, "fly_cases", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_in_blocks(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"lock", "block-0000000000", "block-0000001000"}
    assert_same(run_in_blocks(tmp_path).results, single)
    assert flown == [1000, 2000]  # the resumed flight compiles with its first block, which is timed apart
    for name in ("fly_cases", "fly_timed"):
        monkeypatch.setattr(cases, name, lambda *_: pytest.fail("something was flown"))
    again = run_in_blocks(tmp_path)
    assert_same(again.results, single)
    assert again.compile_s == 0.0 and again.wall_s > 0


@pytest.mark.slow
def test_more_cases_go_on_from_fewer(single, tmp_path):
    run_in_blocks(tmp_path, cases=1500)
    before = (tmp_path / "block-0000000000" / "arrays.npz").stat().st_mtime_ns
    assert_same(run_in_blocks(tmp_path).results, single)
    assert (tmp_path / "block-0000000000" / "arrays.npz").stat().st_mtime_ns == before


@pytest.mark.slow
def test_a_damaged_block_is_named_and_flown_again(single, tmp_path, caplog):
    run_in_blocks(tmp_path)
    path = tmp_path / "block-0000001000" / "arrays.npz"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)
    assert_same(run_in_blocks(tmp_path).results, single)
    told = [record for record in caplog.records if record.name.endswith("monte_carlo")]
    assert [record.levelno for record in told] == [logging.WARNING]
    assert f"{path}: damaged" in caplog.text and "flown again" in caplog.text
    caplog.clear()
    run_in_blocks(tmp_path)
    assert "damaged" not in caplog.text


@pytest.mark.slow
def test_blocks_of_another_flight_are_refused(tmp_path, monkeypatch):
    folder = tmp_path / "block-0000000000"
    run_in_blocks(tmp_path, cases=BLOCK)
    monkeypatch.setattr(cases, "_fly_cases", lambda *_, **__: pytest.fail("something was flown"))
    for changes, name in [
        ({"seed": 4}, "seed"),
        ({"max_angle_deg": 100.0}, "max_angle_deg"),
        ({"substeps": 2}, "substeps"),
        ({"shield": ShieldConfig()}, "shield"),
        ({"uncertainty": UncertaintyConfig(disturbance_torque=0.1)}, "uncertainty"),
    ]:
        with pytest.raises(SettingsError, match=rf"partial: {tmp_path} holds cases of another flight \(another {name}"):
            run_in_blocks(tmp_path, **changes)
    other = tiny.untrained_agent(1)
    with pytest.raises(SettingsError, match=r"another controller\)"):
        monte_carlo.run_cases(other, AGENT.task, CONFIG, partial=tmp_path, block=BLOCK)
    with pytest.raises(SettingsError, match=r"another task\)"):
        task = AGENT.task.model_copy(update={"angle_convention": "half"})
        monte_carlo.run_cases(AGENT, task, CONFIG, partial=tmp_path, block=BLOCK)
    archive.save_tree(folder, {}, {"cases": BLOCK})
    with pytest.raises(SettingsError, match="another controller, task, seed"):
        run_in_blocks(tmp_path)


@pytest.mark.usefixtures("no_flight")
def test_folders_that_are_not_for_blocks_are_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(SettingsError, match=r"partial: .* holds other things \(thesis.tex\)"):
        run_in_blocks(tmp_path)
    with pytest.raises(SettingsError, match=r"partial: the folder .*thesis.tex cannot be written"):
        run_in_blocks(tmp_path / "thesis.tex")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    (tmp_path / "used").mkdir()
    with (
        FolderLock(tmp_path / "used"),
        pytest.raises(SettingsError, match=r"partial: .*used is in use by another process"),
    ):
        run_in_blocks(tmp_path / "used")


@pytest.mark.slow
def test_the_report_has_the_documented_keys_in_order():
    flown = monte_carlo.monte_carlo(AGENT, tiny.CASES, 3)
    summary = summarise(flown.results)
    report = monte_carlo.report(flown, summary)
    assert list(report) == REPORT_KEYS
    assert (report["cases"], report["seed"], report["agent"]) == (tiny.CASES, 3, "untrained")
    for name, value in vars(summary).items():
        assert report[name] == value or (report[name] is None and math.isnan(value))
    assert isinstance(report["wall_s"], float) and report["wall_s"] > 0
    assert isinstance(report["compile_s"], float) and report["compile_s"] > 0
    # Two seconds are too short to settle: there is no settling time, and JSON has no nan.
    assert report["non_settled_rate"] == 1.0 and report["settling_time_mean"] is None
    assert json.loads(json.dumps(report, allow_nan=False)) == report


@pytest.mark.slow
def test_options_of_a_monte_carlo_are_those_of_its_settings():
    flown = monte_carlo.monte_carlo(AGENT, 5, 3, min_angle_deg=100.0, substeps=2)
    expected = MonteCarloConfig(cases=5, seed=3, min_angle_deg=100.0, substeps=2)
    assert flown.config == expected
    assert_same(flown.results, cases.fly_cases(AGENT.controller, AGENT.task, expected))


@pytest.mark.slow
def test_another_task_than_the_agents_is_flown_when_asked_for():
    half = AGENT.task.with_rules("half")
    flown = monte_carlo.monte_carlo(AGENT, 5, 3, half)
    plain = monte_carlo.monte_carlo(AGENT, 5, 3)
    accuracy = np.asarray(plain.results.control_accuracy)
    np.testing.assert_allclose(flown.results.control_accuracy, 0.5 * accuracy, rtol=1e-6)


@pytest.mark.parametrize("wrong", [{"cases": 0}, {"seed": -1}, {"substeps": 0}, {"max_angle_deg": 79.0}, {"colour": 1}])
def test_what_cannot_be_flown_is_refused_by_its_name(wrong):
    with pytest.raises(SettingsError, match=next(iter(wrong))):
        monte_carlo.monte_carlo(AGENT, **wrong)


def test_a_range_without_room_for_a_zone_is_refused():
    with pytest.raises(SettingsError, match=r"max_angle_deg: must be above 34 deg.*got 34"):
        monte_carlo.monte_carlo(AGENT, 3, min_angle_deg=10.0, max_angle_deg=34.0)


# --- the command, several processes and devices ---


@pytest.mark.slow
def test_the_command_keeps_blocks(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(monte_carlo, "BLOCK", BLOCK)
    AGENT.save(tmp_path / "agent")
    argv = [
        "--agent",
        tmp_path / "agent",
        "--cases",
        1100,
        "--partial",
        tmp_path / "kept",
        "--json",
        tmp_path / "x.json",
    ]
    assert tiny.status("eval_mc", *argv) == 0
    first = json.loads((tmp_path / "x.json").read_text())
    assert sorted(path.name for path in (tmp_path / "kept").iterdir()) == [
        "block-0000000000",
        f"block-{BLOCK:010d}",
        "lock",
    ]
    assert tiny.status("eval_mc", *argv) == 0
    second = json.loads((tmp_path / "x.json").read_text())
    assert {**first, "compile_s": 0.0} == second
    capsys.readouterr()
    assert tiny.status("eval_mc", *argv[:4], "--partial", tmp_path / "kept", "--replay-case", 3) == 2
    assert "partial: is not written with --replay-case" in capsys.readouterr().err


# Flies blocks of cases together with another process, then fewer than a block, for which one of them waits; and writes
# the results.
JOIN = """
import sys, pathlib
sys.path.insert(0, "..")
from koz_jax.evaluation import monte_carlo
from koz_jax.storage import archive, runtime
runtime.join(sys.argv[1], 2, int(sys.argv[2]))
import jax
assert (jax.local_device_count(), jax.device_count()) == (2, 4)
import test_monte_carlo as test
folder = pathlib.Path(sys.argv[3])
flown = monte_carlo.run_cases(
    test.AGENT, test.AGENT.task, test.CONFIG, partial=folder / "kept", block=test.BLOCK
)
archive.save_tree(folder / sys.argv[2], flown.results, {"compiled": flown.compile_s > 0})
few = test.CONFIG.model_copy(update={"cases": test.BLOCK})
flown = monte_carlo.run_cases(test.AGENT, test.AGENT.task, few, partial=folder / "few", block=test.BLOCK)
archive.save_tree(folder / f"few{sys.argv[2]}", flown.results, {})
"""


@pytest.mark.slow
def test_two_processes_of_two_devices_give_the_results_of_one(single, tmp_path):
    variables = {**tiny.environment(), **tiny.devices(2)}
    address = f"127.0.0.1:{tiny.free_port()}"
    workers = [
        subprocess.Popen(
            [sys.executable, "-c", JOIN, address, str(number), str(tmp_path)],
            env=variables,
            cwd=HERE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for number in range(2)
    ]
    errors = [worker.communicate(timeout=300)[1] for worker in workers]
    assert [worker.returncode for worker in workers] == [0, 0], errors
    shapes = jax.eval_shape(lambda: single)
    for number in range(2):
        assert_same(jax.tree.map(np.asarray, archive.load_tree(tmp_path / str(number), shapes)), single)
        few = jax.tree.map(lambda leaf: leaf[:BLOCK], single)
        found = archive.load_tree(tmp_path / f"few{number}", jax.eval_shape(lambda few=few: few))
        assert_same(jax.tree.map(np.asarray, found), few)
    names = {path.name for path in (tmp_path / "kept").iterdir()}
    assert names == {"lock", *(f"block-{first:010d}" for first in (0, 1000, 2000))}


def test_processes_that_do_not_exist_are_refused(capsys):
    argv = ["--coordinator", "127.0.0.1:1", "--processes", 2, "--process", 2]
    assert tiny.status("eval_mc", *argv) == 2
    assert "process: must be from 0 to processes - 1 = 1, got 2" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("shield", [None, ShieldConfig()])
def test_the_table_of_a_monte_carlo_knows_of_the_shield_and_of_the_task(shield):
    """Without being told: rows on the shield where one flew, the paper's numbers where the task is the paper's."""
    flown = monte_carlo.monte_carlo(AGENT, 5, 3, shield=shield)
    text = table(flown)
    assert text.splitlines()[0].split() == ["5", "cases", "untrained", *(["+", "shield"] if shield else [])]
    for row in ("shield intervened", "mean change of torque", "deadlocked", "start not covered by the shield"):
        assert (row in text) == (shield is not None)
    assert "7281.91" not in text  # this task has an episode of its own
    papers = dataclasses.replace(flown, task=TaskConfig())
    assert "7281.91 +- 688.85" in table(papers) and "paper" in table(papers).splitlines()[0]
    narrow = dataclasses.replace(papers, config=flown.config.model_copy(update={"min_angle_deg": 100.0}))
    assert "7281.91" not in table(narrow)
    # The summary alone shows what a shield did.
    summary = summarise(flown.results)
    assert ("shield intervened" in table(summary, 5, "x")) == (summary.intervention_rate > 0)
