"""Several seeds at once: one worker process per core, each an ordinary run in a folder of its own.

A CPU core per run is the fastest way on CPUs: a second core makes a single run only a third faster
(``benchmarks/scaling.py``), since its matrix products are small.  Every run gives the bits that training its seed alone
gives on one core.
"""

import concurrent.futures
import json
import os
import queue
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError
from tqdm import tqdm

from koz_jax.agents.agent import Agent, load_agent
from koz_jax.agents.record import find_agent
from koz_jax.config.training import TrainConfig
from koz_jax.errors import DamagedFileError, PeerProcessError, SettingsError, explain
from koz_jax.evaluation import monte_carlo
from koz_jax.evaluation.digits import significant
from koz_jax.evaluation.summary import Summary, summarise
from koz_jax.runs import progress as progress_bar
from koz_jax.runs import stages
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.interrupt import GracefulShutdown
from koz_jax.runs.trainer import checked_source
from koz_jax.storage import files
from koz_jax.storage.lock import FolderLock

_BAR = "{l_bar}{bar}| [{elapsed}<{remaining}]"

# Shown while it is waited for the workers.
_POLL_S = 0.5
# Exit status of a worker that was told to stop (EX_TEMPFAIL).
STOPPED = 75

# What a worker runs: ``work`` there reads its job from the standard input.
_WORKER = "koz_jax.cli.seed_worker"


class Plan(BaseModel):
    """Which seeds are trained, and on what settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    config: TrainConfig  # of the first seed
    seeds: int
    start_from: str | None
    cases: int = 10_000  # of the table at the end

    def folder(self, run: Path, number: int) -> RunFolder:
        """Folder of one of the runs."""
        return RunFolder(run / f"seed-{self.config.seed + number}")

    def of(self, number: int) -> TrainConfig:
        """Settings of one of the runs."""
        return self.config.model_copy(update={"seed": self.config.seed + number})


class Job(BaseModel):
    """What a worker is told."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    config: TrainConfig
    run: str  # folder
    start_from: str | None
    core: int  # of the CPU
    parent: int  # end of a pipe, which closes with the process that began the worker
    command: str  # that trains, for the records of the agents


class SeedResult(BaseModel):
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
        return Plan.model_validate(files.read_json(plan_path(run)))
    except ValidationError as error:
        raise DamagedFileError(f"{plan_path(run)}: {explain(error)}") from None


def begin(run: Path, plan: Plan) -> None:
    """Make the folder of several seeds.

    Raises:
        SettingsError: it is in use, cannot be made, the last seed is too large, or a run cannot be (see ``train``).

    """
    if plan.config.seed + plan.seeds > 2**32:
        raise SettingsError(f"seeds: seed + seeds must be at most 2^32, got {plan.config.seed} and {plan.seeds}")
    if run.exists() and (not run.is_dir() or any(run.iterdir())):
        raise SettingsError(f"run: {run} exists already; resume it with --resume {run}, or choose another folder")
    checked_source(plan.config, plan.start_from)
    files.make_folder("run", run)
    files.write_text(plan_path(run), plan.model_dump_json(indent=2) + "\n")


