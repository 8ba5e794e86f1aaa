"""Several seeds at once: each run is the one of its seed alone, stopped or not, and the best of all is kept."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tiny

from koz_jax import evaluation, seeds, storage
from koz_jax.agent import load_agent
from koz_jax.errors import UserError
from koz_jax.run_folder import RunFolder
from koz_jax.trainer import score


def same_arrays(one: Path, other: Path) -> None:
    with np.load(one / "arrays.npz") as found, np.load(other / "arrays.npz") as expected:
        assert found.files == expected.files
        for name in found.files:
            np.testing.assert_array_equal(found[name], expected[name], err_msg=name, strict=True)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="a worker could not be given a core of its own")
def test_seeds_stopped_and_resumed_equal_single_runs_and_the_best_is_kept(tmp_path):
    """Runs the command line: two seeds, ended by SIGTERM in their training, and gone on with."""
    alone = tiny.finished_run()  # seed 0
    run = tmp_path / "run"
    command = [sys.executable, tiny.ROOT / "train.py", *tiny.FLAGS, "--run", run, "--seeds", "2", "--cases", "12"]
    with subprocess.Popen(list(map(str, command)), env=tiny.environment(), stderr=subprocess.PIPE) as process:
        deadline = time.monotonic() + 300
        while not (run / "seed-0" / "metrics.csv").exists() and time.monotonic() < deadline:
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate()
    assert process.returncode == 0, errors
    assert f"go on with: python train.py --resume {run}" in errors.decode()
    assert not (run / "table.json").exists()

    resumed = tiny.run_python(tiny.ROOT / "train.py", "--resume", run, "--cases", 12)
    assert resumed.returncode == 0, resumed.stderr
    assert (run / "seed-0" / "metrics.csv").read_bytes() == (alone.path / "metrics.csv").read_bytes()
    for name in ("checkpoints/0000000136", "agents/phase2"):
        same_arrays(run / "seed-0" / name, alone.path / name)
    assert RunFolder(run / "seed-1").read_config() == tiny.CONFIG.model_copy(update={"seed": 1})

    table = storage.read_json(run / "table.json")
    scores = {row["seed"]: row["score"] for row in table["seeds"]}
    assert set(scores) == {0, 1} and scores[table["best"]] == max(scores.values())
    agents = {seed: load_agent(run / f"seed-{seed}") for seed in scores}
    for seed, agent in agents.items():
        flown = evaluation.monte_carlo(agent, 12).results
        assert score(flown, tiny.CONFIG, agent.provenance.phase) == pytest.approx(scores[seed], rel=1e-5)
    assert load_agent(run).provenance == agents[table["best"]].provenance
    same_arrays(run / "agents" / "phase2", run / f"seed-{table['best']}" / "agents" / "phase2")
    assert all(f"seed {seed} " in resumed.stdout for seed in scores) and resumed.stdout.count("  best") >= 1


def test_bad_numbers_of_seeds_and_used_folders_are_refused(tmp_path, capsys):
    for count in (0, -1, 1001):
        assert tiny.status("train", "--seeds", count, "--run", tmp_path / "run") == 2
        assert f"seeds: must be from 1 to 1000, got {count}" in capsys.readouterr().err
    assert tiny.status("train", "--seeds", 2, "--seed", 2**32 - 1, "--run", tmp_path / "run") == 2
    assert "seeds: seed + seeds must be at most 2^32" in capsys.readouterr().err
    (tmp_path / "mine.txt").write_text("work")
    assert tiny.status("train", "--seeds", 2, "--run", tmp_path) == 2
    assert f"run: {tmp_path} exists already" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_tampered_plan_is_refused(tmp_path):
    plan = seeds.Plan(config=tiny.CONFIG, seeds=2, start_from=None)
    seeds.begin(tmp_path / "run", plan)
    assert seeds.read_plan(tmp_path / "run") == plan
    path = seeds.plan_path(tmp_path / "run")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"seeds": "many"}))
    with pytest.raises(UserError, match=r"seeds\.json: seeds: .*many"):
        seeds.read_plan(tmp_path / "run")


def test_a_failing_worker_is_named(tmp_path):
    plan = seeds.Plan(config=tiny.CONFIG, seeds=1, start_from=str(tmp_path / "nowhere"))
    seeds.begin(tmp_path / "run", plan)
    with pytest.raises(UserError, match=r"seed-0: error: start_from: .*nowhere is neither a run"):
        seeds.train_all(tmp_path / "run", plan, progress=False)
