"""Speed and memory of the main jobs, beside what the machine's matrix products alone would take.

    python benchmarks/speed.py

Every figure is the best of several runs in one process on an otherwise idle machine.
"""

import itertools
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from koz_jax.agents.agent import Agent
from koz_jax.agents.record import Provenance
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.presets.named import preset
from koz_jax.config.task import TaskConfig
from koz_jax.config.training import NetworkConfig, TrainConfig
from koz_jax.control.policy import PolicyController, policy_network
from koz_jax.evaluation.monte_carlo import run_cases
from koz_jax.learning import learners
from koz_jax.sac import learner
from koz_jax.sac.losses import Batch
from koz_jax.storage import runtime
from koz_jax.task import observation_layout, reward
from koz_jax.task.environment import Reorientation
from koz_jax.task.state import EnvState

CASES = 10_000
UPDATES = 200
Shape = tuple[int, int, int]  # (m, k, n) of a matrix product


def best_seconds(run: Callable[[], Any], repeats: int = 5) -> float:
    """Shortest time of ``run`` after one warm-up."""
    jax.block_until_ready(run())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return min(times)


def flops(shape: Shape) -> float:
    """Floating-point operations of a matrix product."""
    m, k, n = shape
    return 2.0 * m * k * n


def matmul_seconds(shape: Shape, repeats: int = 100) -> float:
    """Time of one (m, k) x (k, n) product, in a loop whose every product depends on the one before."""
    m, k, n = shape
    left = jnp.ones((m, k)) / k
    right = jnp.ones((k, n))

    def looped(entry: Callable[[jax.Array], jax.Array]) -> Callable[[], jax.Array]:
        def body(carry: jax.Array, _: None) -> tuple[jax.Array, None]:
            return right + 1e-30 * entry(carry), None

        loop = jax.jit(lambda right: jax.lax.scan(body, right, None, length=repeats)[0])
        return lambda: loop(right)

    # The loop itself costs a pass over the right factor; the same loop without the product is taken off.
    with_product = best_seconds(looped(lambda carry: jnp.dot(left, carry)[0, 0]))
    without = best_seconds(looped(lambda carry: carry[0, 0]))
    return (with_product - without) / repeats


def machine_rate() -> float:
    """FLOP/s of a large float32 matrix product on all cores."""
    shape = (2048, 2048, 2048)
    return flops(shape) / matmul_seconds(shape, repeats=3)


def monte_carlo(hidden: int, rate: float) -> None:
    """One call over all cases with an untrained policy: its speed does not depend on its weights."""
    network = NetworkConfig(hidden_sizes=(hidden, hidden))
    policy = policy_network(network).init(jax.random.key(0), jnp.zeros(observation_layout.SIZE))
    agent = Agent(PolicyController(policy, network), TaskConfig(), Provenance(), f"{hidden}-{hidden}")
    flown = [run_cases(agent, agent.task, MonteCarloConfig(cases=CASES), progress=False) for _ in range(3)]
    seconds = min(run.wall_s for run in flown)
    steps = CASES * agent.task.episode_steps
    work = steps * sum(flops((1, *leaf.shape)) for leaf in jax.tree.leaves(policy) if leaf.ndim == 2)
    print(
        f"Monte Carlo, {CASES} cases x {agent.task.episode_steps} steps, {hidden}-{hidden}: {seconds:.2f} s"
        f" ({work / seconds / 1e9:.0f} GFLOP/s, {work / seconds / rate:.0%} of the matmul rate;"
        f" matmul limit {work / rate:.2f} s), peak memory {peak_mib():.0f} MiB"
    )


def environment(num_envs: int = 1024, steps: int = 1000) -> None:
    """Physics and paper reward, with and without the observation."""
    env = Reorientation.from_config()
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), num_envs))
    action = jnp.full((num_envs, 3), 0.1)

    def run(observe: bool) -> Callable[[], jax.Array]:
        @jax.jit
        def loop(states: EnvState) -> jax.Array:
            def body(carry: tuple[EnvState, jax.Array], _: None) -> tuple[tuple[EnvState, jax.Array], None]:
                states, total = carry
                # What is not asked for, the compiler leaves out.
                stepped = jax.vmap(env.step)(states, action)
                total += jax.vmap(reward.total, in_axes=(0, None))(stepped.terms, reward.PAPER_WEIGHTS)
                if observe:
                    total += jnp.sum(stepped.observation, axis=1)
                return (stepped.state, total), None

            return jax.lax.scan(body, (states, jnp.zeros(num_envs)), None, length=steps)[0][1]

        return lambda: loop(states)

    for observe, name in ((False, "physics and reward"), (True, "physics, reward and observation")):
        rate = num_envs * steps / best_seconds(run(observe))
        print(f"environment, {num_envs} in parallel, {name}: {rate / 1e6:.1f} million steps/s")


