"""Several seeds at once: each run is the one of its seed alone, stopped or not, and the best of all is kept."""

import concurrent.futures
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import tiny

from koz_jax.agents.agent import load_agent
from koz_jax.errors import DamagedFileError, PeerProcessError, SettingsError
from koz_jax.evaluation import monte_carlo
from koz_jax.runs import seeds, stages
from koz_jax.runs.folder import RunFolder
from koz_jax.storage import archive, files
from koz_jax.storage.lock import FolderLock


def same_arrays(one: Path, other: Path) -> None:
    with np.load(one / "arrays.npz") as found, np.load(other / "arrays.npz") as expected:
        assert found.files == expected.files
        for name in found.files:
            np.testing.assert_array_equal(found[name], expected[name], err_msg=name, strict=True)


@pytest.mark.slow
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
    assert "stopped; go on with" in errors.decode() and f"--resume {run}" in errors.decode()
    assert not (run / "table.json").exists()

    resumed = tiny.run_python(tiny.ROOT / "train.py", "--resume", run, "--cases", 12)
    assert resumed.returncode == 0, resumed.stderr
    assert (run / "seed-0" / "metrics.csv").read_bytes() == (alone.path / "metrics.csv").read_bytes()
    for name in ("checkpoints/0000000136", "agents/phase2"):
        same_arrays(run / "seed-0" / name, alone.path / name)
    assert RunFolder(run / "seed-1").read_config() == tiny.CONFIG.model_copy(update={"seed": 1})

    table = files.read_json(run / "table.json")
    scores = {row["seed"]: row["score"] for row in table["seeds"]}
    assert set(scores) == {0, 1} and scores[table["best"]] == max(scores.values())
    last = stages.plan(tiny.CONFIG)[-1]
    agents = {seed: load_agent(run / f"seed-{seed}") for seed in scores}
    for seed, agent in agents.items():
        flown = monte_carlo.monte_carlo(agent, 12).results
        assert last.score(flown) == pytest.approx(scores[seed], rel=1e-5)
    assert load_agent(run).provenance == agents[table["best"]].provenance
    same_arrays(run / "agents" / "phase2", run / f"seed-{table['best']}" / "agents" / "phase2")
    assert all(f"seed {seed} " in resumed.stdout for seed in scores) and resumed.stdout.count("  best") >= 1


def test_bad_numbers_of_seeds_and_used_folders_are_refused(tmp_path, capsys):
    for count in (0, -1, 1001):
        assert tiny.status("train", "--seeds", count, "--run", tmp_path / "run") == 2
        refusal = capsys.readouterr().err
        assert refusal.startswith("error: seeds: ") and f"got {count}" in refusal
    assert tiny.status("train", "--seeds", 2, "--seed", 2**32 - 1, "--run", tmp_path / "run") == 2
    assert "seeds: seed + seeds must be at most 2^32" in capsys.readouterr().err
    (tmp_path / "mine.txt").write_text("work")
    assert tiny.status("train", "--seeds", 2, "--run", tmp_path) == 2
    assert f"run: {tmp_path} exists already" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_beginning_that_cannot_be_leaves_nothing(tmp_path, capsys):
    flags = [*tiny.FLAGS, "--seeds", 2, "--run", tmp_path / "run", "--start-from", tmp_path / "nowhere"]
    assert tiny.status("train", *flags) == 2
    assert "start_from: " in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


# Long by its evaluations and checkpoints, one at every step: what it learns by is compiled as for ``CONFIG``.
LONG = seeds.Plan(config=tiny.changed({"log_every": 2, "eval_every": 2}), seeds=1, start_from=None)


def await_training(run: Path) -> RunFolder:
    """Wait until the only seed of a run trains."""
    folder = LONG.folder(run, 0)
    deadline = time.monotonic() + 200
    while not (folder.path / "metrics.csv").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    return folder


@pytest.mark.slow
def test_a_worker_that_was_stopped_alone_is_no_finished_run(tmp_path, monkeypatch):
    workers = []

    class Noted(subprocess.Popen):
        def __init__(self, *args: Any, **options: Any) -> None:
            super().__init__(*args, **options)
            workers.append(self)

    monkeypatch.setattr(seeds.subprocess, "Popen", Noted)
    seeds.begin(tmp_path / "run", LONG)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        trained = pool.submit(seeds.train_all, tmp_path / "run", LONG, progress=False)
        await_training(tmp_path / "run")
        workers[0].terminate()
        with pytest.raises(PeerProcessError, match="seed-0: was told to stop by somebody else; go on with"):
            trained.result()


TRAIN_ALL = """
import sys, pathlib
from koz_jax.runs import seeds, stages
run = pathlib.Path(sys.argv[1])
seeds.train_all(run, seeds.read_plan(run), progress=False)
"""


@pytest.mark.slow
def test_workers_stop_with_the_process_that_began_them(tmp_path):
    run = tmp_path / "run"
    seeds.begin(run, LONG)
    with subprocess.Popen([sys.executable, "-c", TRAIN_ALL, run], env=tiny.environment()) as process:
        folder = await_training(run)
        process.kill()
    deadline = time.monotonic() + 60
    while True:  # until the worker has let go of its folder
        try:
            with FolderLock(folder.path):
                break
        except SettingsError:
            assert time.monotonic() < deadline
            time.sleep(0.1)
    newest = folder.checkpoints()[0]
    assert 0 < archive.read_record(newest)["done"] < LONG.config.length


def test_a_tampered_plan_is_refused(tmp_path):
    plan = seeds.Plan(config=tiny.CONFIG, seeds=2, start_from=None)
    seeds.begin(tmp_path / "run", plan)
    assert seeds.read_plan(tmp_path / "run") == plan
    path = seeds.plan_path(tmp_path / "run")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"seeds": "many"}))
    with pytest.raises(DamagedFileError, match=r"seeds\.json: seeds: .*many"):
        seeds.read_plan(tmp_path / "run")


@pytest.mark.slow
def test_a_failing_worker_is_named(tmp_path):
    source = shutil.copytree(tiny.finished_run().path, tmp_path / "nowhere")
    plan = seeds.Plan(config=tiny.CONFIG, seeds=1, start_from=str(source))
    seeds.begin(tmp_path / "run", plan)
    shutil.rmtree(source)
    with pytest.raises(PeerProcessError, match=r"seed-0: error: start_from: .*nowhere is neither a run"):
        seeds.train_all(tmp_path / "run", plan, progress=False)
