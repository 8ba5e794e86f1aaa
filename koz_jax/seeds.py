"""Several seeds at once: one worker process per core, each an ordinary run in a folder of its own.

A CPU core per run is the fastest way on CPUs: a second core makes a single run only a third faster
(``benchmarks/scaling.py``), since its matrix products are small.  Every run gives the bits that ``train.py --seed``
gives on one core.
"""

import concurrent.futures
import json
import os
import queue
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError
from tqdm import tqdm

from koz_jax import evaluation, storage
from koz_jax.agent import Agent, find_agent, load_agent
from koz_jax.config import TrainConfig
from koz_jax.errors import UserError, exit_status, explain
from koz_jax.interrupt import StopRequest
from koz_jax.lock import FolderLock
from koz_jax.run_folder import RunFolder
from koz_jax.summary import Summary, summarise
from koz_jax.trainer import checked_source, score, train

# Shown while it is waited for the workers.
_POLL_S = 0.5
# Exit status of a worker that was told to stop (EX_TEMPFAIL).
_STOPPED = 75


class Plan(BaseModel):
    """Which seeds are trained, and on what settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    config: TrainConfig  # of the first seed
    seeds: int
    start_from: str | None

    def folder(self, run: Path, number: int) -> RunFolder:
        """Folder of one of the runs."""
        return RunFolder(run / f"seed-{self.config.seed + number}")

    def of(self, number: int) -> TrainConfig:
        """Settings of one of the runs."""
        return self.config.model_copy(update={"seed": self.config.seed + number})


class Judged(BaseModel):
    """A finished run of one seed."""

    model_config = ConfigDict(frozen=True)

    seed: int
    score: float  # by which the best is chosen: mean reward, cases that failed counting zero
    summary: Summary


def plan_path(run: Path) -> Path:
    """File that makes a folder one of several seeds."""
    return run / "seeds.json"


def read_plan(run: Path) -> Plan:
    """Read the plan of an existing folder of several seeds."""
    try:
        return Plan.model_validate(storage.read_json(plan_path(run)))
    except ValidationError as error:
        raise UserError(f"{plan_path(run)}: {explain(error)}") from None


def begin(run: Path, plan: Plan) -> None:
    """Make the folder of several seeds.

    Raises:
        UserError: it is in use, cannot be made, the last seed is too large, or a run cannot be (see ``train``).

    """
    if plan.config.seed + plan.seeds > 2**32:
        raise UserError(f"seeds: seed + seeds must be at most 2^32, got {plan.config.seed} and {plan.seeds}")
    if run.exists() and (not run.is_dir() or any(run.iterdir())):
        raise UserError(f"run: {run} exists already; resume it with --resume {run}, or choose another folder")
    checked_source(plan.config, plan.start_from)
    storage.make_folder("run", run)
    storage.write_text(plan_path(run), plan.model_dump_json(indent=2) + "\n")


def train_all(run: Path, plan: Plan, *, progress: bool = True) -> bool:
    """Train every seed, or go on with it.  Returns whether all are finished (or the runs were asked to stop).

    Raises:
        UserError: a run failed; the others are finished first.

    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
    free: queue.SimpleQueue[int] = queue.SimpleQueue()
    for core in cores:
        free.put(core)
    with StopRequest() as stop, FolderLock(run), concurrent.futures.ThreadPoolExecutor(len(cores)) as pool:
        work = [pool.submit(_train_one, run, plan, number, free, stop) for number in range(plan.seeds)]
        with tqdm(total=plan.seeds * plan.config.length, unit="update", disable=not progress) as bar:
            while not all(job.done() for job in work):
                concurrent.futures.wait(work, _POLL_S)
                bar.update(sum(_done(plan.folder(run, number)) for number in range(plan.seeds)) - bar.n)
        failures = [failure for job in work if (failure := job.result())]
    if failures:
        raise UserError("\n".join(failures))
    return not stop.requested


def _done(folder: RunFolder) -> int:
    """How far a run is, by the last line of its log."""
    try:
        return int((folder.path / "metrics.csv").read_text(encoding="utf-8").splitlines()[-1].split(",")[0])
    except (OSError, ValueError, IndexError):
        return 0


