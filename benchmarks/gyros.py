"""Controllers on a pyramid of control moment gyros, over many cases, with the steps near singular arrangements counted.

    python benchmarks/gyros.py [FILE] [--cases N] [--only NAME ...] [--markdown FILE]

FILE is a spacecraft or maneuver file with gyros.  The last column is the torque that was missing: the norm of what was
asked for less what was given, as a share of the torque limit, over the steps near singular arrangements.
"""

from __future__ import annotations

import argparse
import functools
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import stamp

from koz_jax.agents.agent import load_agent
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.maneuvers.maneuver_file import load_spacecraft
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.base import Controller
from koz_jax.control.registry import load_controller
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases, rollout
from koz_jax.evaluation.rollout import CaseResult, History
from koz_jax.storage import runtime
from koz_jax.task.actuators import ControlMomentGyros
from koz_jax.task.environment import Reorientation
from koz_jax.task.gyros.gimbals import SINGULAR
from koz_jax.task.scenario import Scenario

SPACECRAFT = Path(__file__).resolve().parent.parent / "examples" / "cmg_smallsat.toml"
CONTROLLERS = ("universal", "pd")
COLUMNS = ("controller", "actuators", "cases", "success", "not settled", "violated", "settling time [s]")
COLUMNS += (
    "peak rate [deg/s]",
    "singular steps",
    "cases with any",
    "lowest manipulability [h³]",
    "largest momentum [h]",
)
_CHUNK = 100


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, None, 0, 0))
def _fly(
    env: Reorientation, controller: Controller, drawn: Scenario, key: jax.Array
) -> tuple[CaseResult, jax.Array, jax.Array]:
    """Returns the result, and of every instant the manipulability and the momentum that the gyros hold [h]."""
    history, result = rollout.fly_and_judge(env, controller, drawn, substeps=5, key=key)
    return result, *_of_gyros(env, history)


def _of_gyros(env: Reorientation, history: History) -> tuple[jax.Array, jax.Array]:
    actuators = env.model.actuators
    if not isinstance(actuators, ControlMomentGyros):
        return jnp.full(len(history.zone_margin), jnp.inf), jnp.zeros(len(history.zone_margin))
    angles, gimbals = history.state.actuators.angles, actuators.gimbals
    held_B = jax.vmap(gimbals.momentum)(angles) / gimbals.unit
    return jax.vmap(gimbals.manipulability)(angles), jnp.linalg.norm(held_B, axis=1)


def fly(name: str, task: TaskConfig, what: str, count: int) -> list[str]:
    """Fly a row of the table."""
    controller = load_agent(name).controller if name == "universal" else load_controller(name, task).controller
    config = MonteCarloConfig(cases=count)
    env = cases.environment(task, config)
    found = []
    for first in range(0, count, _CHUNK):
        numbers = range(first, min(first + _CHUNK, count))
        drawn = [cases.draw_case(task, config, jnp.int32(case)) for case in numbers]
        stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *drawn)
        keys = jax.vmap(jax.random.key)(jnp.array(numbers))
        found.append(jax.tree.map(np.asarray, _fly(env, controller, stack, keys)))
    result, manipulability, held = jax.tree.map(lambda *leaves: np.concatenate(leaves), *found)
    singular = manipulability < SINGULAR
    settled = result.settling_time[result.settled]
    return [
        name,
        what,
        str(count),
        f"{100 * np.mean(result.success):.1f} %",
        f"{100 * np.mean(~result.settled):.1f} %",
        f"{100 * np.mean(result.violated):.1f} %",
        f"{settled.mean():.1f}" if settled.size else "-",
        f"{np.rad2deg(result.peak_rate.max()):.2f}",
        f"{100 * np.mean(singular):.2f} %",
        f"{100 * np.mean(np.any(singular, axis=1)):.1f} %",
        f"{manipulability.min():.3f}" if np.isfinite(manipulability.min()) else "-",
        f"{held.max():.2f}",
    ]


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/gyros.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("file", nargs="?", type=Path, default=SPACECRAFT, help="spacecraft with gyros")
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--only", nargs="*", help="names of the controllers; by default all of the table")
    parser.add_argument("--markdown", type=Path, help="write the table, or add to it, for docs/results/")
    args = parser.parse_args(argv)
    return exit_status(lambda: _compare(args))


def _compare(args: argparse.Namespace) -> int:
    runtime.configure()
    on_gyros = load_spacecraft(args.file).task
    body = on_gyros.spacecraft
    if not body.gyros:
        raise SettingsError(f"file: must have a table [spacecraft.gyros], got {args.file} without one")
    without = body.model_copy(update={"gyros": (), "torque_limit": body.torque_limits})
    tasks = {"gyros": on_gyros, "torque box": on_gyros.model_copy(update={"spacecraft": without})}
    names = args.only or CONTROLLERS
    order = [(name, what) for name in dict.fromkeys([*CONTROLLERS, *names]) for what in tasks]
    table = stamp.GrowingTable(args.markdown, "benchmarks/gyros.py", COLUMNS, order)
    for name in names:
        for what, task in tasks.items():
            table.add(fly(name, task, what, args.cases))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
