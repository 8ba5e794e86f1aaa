"""The agent for any spacecraft: random spacecraft and the paper's, at several urgencies, rate limits, with the shield.

    python benchmarks/any_spacecraft.py [--agent NAME] [--cases N] [--seed N] [--only TITLE ...] [--markdown FILE]

Times and efforts are in the units of the paper's spacecraft.  Zones are checked at every step, under the shield at five
instants of it.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import stamp

from koz_jax.agents.agent import load_agent
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import TaskConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.evaluation.cases import fly_cases
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.storage import runtime

COLUMNS = ("spacecraft", "urgency", "cases", "success", "violated", "settling time [s]", "effort [N² m² s]")
COLUMNS += ("error at the end, 99 % [deg]", "rate limit passed", "at rest", "variation of torque [N m]")

# Errors that an engineer would state, the disturbance half a per cent of the torque limit.
ERRORS = {
    "errors": UncertaintyConfig(
        inertia_error=0.1, disturbance_torque=0.01, attitude_noise_deg=0.01, rate_noise_deg=0.001
    ),
    "delay_steps": (0, 2),
}

# A rate limit counts as passed above this factor of it, and a body as at rest below this mean squared action.
_PASSED, _AT_REST = 1.01, 1e-4


@dataclasses.dataclass(frozen=True)
class Trial:
    """Some cases at some urgencies."""

    title: str
    task: TaskConfig
    urgencies: tuple[float, ...] = (0.5,)
    shielded: bool = False

    @property
    def limit_deg(self) -> float | None:
        """Rate limit [deg/s] that all cases have."""
        spread = self.task.spread.max_rate_deg
        return spread[0] if spread else None


def trials() -> Iterator[Trial]:
    """Everything that is flown."""
    anyone = SpreadConfig(spacecraft=True)
    yield Trial("random", TaskConfig(spread=anyone), (0.0, 0.25, 0.5, 0.75, 1.0))
    yield Trial("random, shield", TaskConfig(spread=anyone), shielded=True)
    slender = anyone.model_copy(update={"slenderness": (0.05, 0.1)})
    yield Trial("random, slender", TaskConfig(spread=slender))
    yield Trial("random, with errors", TaskConfig(spread=anyone.model_copy(update={**ERRORS})))
    several = anyone.model_copy(update={"zones": (1, 4)})
    many = several.model_copy(update={"instruments": 3, "keep_in": 0.2})
    for spread, title in ((several, "1 to 4 zones"), (many, "1 to 4 zones, 3 instruments")):
        yield Trial(f"random, {title}", TaskConfig(spread=spread))
        yield Trial(f"random, {title}, shield", TaskConfig(spread=spread), shielded=True)
    yield Trial("the paper's", TaskConfig(), (0.0, 0.25, 0.5, 0.75, 1.0))
    for limit_deg in (2.0, 5.0, 10.0, 20.0):
        limited = anyone.model_copy(update={"max_rate_deg": (limit_deg, limit_deg)})
        task = TaskConfig(spread=limited, episode_seconds=300.0 if limit_deg < 5.0 else 200.0)
        yield Trial(f"random, at most {limit_deg:g} deg/s", task)
        yield Trial(f"random, at most {limit_deg:g} deg/s, shield", task, shielded=True)
    for wheels, title in (("three", "three wheels"), ("pyramid", "four wheels in a pyramid")):
        task = TaskConfig(spread=anyone.model_copy(update={"wheels": wheels}), episode_seconds=200.0)
        yield Trial(f"random, {title}", task)
        yield Trial(f"random, {title}, shield", task, shielded=True)


def cells(trial: Trial, urgency: float, results: CaseResult) -> list[str]:
    """A row of the table."""
    settled = np.asarray(results.settled)
    passed = "-"
    if trial.limit_deg is not None:
        passed = f"{100 * np.mean(results.peak_rate > _PASSED * np.deg2rad(trial.limit_deg)):.2f} %"
    times, efforts = np.asarray(results.settling_time)[settled], np.asarray(results.control_effort)[settled]
    return [
        trial.title,
        f"{urgency:g}",
        str(len(settled)),
        f"{100 * np.mean(results.success):.2f} %",
        f"{100 * np.mean(results.violated):.2f} %",
        f"{times.mean():.2f} ± {times.std():.2f}",
        f"{efforts.mean():.1f} ± {efforts.std():.1f}",
        f"{np.rad2deg(np.percentile(results.control_accuracy, 99)):.4f}",
        passed,
        f"{100 * np.mean(results.unrest <= _AT_REST):.2f} %",
        f"{np.mean(results.torque_variation):.1f}",
    ]


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/any_spacecraft.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--agent", default="universal", help="name or folder of an agent for any spacecraft")
    parser.add_argument("--cases", type=int, default=10_000, help="cases of each row")
    parser.add_argument("--seed", type=int, default=1, help="seed of the draw")
    parser.add_argument("--only", nargs="*", default=[], metavar="TITLE", help="rows of these titles only")
    parser.add_argument("--markdown", type=Path, help="write the table with its origin, for docs/results/")
    args = parser.parse_args(argv)
    return exit_status(lambda: _fly_all(args))


def _fly_all(args: argparse.Namespace) -> int:
    runtime.configure()
    agent = load_agent(args.agent)
    order = [(trial.title, f"{urgency:g}") for trial in trials() for urgency in trial.urgencies]
    table = stamp.GrowingTable(args.markdown, "benchmarks/any_spacecraft.py", COLUMNS, order)
    for trial in trials():
        if args.only and trial.title not in args.only:
            continue
        shield, substeps = (ShieldConfig(), 5) if trial.shielded else (None, 1)
        config = MonteCarloConfig(cases=args.cases, seed=args.seed, shield=shield, substeps=substeps)
        for urgency in trial.urgencies:
            results = fly_cases(agent.with_urgency(urgency).controller, trial.task, config)
            table.add(cells(trial, urgency, results))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