def train_all(run: Path, plan: Plan, *, progress: bool = True, command: str = "") -> bool:
    """Train every seed, or go on with it.  Returns whether all are finished (or the runs were asked to stop).

    command: the command line, where there is one; the records of the agents note it.

    Raises:
        PeerProcessError: a run failed; the others are finished first.

    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
    free: queue.SimpleQueue[int] = queue.SimpleQueue()
    for core in cores:
        free.put(core)
    with GracefulShutdown() as shutdown, FolderLock(run), concurrent.futures.ThreadPoolExecutor(len(cores)) as pool:
        work = [pool.submit(_train_one, run, plan, number, free, shutdown, command) for number in range(plan.seeds)]
        planned = stages.plan(plan.config)
        total = plan.seeds * progress_bar.work(planned, plan.config.length)
        with tqdm(total=total, bar_format=_BAR, disable=not progress) as bar:
            while not all(job.done() for job in work):
                concurrent.futures.wait(work, _POLL_S)
                done = [_done(plan.folder(run, number)) for number in range(plan.seeds)]
                bar.update(sum(progress_bar.work(planned, one) for one in done) - bar.n)
        failures = [failure for job in work if (failure := job.result())]
    if failures:
        raise PeerProcessError("\n".join(failures))
    return not shutdown.requested


def _done(folder: RunFolder) -> int:
    """How far a run is, by the last line of its log."""
    try:
        return int((folder.path / "metrics.csv").read_text(encoding="utf-8").splitlines()[-1].split(",")[0])
    except (OSError, ValueError, IndexError):
        return 0


def _train_one(
    run: Path, plan: Plan, number: int, free: queue.SimpleQueue[int], shutdown: GracefulShutdown, command: str
) -> str:
    """Train one seed in a process of its own.  Returns what went wrong, or an empty text."""
    if shutdown.requested:
        return ""
    core = free.get()
    folder = plan.folder(run, number)
    # Whatever ends this process closes the pipe, which the worker watches.
    watched, held = os.pipe()
    job = Job(
        config=plan.of(number),
        run=str(folder.path),
        start_from=plan.start_from,
        core=core,
        parent=watched,
        command=command,
    )
    # A session of its own: Ctrl-C reaches the worker once, from here.
    with subprocess.Popen(
        [sys.executable, "-m", _WORKER],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        pass_fds=(watched,),
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
    ) as process:
        os.close(watched)
        errors = _communicate(process, job.model_dump_json(), shutdown)
    os.close(held)
    free.put(core)
    # SIGTERM kills a worker that cannot take it yet.
    if process.returncode == 0 or (shutdown.requested and process.returncode in (STOPPED, -signal.SIGTERM)):
        return ""
    if process.returncode == STOPPED:
        return f"{folder.path.name}: was told to stop by somebody else; go on with --resume {run}"
    # What it warned of was told by ``begin``.
    told = "\n".join(line for line in errors.splitlines() if not line.startswith("warning: "))
    return f"{folder.path.name}: {told.strip()[-2000:] or process.returncode}"


def _communicate(process: subprocess.Popen[str], job: str, shutdown: GracefulShutdown) -> str:
    """Give a worker its job, and hand a request to stop on to it, once.  Returns what it printed."""
    given: str | None = job
    asked = False
    while True:
        try:
            return process.communicate(given, timeout=_POLL_S)[1]
        except subprocess.TimeoutExpired:
            given = None
            if shutdown.requested and not asked:
                process.terminate()
                asked = True


def evaluate(run: Path, plan: Plan, cases: int) -> tuple[Agent, list[SeedResult]]:
    """Evaluate the best agent of every seed, put the best of all into the folder, and write the table of all.

    The agent lies where that of a single run does, so that the folder can be given for a run.
    """
    last = stages.plan(plan.config)[-1]
    found, agents = [], []
    for number in range(plan.seeds):
        agent = load_agent(plan.folder(run, number).path)
        results = monte_carlo.monte_carlo(agent, cases, shield=plan.config.shielding.in_force).results
        score, summary = last.score(results), summarise(results)
        found.append(SeedResult(seed=plan.of(number).seed, score=score, summary=summary))
        agents.append(agent)
    best = int(np.argmax([result.score for result in found]))
    agents[best].save(RunFolder(run).agent(last.agent))
    rows = [json.loads(result.model_dump_json()) for result in found]
    files.write_json(run / "table.json", {"cases": cases, "best": found[best].seed, "seeds": rows})
    return load_agent(find_agent(run)), found


def table(found: Sequence[SeedResult], cases: int) -> str:
    """A row per seed, the best marked."""
    best = max(result.score for result in found)
    lines = [f"{cases} cases    score  success  violated  not settled  settling time [s]  effort [N2 m2 s]"]
    for result in found:
        summary = result.summary
        lines.append(
            f"seed {result.seed:<10} {result.score:7.1f} {summary.success_rate:8.2%} {summary.violation_rate:9.2%}"
            f" {summary.non_settled_rate:12.2%} {significant(summary.settling_time_mean, 2):>18}"
            f" {significant(summary.control_effort_mean, 2):>17}"
            f"{'  best' if result.score == best else ''}"
        )
    return "\n".join(lines)
