"""Safety filters over the same cases: nothing, the shield, and the control-barrier-function filter zoh_cbf.

    python benchmarks/filters.py [--cases N] [--only NAME ...] [--markdown FILE]

Zones are checked at five instants per time step.  The time per decision is that of one maneuver alone, on one core; of
adversaries, which are all compiled together, it is not told.
The file is written after each row, and keeps the rows of others.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import stamp

from koz_jax.agents.agent import load_agent
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.filters import FilterConfig, ZohCbfConfig
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.adversarial import AnyAdversary
from koz_jax.control.base import Controller
from koz_jax.control.registry import ADVERSARIAL, load_controller
from koz_jax.evaluation import cases, timing
from koz_jax.evaluation.summary import summarise
from koz_jax.storage import runtime

SUBSTEPS = 5
CONTROLLERS = ("pd", "phase2", "universal", *ADVERSARIAL)
FILTERS: tuple[FilterConfig | None, ...] = (None, ShieldConfig(), ZohCbfConfig())
COLUMNS = ("controller", "under", "cases", "violated", "smallest margin [deg]", "success", "settling time [s]")
COLUMNS += ("effort [N² m² s]", "acted", "infeasible steps", "in cases", "peak rate [deg/s]", "decision [us]")


def controller_named(name: str) -> Controller:
    """Load a controller, or the controller of an agent."""
    if name in ADVERSARIAL:
        return AnyAdversary.named(name)
    return (load_agent(name) if name in ("phase2", "universal") else load_controller(name)).controller


def under(config: FilterConfig | None) -> str:
    """What a row calls its filter."""
    return "-" if config is None else config.name


def fly(name: str, config: FilterConfig | None, count: int) -> list[str]:
    """Fly a row of the table, and time it."""
    controller, task = controller_named(name), TaskConfig()
    flown = cases.fly_cases(controller, task, MonteCarloConfig(cases=count, substeps=SUBSTEPS, shield=config))
    summary = summarise(flown)
    infeasible = np.asarray(flown.infeasible_steps)
    settles = np.any(flown.settled)
    return [
        name,
        under(config),
        str(count),
        str(int(np.sum(flown.violated))),
        f"{summary.min_margin_deg:.3f}",
        f"{100 * summary.success_rate:.1f} %",
        f"{summary.settling_time_mean:.2f}" if settles else "-",
        f"{summary.control_effort_mean:.1f}" if settles else "-",
        f"{100 * summary.intervention_rate:.1f} %",
        str(int(np.sum(infeasible))),
        str(int(np.sum(infeasible > 0))),
        f"{np.rad2deg(np.max(flown.peak_rate)):.1f}",
        "-" if name in ADVERSARIAL else f"{timing.decision_us(controller, task, config):.0f}",
    ]


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/filters.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--only", nargs="*", help="names of the controllers; by default all of the table")
    parser.add_argument("--markdown", type=Path, help="write the table, or add to it, for docs/results/")
    args = parser.parse_args(argv)
    return exit_status(lambda: _compare(args))


def _compare(args: argparse.Namespace) -> int:
    runtime.configure()
    names = args.only or CONTROLLERS
    order = [(name, under(config)) for name in dict.fromkeys([*CONTROLLERS, *names]) for config in FILTERS]
    table = stamp.GrowingTable(args.markdown, "benchmarks/filters.py", COLUMNS, order)
    for name in names:
        for config in FILTERS:
            table.add(fly(name, config, args.cases))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
