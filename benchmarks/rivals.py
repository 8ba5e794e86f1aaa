"""Agents and classical controllers over the same cases, with and without the shield: one table.

    python benchmarks/rivals.py [--zones N] [--cases N] [--only NAME ...] [--markdown FILE]

The file is written after each row, and keeps the rows of others.  Zones are checked at five instants per time step.
The time per decision is that of one maneuver alone, on one core.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import stamp

from koz_jax.agents.agent import load_agent
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.base import TaskController
from koz_jax.control.registry import ADVERSARIAL, CLASSICAL, LEARNED, load_controller
from koz_jax.evaluation import cases, timing
from koz_jax.evaluation.summary import summarise
from koz_jax.storage import runtime

SUBSTEPS = 5

# What a controller flies under: nothing, or the shield.
FILTERS = ("-", "shield")


FIGURES = (
    ("mean reward", lambda s: f"{s.mean_reward:.0f} ± {s.std_reward:.0f}"),
    ("settling time [s]", lambda s: f"{s.settling_time_mean:.2f} ± {s.settling_time_std:.2f}"),
    ("effort [N² m² s]", lambda s: f"{s.control_effort_mean:.1f} ± {s.control_effort_std:.1f}"),
    ("accuracy [deg]", lambda s: f"{s.control_accuracy_deg_mean:.4f}"),
    ("not settled", lambda s: f"{100 * s.non_settled_rate:.2f} %"),
    ("violated", lambda s: f"{100 * s.violation_rate:.2f} %"),
    ("success", lambda s: f"{100 * s.success_rate:.2f} %"),
    ("smallest margin [deg]", lambda s: f"{s.min_margin_deg:.2f}"),
    ("shield acted", lambda s: f"{100 * s.intervention_rate:.2f} %"),
    ("deadlocked", lambda s: f"{100 * s.deadlock_rate:.2f} %"),
)


def fly(flown: TaskController, task: TaskConfig, count: int, shield: ShieldConfig | None) -> list[str]:
    """Fly a controller over the cases, and time it.  Returns its row."""
    config = MonteCarloConfig(cases=count, substeps=SUBSTEPS, shield=shield)
    summary = summarise(cases.fly_cases(flown.controller, task, config))
    decision = timing.decision_us(flown.controller, task, shield)
    return [
        flown.name,
        FILTERS[shield is not None],
        str(count),
        *(show(summary) for _, show in FIGURES),
        f"{decision:.1f}",
    ]


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/rivals.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--zones", type=int, default=1, help="zones of every case")
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--adversarial", action="store_true", help="also the controllers that try the shield")
    parser.add_argument("--only", nargs="*", help="names of the controllers; by default all")
    parser.add_argument("--markdown", type=Path, help="write the table, or add to it, for docs/results/")
    args = parser.parse_args(argv)
    return exit_status(lambda: _compare(args))


def _compare(args: argparse.Namespace) -> int:
    runtime.configure()
    agents = ["zones3"] if args.zones > 1 else ["phase2", "phase2-sac", "zones3"]
    everybody = [*agents, *CLASSICAL, *LEARNED, *ADVERSARIAL]
    names = args.only or [*agents, *CLASSICAL, *LEARNED, *(ADVERSARIAL if args.adversarial else ())]
    order = [(name, under) for name in dict.fromkeys([*everybody, *names]) for under in FILTERS]
    columns = ("controller", "under", "cases", *(name for name, _ in FIGURES), "decision [us]")
    program = "benchmarks/rivals.py" + (f" --zones {args.zones}" if args.zones > 1 else "")
    table = stamp.GrowingTable(args.markdown, program, columns, order)
    for name in names:
        untrained = name in (*CLASSICAL, *LEARNED, *ADVERSARIAL)
        flown = load_controller(name) if untrained else load_agent(name)
        task = flown.task.with_rules(zones=args.zones)
        for shield in (None, ShieldConfig()):
            table.add(fly(flown, task, args.cases, shield))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