def _train_one(run: Path, plan: Plan, number: int, free: queue.SimpleQueue[int], stop: StopRequest) -> str:
    """Train one seed in a process of its own.  Returns what went wrong, or an empty text."""
    if stop.requested:
        return ""
    core = free.get()
    folder = plan.folder(run, number)
    # Whatever ends this process closes the pipe, which the worker watches.
    watched, held = os.pipe()
    job = {
        "config": plan.of(number).model_dump(),
        "run": str(folder.path),
        "start_from": plan.start_from,
        "core": core,
        "parent": watched,
    }
    # A session of its own: Ctrl-C reaches the worker once, from here.
    with subprocess.Popen(
        [sys.executable, "-m", "koz_jax.seeds"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        pass_fds=(watched,),
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
    ) as process:
        os.close(watched)
        errors = _communicate(process, json.dumps(job), stop)
    os.close(held)
    free.put(core)
    # SIGTERM kills a worker that cannot take it yet.
    if process.returncode == 0 or (stop.requested and process.returncode in (_STOPPED, -signal.SIGTERM)):
        return ""
    if process.returncode == _STOPPED:
        return f"{folder.path.name}: was told to stop by somebody else; go on with python train.py --resume {run}"
    return f"{folder.path.name}: {errors.strip()[-2000:] or process.returncode}"


def _communicate(process: subprocess.Popen[str], job: str, stop: StopRequest) -> str:
    """Give a worker its job, and hand a request to stop on to it, once.  Returns what it printed."""
    given: str | None = job
    asked = False
    while True:
        try:
            return process.communicate(given, timeout=_POLL_S)[1]
        except subprocess.TimeoutExpired:
            given = None
            if stop.requested and not asked:
                process.terminate()
                asked = True


def judge(run: Path, plan: Plan, cases: int) -> tuple[Agent, list[Judged]]:
    """Judge the best agent of every seed, put the best of all into the folder, and write the table of all.

    The agent lies where that of a single run does, so that the folder can be given for a run.
    """
    judged, agents = [], []
    for number in range(plan.seeds):
        agent = load_agent(plan.folder(run, number).path)
        results = evaluation.monte_carlo(agent, cases, shield=plan.config.shielding.in_force).results
        phase = agent.provenance.phase
        judged.append(
            Judged(seed=plan.of(number).seed, score=score(results, plan.config, phase), summary=summarise(results))
        )
        agents.append(agent)
    best = int(np.argmax([found.score for found in judged]))
    agents[best].save(RunFolder(run).agent(agents[best].provenance.phase))
    rows = [json.loads(found.model_dump_json()) for found in judged]
    storage.write_json(run / "table.json", {"cases": cases, "best": judged[best].seed, "seeds": rows})
    return load_agent(find_agent(run)), judged


def table(judged: list[Judged], cases: int) -> str:
    """A row per seed, the best marked."""
    best = max(found.score for found in judged)
    lines = [f"{cases} cases    score  success  violated  not settled  settling time [s]  effort [N2 m2 s]"]
    for found in judged:
        summary = found.summary
        lines.append(
            f"seed {found.seed:<10} {found.score:7.1f} {summary.success_rate:8.2%} {summary.violation_rate:9.2%}"
            f" {summary.non_settled_rate:12.2%} {summary.settling_time_mean:18.2f} {summary.control_effort_mean:17.2f}"
            f"{'  best' if found.score == best else ''}"
        )
    return "\n".join(lines)


def _stop_with(parent: int) -> None:
    """Wait for the end of the process that began this one, and then stop as if told to.  parent: end of a pipe."""
    os.read(parent, 1)
    os.kill(os.getpid(), signal.SIGTERM)


def _work() -> int:
    """Train the run that stands on the standard input.  Returns the exit status."""
    job = json.loads(sys.stdin.read())
    threading.Thread(target=_stop_with, args=(job["parent"],), daemon=True).start()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {job["core"]})
    from koz_jax import runtime  # the number of devices is that of the cores

    runtime.configure()
    config, folder = TrainConfig.model_validate(job["config"]), RunFolder(Path(job["run"]))
    begun = folder.config.exists()
    start_from = None if begun else job["start_from"]
    agent = train(config, folder.path, resume=begun, start_from=start_from, progress=False)
    return 0 if agent is not None else _STOPPED


if __name__ == "__main__":
    sys.exit(exit_status(_work))
