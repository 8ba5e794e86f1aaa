"""What the shield guarantees, tried: controllers that do their worst, and common ones that it stops, in many settings.

    python benchmarks/guarantee.py [--only WORD ...] [--controllers NAME ...] [--scale SHARE] [--markdown FILE]

Zones are checked at five instants per time step.  A row counts the cases of which the guarantee is given: starts from
which it does not hold are counted apart.  All rows take hours; the file is written after each, and keeps the rows of
other trials that it holds, each with the commit that it was made at.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import Any

import numpy as np
import stamp

from koz_jax.agents.agent import load_agent
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import ScenarioConfig, TaskConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.control.adversarial import AnyAdversary
from koz_jax.control.base import Controller
from koz_jax.control.registry import ADVERSARIAL, load_controller
from koz_jax.evaluation.cases import fly_cases
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.storage import runtime

COMMON = ("pd", "planner", "phase2")
ERRORS = UncertaintyConfig(inertia_error=0.1, disturbance_torque=0.01, attitude_noise_deg=0.01, rate_noise_deg=0.001)
CUBESAT: dict[str, Any] = {
    "spacecraft": {
        "inertia": ((0.05, 0.0, 0.0), (0.0, 0.06, 0.0), (0.0, 0.0, 0.02)),
        "torque_limit": 0.004,
        "boresight": (0.0, 0.0, 1.0),
    },
    "scenario": {"min_half_angle_deg": 30.0, "max_half_angle_deg": 30.0},
}
COLUMNS = ("trial", "controller", "cases", "starts not covered", "violated", "smallest margin [deg]")
COLUMNS += ("not settled", "deadlocked", "shield acted")


@dataclasses.dataclass(frozen=True)
class Trial:
    """Some controllers over some cases."""

    title: str
    controllers: tuple[str, ...]
    cases: int
    task: TaskConfig = dataclasses.field(default_factory=TaskConfig)
    errors: UncertaintyConfig | None = None
    shielded: bool = True


def trials() -> list[Trial]:
    """Everything that is tried."""
    found = [Trial("no shield", ADVERSARIAL, 10_000, shielded=False)]
    for zones in (1, 2, 3, 4):
        task, cases = TaskConfig().with_rules(zones=zones), 10_000 if zones == 1 else 2_000
        found.append(Trial(_zones(zones), (*ADVERSARIAL, *COMMON), cases, task))
    found.append(
        Trial("starts at up to 10 deg/s per axis", ADVERSARIAL, 10_000, TaskConfig().with_rules(max_rate_deg=10.0))
    )
    found.append(Trial("errors of all kinds", (*ADVERSARIAL, "phase2"), 10_000, errors=ERRORS))
    found += [Trial(f"random spacecraft, {title}", ADVERSARIAL, 10_000, task) for title, task in _random().items()]
    for step in (0.05, 0.1, 0.2, 0.5):
        task = TaskConfig.model_validate({**CUBESAT, "step_seconds": step})
        found.append(Trial(f"6U CubeSat, steps of {step:g} s", ("adversary", "pd"), 1_000, task))
    for zones in (1, 2, 3, 4):
        task = TaskConfig.model_validate(
            {**TaskConfig().with_rules(zones=zones).model_dump(), "episode_seconds": 300.0}
        )
        for disturbance in (0.01, 0.05, 0.2):
            errors = UncertaintyConfig(disturbance_torque=disturbance)
            title = f"disturbance of {disturbance:g} N m for 300 s, {_zones(zones)}"
            found.append(Trial(title, ("adversary",), 500, task, errors))
    return found


def _random() -> dict[str, TaskConfig]:
    """Tasks in which every case is of another spacecraft, by what they have."""
    anyone = SpreadConfig(spacecraft=True)

    def of(scenario: ScenarioConfig | None = None, **changes: Any) -> TaskConfig:
        return TaskConfig(spread=anyone.model_copy(update=changes), scenario=scenario or ScenarioConfig())

    return {
        "1 to 4 zones": of(zones=(1, 4)),
        "slender, 1 to 4 zones": of(zones=(1, 4), slenderness=(0.05, 0.1)),
        "four wheels in a pyramid with a bias": of(wheels="pyramid"),
        "8 zones of 3 instruments, some to be kept in": of(zones=(8, 8), instruments=3, keep_in=0.4),
        "at most 5 deg/s": of(max_rate_deg=(5.0, 5.0)),
        "zones that turn by 0.2 deg/s": of(ScenarioConfig(cone_rate_deg=0.2)),
        "steps of 0.05 to 1 T": of(step_shares=(0.05, 1.0)),
        "zones of 2 to 89 deg": of(ScenarioConfig(min_half_angle_deg=2.0, max_half_angle_deg=89.0)),
        "0.1 deg between zones, start and target": of(
            ScenarioConfig(separation_deg=0.1, zone_gap_deg=0.0, infeasible_zone="shrink"), zones=(1, 4)
        ),
    }


def _zones(count: int) -> str:
    return f"{count} zone{'s' if count > 1 else ''}"


def controller_named(name: str) -> Controller:
    """Load a controller or the controller of an agent."""
    if name in ADVERSARIAL:
        return AnyAdversary.named(name)
    return load_agent(name).controller if name == "phase2" else load_controller(name).controller


def fly(name: str, trial: Trial, scale: float) -> list[str]:
    """Fly one row of the table.  scale: share of its cases."""
    shield = ShieldConfig(error_bounds=trial.errors or UncertaintyConfig()) if trial.shielded else None
    cases = max(int(scale * trial.cases), 1)
    config = MonteCarloConfig(cases=cases, substeps=5, shield=shield, uncertainty=trial.errors)
    return [trial.title, name, *_cells(fly_cases(controller_named(name), trial.task, config))]


def _cells(results: CaseResult) -> list[str]:
    covered = ~np.asarray(results.unsafe_start)
    violated = np.asarray(results.violated)[covered]
    return [
        str(len(covered)),
        str(int(np.sum(~covered))),
        str(int(np.sum(violated))),
        f"{np.rad2deg(np.min(np.asarray(results.min_margin)[covered])):.3f}",
        f"{100 * np.mean(~np.asarray(results.settled)):.2f} %",
        f"{100 * np.mean(results.deadlocked):.2f} %",
        f"{100 * np.mean(results.intervention_rate):.2f} %",
    ]


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/guarantee.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[], help="words that a trial's title must hold, any of them")
    parser.add_argument("--controllers", nargs="*", default=[], help="names of controllers, by default all of a trial")
    parser.add_argument("--scale", type=float, default=1.0, help="share of the cases")
    parser.add_argument("--markdown", type=Path, help="write the table, or add to it, for docs/results/")
    args = parser.parse_args(argv)
    return exit_status(lambda: _try_all(args))


def _try_all(args: argparse.Namespace) -> int:
    runtime.configure()
    order = [(trial.title, name) for trial in trials() for name in trial.controllers]
    table = stamp.GrowingTable(args.markdown, "benchmarks/guarantee.py", COLUMNS, order)
    for trial in trials():
        if args.only and not any(word in trial.title for word in args.only):
            continue
        for name in trial.controllers:
            if not args.controllers or name in args.controllers:
                table.add(fly(name, trial, args.scale))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