def update_matmuls(sac: learner.Sac, batch: int) -> list[Shape]:
    """Every matrix product of one update (see ``learner.update``)."""

    def sizes(inputs: int, outputs: int) -> list[tuple[int, int]]:
        widths = [inputs, *sac.hidden_sizes, outputs]
        return list(itertools.pairwise(widths))

    encoded = sac.observation_size + sum(stop - start for start, stop, _ in sac.encoding)
    policy = sizes(encoded, 2 * sac.action_size)
    critic = sizes(encoded + sac.action_size, 1)

    def forward(layers: list[tuple[int, int]]) -> list[Shape]:
        return [(batch, i, o) for i, o in layers]

    def weights(layers: list[tuple[int, int]]) -> list[Shape]:
        return [(i, batch, o) for i, o in layers]

    def inputs(layers: list[tuple[int, int]]) -> list[Shape]:
        return [(batch, o, i) for i, o in layers]

    target = forward(policy) + 2 * forward(critic)
    critics = 2 * (forward(critic) + weights(critic) + inputs(critic[1:]))
    actor = forward(policy) + weights(policy) + inputs(policy[1:]) + 2 * (forward(critic) + inputs(critic))
    return target + critics + actor


def update(config: TrainConfig, rate: float) -> None:
    """One gradient update against the products it is made of, each timed alone in its own shape."""
    sac, batch_size = learners.make_sac(config), config.sac.batch_size
    name = f"{config.preset} ({'-'.join(map(str, config.network.hidden_sizes))}, batch {batch_size})"
    shape = (UPDATES, batch_size)
    key = jax.random.key(0)
    observed = jax.random.normal(key, (*shape, sac.observation_size))
    batches = Batch(observed, jnp.zeros((*shape, 3)), jnp.zeros(shape), jnp.ones(shape), observed)

    @jax.jit
    def loop(state: learner.SacState, batches: Batch, keys: jax.Array) -> learner.SacState:
        def body(state: learner.SacState, inputs: tuple[Batch, jax.Array]) -> tuple[learner.SacState, None]:
            return sac.update(state, *inputs, jnp.float32(1e-4))[0], None

        return jax.lax.scan(body, state, (batches, keys))[0]

    state, keys = sac.init(key), jax.random.split(key, UPDATES)
    seconds = best_seconds(lambda: loop(state, batches, keys)) / UPDATES
    shapes = update_matmuls(sac, batch_size)
    alone = {shape: matmul_seconds(shape) for shape in set(shapes)}
    matmuls = sum(alone[shape] for shape in shapes)
    work = sum(map(flops, shapes))
    print(
        f"update, {name}: {1e3 * seconds:.2f} ms ({1 / seconds:.0f}/s), {seconds / matmuls:.2f} times its matrix"
        f" products alone ({1e3 * matmuls:.2f} ms), {work / seconds / rate:.0%} of the matmul rate"
    )


def first_update() -> None:
    """From the start of ``train.py`` to its first update, without and with compiled programs from before."""
    with tempfile.TemporaryDirectory() as folder:
        for name, run in (("cold", "a"), ("with the compilation cache", "b")):
            command = [sys.executable, "train.py", "--run", str(Path(folder, run)), "--log-every", "8"]
            variables = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(Path(folder, "cache"))}
            start = time.perf_counter()
            with subprocess.Popen(command, env=variables, stderr=subprocess.DEVNULL) as process:
                log = Path(folder, run, "metrics.csv")
                while process.poll() is None and not log.exists():
                    time.sleep(0.02)
                print(f"first updates after the start, {name}: {time.perf_counter() - start:.1f} s")
                process.kill()


def peak_mib() -> float:
    """Largest memory this process has had [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Print everything."""
    runtime.configure()
    print(f"jax {jax.__version__}, {len(jax.devices())} x {jax.devices()[0].device_kind}")
    rate = machine_rate()
    print(f"matmul rate, float32, 2048 x 2048 x 2048: {rate / 1e9:.0f} GFLOP/s")
    for hidden in (256, 64):
        monte_carlo(hidden, rate)
    environment()
    update(preset("paper"), rate)
    update(preset("fast"), rate)
    first_update()


if __name__ == "__main__":
    main()
