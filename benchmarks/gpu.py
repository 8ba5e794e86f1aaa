"""How fast the main jobs are on a GPU.

    python benchmarks/gpu.py [--only WORD ...] [--markdown FILE]

Compiling is not counted; see the bar of ``koz train`` for how long that takes.  The shipped agents fly, untrained
policies learn: speed does not depend on weights.
"""

import argparse
import dataclasses
import functools
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import stamp
from speed import best_seconds

from koz_jax.agents.agent import load_agent
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.presets import sizes
from koz_jax.config.presets.named import preset
from koz_jax.config.training import TrainConfig
from koz_jax.evaluation.monte_carlo import run_cases
from koz_jax.learning import learners, refinement, train_step
from koz_jax.storage import runtime
from koz_jax.task.environment import Reorientation
from koz_jax.task.state import EnvState

SIDE = 8192  # of the matrices of the matmul rate


@dataclasses.dataclass(frozen=True)
class Row:
    """What is measured, and what came of it."""

    title: str
    figure: Callable[[], str]


def matmul(precision: str) -> str:
    """Rate of a large product."""
    left = jax.random.normal(jax.random.key(0), (SIDE, SIDE))
    product = jax.jit(functools.partial(jnp.matmul, precision=precision))
    return f"{2e-12 * SIDE**3 / best_seconds(lambda: product(left, left)):.0f} TFLOP/s"


def monte_carlo(name: str, cases: int) -> str:
    """Fly an agent; the second time everything is compiled."""
    agent, config = load_agent(name), MonteCarloConfig(cases=cases)
    flown = [run_cases(agent, agent.task, config, progress=False) for _ in range(2)]
    success = flown[0].results.success.mean()
    return f"{min(run.wall_s for run in flown):.3f} s (success {success:.4%}, compiled in {flown[0].compile_s:.1f} s)"


def environment(count: int, steps: int = 200) -> str:
    """Steps of many environments under a constant action."""
    env = Reorientation.from_config()
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), count))

    @jax.jit
    def loop(states: EnvState) -> EnvState:
        def body(states: EnvState, _: None) -> tuple[EnvState, None]:
            return jax.vmap(lambda state: env.step(state, jnp.full(3, 0.1)).state)(states), None

        return jax.lax.scan(body, states, None, length=steps)[0]

    return f"{1e-6 * count * steps / best_seconds(lambda: loop(states)):.0f} million steps/s"


def seconds_of_each(program: Any, config: TrainConfig, state: Any, few: int, many: int) -> float:
    """Time of one round of a program that changes its state and takes a number of rounds."""
    compiled = program.lower(config, state, jnp.int32(few)).compile()
    state, _ = compiled(state, jnp.int32(few))
    jax.block_until_ready(state)
    start = time.perf_counter()
    jax.block_until_ready(compiled(state, jnp.int32(many)))
    return (time.perf_counter() - start) / many


def learning(config: TrainConfig) -> str:
    """Updates of Soft Actor-Critic, steps of the environments included."""
    state = train_step.init(config, jax.random.key(0))
    seconds = seconds_of_each(train_step.train_chunk, config, state, 10, 500)
    return f"{config.updates_per_step / seconds:.0f} updates/s"


def refining(config: TrainConfig) -> str:
    """Iterations of refinement."""
    policy = learners.make_sac(config).init(jax.random.key(0)).policy
    state = refinement.init(config, policy)
    return f"{1e3 * seconds_of_each(refinement.refine_chunk, config, state, 2, 10):.0f} ms an iteration"


def rows() -> Iterator[Row]:
    """Everything that is measured."""
    for precision, name in (("float32", "float32"), ("default", "TF32, the default, which is not used")):
        yield Row(f"matrix product, {SIDE} x {SIDE}, {name}", functools.partial(matmul, precision))
    for count in (1024, 65_536):
        yield Row(f"environment, {count} in parallel", functools.partial(environment, count))
    for cases in (10_000, 100_000, 1_000_000):
        yield Row(f"Monte Carlo, phase2, {cases} cases", functools.partial(monte_carlo, "phase2", cases))
    yield Row("Monte Carlo, universal, 10000 cases", functools.partial(monte_carlo, "universal", 10_000))
    for name in ("fast", "universal"):
        config, _ = sizes.for_gpu(preset(name))
        yield Row(f"learning, {name}", functools.partial(learning, config))
        for scenarios in (128, 1024, 2048, 4096, 8192) if name == "universal" else (128, 1024):
            refine = config.refine.model_copy(update={"scenarios": scenarios})
            sized = config.model_copy(update={"refine": refine})
            yield Row(f"refining, {name}, {scenarios} maneuvers", functools.partial(refining, sized))


def _measure(args: argparse.Namespace) -> int:
    runtime.configure()
    chosen = [row for row in rows() if not args.only or any(word in row.title for word in args.only)]
    lines = [stamp.row(["what", jax.devices()[0].device_kind]), stamp.row(["---", "---"])]
    print("\n".join(lines), flush=True)
    for row in chosen:
        lines.append(stamp.row([row.title, row.figure()]))
        print(lines[-1], flush=True)
    if args.markdown:
        stamp.write_table(args.markdown, sys.argv, "\n".join(lines))
    return 0


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/gpu.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[], help="words that a row's title must hold, any of them")
    parser.add_argument("--markdown", type=Path, help="write the table for docs/results/")
    return exit_status(lambda: _measure(parser.parse_args(argv)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
