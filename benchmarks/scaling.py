"""What more cores give to Monte Carlo and to training, and what limits it: ``python benchmarks/scaling.py``.

The same work (strong scaling) in several layouts: one core; all cores as one device, whose threads XLA uses inside an
operation; as many devices as cores; as many processes as cores.  Every layout runs in processes of its own.
"""

from __future__ import annotations

import dataclasses
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable

import tyro

CASES = 20_000
STEPS = 100  # environment steps of a timed chunk of training
REPEATS = 3


@dataclasses.dataclass(frozen=True)
class Layout:
    """How the work is laid out."""

    name: str
    cores: int
    devices: int  # of each process
    processes: int


@dataclasses.dataclass(frozen=True)
class Worker:
    """Time the work in one process of a layout; used by this command itself."""

    layout: Layout
    process: int
    coordinator: str


@dataclasses.dataclass(frozen=True)
class Times:
    """Seconds that the work took."""

    monte_carlo: float
    training: dict[str, float]  # one environment step and its updates, by ``SIZES``
    doubled: dict[str, float]  # the same with twice as many updates


SIZES = {"fast preset": 512, "4,096 environments": 4096}


def best_seconds(work: Callable[[], object], begin: Callable[[], None]) -> float:
    """Least time of some repeats; the first, which compiles, does not count.  begin: waits for all processes."""
    work()
    times = []
    for _ in range(REPEATS):
        begin()
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def measure(worker: Worker) -> Times:
    """Time the work here, while the other processes of the layout do their share."""
    cores = sorted(os.sched_getaffinity(0))
    # Processes share their cores: bound to one each, the thread that computes and the one that exchanges would wait for
    # each other, 4 ms for every array.
    os.sched_setaffinity(0, cores[: worker.layout.cores])
    os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={worker.layout.devices}"
    from koz_jax.storage import runtime

    runtime.keep_programs()
    if worker.layout.processes > 1:
        runtime.join(worker.coordinator, worker.layout.processes, worker.process)

    import jax
    import numpy as np

    from koz_jax.agents.agent import load_agent
    from koz_jax.config.monte_carlo import MonteCarloConfig
    from koz_jax.config.presets.named import preset
    from koz_jax.evaluation import cases
    from koz_jax.learning import train_step
    from koz_jax.runs import sharding
    from koz_jax.storage import processes

    def begin() -> None:
        processes.any_process(False)

    agent = load_agent("phase2")
    share = CASES // worker.layout.processes
    drawn = MonteCarloConfig(cases=share, first=share * worker.process)
    monte_carlo = best_seconds(lambda: cases.fly_cases(agent.controller, agent.task, drawn), begin)

    def training_step(num_envs: int, more: int) -> float:
        fast = preset("fast")
        config = fast.model_copy(
            update={"num_envs": num_envs, "updates_per_step": more * fast.updates_per_step, "prefill_steps": 20}
        )
        state = sharding.place(train_step.init(config, jax.random.key(0)), worker.layout.devices)

        def chunk() -> None:
            nonlocal state
            state = sharding.place(state, worker.layout.devices)
            trained = train_step.train_chunk(config, state, np.int32(STEPS))  # pyright: ignore[reportArgumentType]
            state, _ = processes.wait_for_devices(trained)

        return best_seconds(chunk, begin) / STEPS

    return Times(
        monte_carlo=monte_carlo,
        training={name: training_step(num_envs, 1) for name, num_envs in SIZES.items()},
        doubled={name: training_step(num_envs, 2) for name, num_envs in SIZES.items()},
    )


def run(layout: Layout) -> Times:
    """Time a layout: the slowest of its processes counts, since the others wait for it."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        coordinator = f"127.0.0.1:{server.getsockname()[1]}"
    workers = [
        subprocess.Popen(
            [sys.executable, __file__, json.dumps(dataclasses.asdict(Worker(layout, process, coordinator)))],
            stdout=subprocess.PIPE,
            text=True,
        )
        for process in range(layout.processes)
    ]
    printed = [worker.communicate()[0] for worker in workers]
    if any(worker.returncode for worker in workers):
        raise SystemExit(f"scaling: {layout.name} failed")
    found = [Times(**json.loads(text.splitlines()[-1])) for text in printed]
    return Times(
        monte_carlo=max(times.monte_carlo for times in found),
        training={name: max(times.training[name] for times in found) for name in SIZES},
        doubled={name: max(times.doubled[name] for times in found) for name in SIZES},
    )


def main() -> None:
    """Print the times, the speedups, and what limits them."""
    if len(sys.argv) == 2 and sys.argv[1].startswith("{"):
        job = json.loads(sys.argv[1])
        print(json.dumps(dataclasses.asdict(measure(Worker(**job | {"layout": Layout(**job["layout"])})))))
        return
    tyro.cli(lambda: None, description=__doc__)
    cores = len(os.sched_getaffinity(0))
    layouts = (
        Layout("1 core", 1, 1, 1),
        Layout(f"{cores} cores, 1 device", cores, 1, 1),
        Layout(f"{cores} cores, {cores} devices", cores, cores, 1),
        Layout(f"{cores} cores, {cores} processes", cores, 1, cores),
    )
    found = {layout.name: run(layout) for layout in layouts}
    one, _, devices, processes = found.values()

    def print_row(what: str, seconds: Callable[[Times], float], unit: float) -> None:
        print(what)
        for name, times in found.items():
            print(f"  {name:24} {unit * seconds(times):8.2f}   {seconds(one) / seconds(times):.2f}x")

    print_row(f"Monte Carlo, {CASES} cases [s]", lambda times: times.monte_carlo, 1.0)
    print(
        "  cases do not depend on each other: what is missing to the number of cores is the cores' own (shared memory,"
    )
    print("  clock), and the slower one's rest where all wait for it")
    for size in SIZES:
        print_row(f"training step, {size} [ms]", lambda times, size=size: times.training[size], 1e3)
        exchange = 1e3 * (processes.training[size] - devices.training[size])
        # The time of a step is that of the environments and that of the updates; with twice the updates it tells both.
        updates = one.doubled[size] - one.training[size]
        share = 1.0 - updates / one.training[size]
        print(
            f"  on one core {share:.0%} of it is environments, which devices divide; the rest is updates, which every"
            f" device does for itself,\n  so that {cores} devices can give at most"
            f" {1.0 / (1.0 - share + share / cores):.2f}x;\n  processes exchange the drawn batches through sockets:"
            f" {exchange:.1f} ms more than devices of one process"
        )


if __name__ == "__main__":
    main()
