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


def await_training(*folders: RunFolder) -> None:
    """Wait until runs train."""
    deadline = time.monotonic() + 200
    while not all((folder.path / "metrics.csv").exists() for folder in folders) and time.monotonic() < deadline:
        time.sleep(0.01)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="a worker could not be given a core of its own")
def test_seeds_of_which_one_was_stopped_alone_are_resumed_equal_single_runs_and_the_best_is_kept(
    tmp_path, monkeypatch, capsys
):
    """Two seeds; the worker of the first is told to stop in its training, and the run is gone on with."""
    alone = tiny.finished_run()  # seed 0
    run, workers = tmp_path / "run", []

    class Noted(subprocess.Popen):
        def communicate(self, input: Any = None, timeout: float | None = None) -> Any:
            if input is not None and str(plan.folder(run, 0).path) in input:
                workers.append(self)
            return super().communicate(input, timeout)

    monkeypatch.setattr(seeds.subprocess, "Popen", Noted)
    plan = seeds.Plan(config=tiny.CONFIG, seeds=2, start_from=None)
    seeds.begin(run, plan)
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        trained = pool.submit(seeds.train_all, run, plan, progress=False)
        await_training(plan.folder(run, 0))
        workers[0].terminate()
        with pytest.raises(PeerProcessError, match="seed-0: was told to stop by somebody else; go on with"):
            trained.result()
    assert not (run / "table.json").exists()

    assert tiny.status("train", "--resume", run, "--cases", 12) == 0
    printed = capsys.readouterr().out
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
    assert all(f"seed {seed} " in printed for seed in scores) and printed.count("  best") >= 1


# A worker that begins to train and goes on until it is told to stop.
STUB = """
import json, pathlib, signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: sys.exit(75))
folder = pathlib.Path(json.loads(sys.stdin.read())["run"])
folder.mkdir(parents=True)
(folder / "metrics.csv").write_text("updates")
time.sleep(100)
"""


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="how many workers there are is not known")
def test_sigterm_is_handed_on_to_all_workers(tmp_path, monkeypatch):
    (tmp_path / "stub_of_a_worker.py").write_text(STUB)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(seeds, "_WORKER", "stub_of_a_worker")
    plan = seeds.Plan(config=tiny.CONFIG, seeds=2, start_from=None)
    folders = [plan.folder(tmp_path / "run", number) for number in range(min(plan.seeds, len(os.sched_getaffinity(0))))]

    def tell() -> None:
        await_training(*folders)
        os.kill(os.getpid(), signal.SIGTERM)

    (tmp_path / "run").mkdir()
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        told = pool.submit(tell)
        begun = time.monotonic()
        assert seeds.train_all(tmp_path / "run", plan, progress=False) is False
        told.result()
    assert time.monotonic() - begun < 100


@pytest.mark.slow
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
        folder = LONG.folder(run, 0)
        await_training(folder)
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
