"""Exported controllers beside the agent they come from: decision by decision, and flown in the loop.

    python validation/exports.py --agent phase1 phase2 --cases 1000

For C and for ONNX: the largest difference of an action over 10,000 observations; the verdicts (settled, violated) over
the first cases of ``koz evaluate``, which may differ only where a case is within rounding of a threshold; for C, the
time and the memory per decision.  phase1 knows no zone: it is there because its verdicts vary.
"""

import dataclasses
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
import tyro

from koz_jax.agents.agent import Agent, load_agent
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.base import checked
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.evaluation.cases import fly_cases
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.export.files import export, write_files
from koz_jax.export.golden import golden
from koz_jax.export.library import CLibrary
from koz_jax.export.loop import HostController
from koz_jax.storage import runtime

_OBSERVATIONS = 10_000
_ACTION_RANGE = 2.0
_ROUNDING_DEG = 1e-3  # what rounding makes of a margin or a pointing error over a maneuver, with room to spare


@dataclasses.dataclass(frozen=True)
class ExportsArgs:
    """Compare exported controllers with the agent."""

    agent: tuple[str, ...] = ("phase1", "phase2")
    """Shipped agents by name, or folders."""
    cases: int = 1000
    """Cases flown in the loop."""
    seed: int = 0
    """Seed of the draw."""


def main(argv: list[str]) -> int:
    return exit_status(lambda: compare(tyro.cli(ExportsArgs, args=argv, prog="validation/exports.py")))


def compare(args: ExportsArgs) -> int:
    config = checked(MonteCarloConfig, cases=args.cases, seed=args.seed)
    runtime.configure()
    return 0 if all([compare_agent(load_agent(name), config) for name in args.agent]) else 1


def compare_agent(agent: Agent, config: MonteCarloConfig) -> bool:
    flown = fly_cases(agent.controller, agent.task, config)
    print(f"{agent.name}: {verdicts(flown)}")
    with tempfile.TemporaryDirectory() as folder:
        write_files(Path(folder), export(agent, "c"))
        c_agrees = check("C", CLibrary(folder).decide, agent, flown, config)
        cost(Path(folder))
    session = onnxruntime.InferenceSession(export(agent, "onnx")["koz_policy.onnx"])

    def ask(observed: np.ndarray) -> np.ndarray:
        return np.asarray(session.run(["action"], {"observation": observed})[0])

    return check("ONNX", ask, agent, flown, config) and c_agrees


def verdicts(flown: CaseResult) -> str:
    return f"settled {100 * np.mean(flown.settled):.2f} %, violated {100 * np.mean(flown.violated):.2f} %"


def check(
    name: str,
    predict: Callable[[np.ndarray], np.ndarray],
    agent: Agent,
    flown: CaseResult,
    config: MonteCarloConfig,
) -> bool:
    """Print one exported controller beside the agent.  Returns whether they agree."""
    vectors = golden(agent, _OBSERVATIONS, seed=1)
    difference = np.abs(predict(vectors.observation) - vectors.action).max() / _ACTION_RANGE
    start = time.perf_counter()
    network = agent.controller.network
    found = fly_cases(HostController(predict, network.observed_zones, network.scaled), agent.task, config)
    seconds = time.perf_counter() - start
    differing = np.flatnonzero((found.settled != flown.settled) | (found.violated != flown.violated))
    print(f"{name}: largest difference of an action over {_OBSERVATIONS} observations: {difference:.1e} of the range")
    print(
        f"{name} in the loop: {verdicts(found)}; {len(differing)} of {config.cases} verdicts differ ({seconds:.0f} s)"
    )
    print(
        f"{name} in the loop: largest difference of the smallest margin"
        f" {np.rad2deg(np.abs(found.min_margin - flown.min_margin).max()):.1e} deg, of the settling time"
        f" {np.nanmax(np.abs(found.settling_time - flown.settling_time)):.1f} s, of the effort"
        f" {np.abs(found.control_effort - flown.control_effort).max():.1e} N^2 m^2 s"
    )
    margin = np.rad2deg(flown.min_margin[differing])
    accuracy = np.rad2deg(flown.control_accuracy[differing])
    for row in zip(differing, margin, accuracy, strict=True):
        print("  case {}: smallest margin {:.2e} deg, pointing error at the end {:.4f} deg".format(*row))
    limit = agent.task.reward.settled_angle_deg
    excused = (np.abs(margin) < _ROUNDING_DEG) | (np.abs(accuracy - limit) < _ROUNDING_DEG)
    return bool(difference < 1e-5 and np.all(excused))


def cost(folder: Path) -> None:
    """Print the time of the self-test, and the memory by the compiler's own account."""
    for target in ("test", "size"):
        made = subprocess.run(["make", "-s", "-C", folder, target], capture_output=True, text=True, check=True)
        print("\n".join(f"  {line}" for line in made.stdout.splitlines()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
