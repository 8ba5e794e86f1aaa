"""Everybody over the cases that others have published: the maneuver files of ``examples/`` that say what was reported.

    python benchmarks/published.py [--only WORD ...] [--controllers NAME ...] [--markdown FILE]

Constraints are checked at five instants of every step.  The file is written after each row, and keeps those of other
cases that it holds.
"""

import argparse
import sys
from pathlib import Path

import stamp

from koz_jax.agents.agent import load_agent
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.maneuvers.maneuver import ManeuverConfig
from koz_jax.config.maneuvers.maneuver_file import load_maneuver
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.control.base import TaskController
from koz_jax.control.registry import load_controller
from koz_jax.evaluation.digits import significant
from koz_jax.evaluation.maneuver import config_of, fly_closely, scenario
from koz_jax.storage import runtime

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
CONTROLLERS = (
    "universal",
    "planner",
    "potential",
    "sliding",
    "pd",
    "lee_mesbahi_pd",
    "lee_mesbahi_backstepping",
    "yang_sliding",
)
COLUMNS = ("case", "controller", "settling time [s]", "effort [N² m² s]", "smallest margin [deg]", "verdict")


def published() -> dict[str, ManeuverConfig]:
    """The maneuvers of which something was published, by the names of their files."""
    found = {path.stem: load_maneuver(path) for path in sorted(EXAMPLES.glob("*.toml"))}
    return {name: maneuver for name, maneuver in found.items() if maneuver.published is not None}


def reported(name: str, maneuver: ManeuverConfig) -> list[str]:
    """What others report of a case."""
    assert maneuver.published is not None
    told = maneuver.published
    figures = [told.settling_seconds, told.control_effort]
    return [name, told.by, *("-" if figure is None else f"{figure:g}" for figure in figures), "-", "published"]


def flown(name: str, maneuver: ManeuverConfig, controller: TaskController, shielded: bool) -> list[str]:
    """Fly a case."""
    config = config_of(maneuver, MonteCarloConfig(shield=ShieldConfig() if shielded else None))
    report = fly_closely(controller, scenario(maneuver), maneuver.task, config).report()
    verdict = "violated" if report["violated"] else "settled" if report["settled"] else "not settled"
    if report["deadlocked"]:
        verdict += ", deadlocked"
    return [
        name,
        controller.name + (" + shield" if shielded else ""),
        "-" if report["settling_time_s"] is None else significant(report["settling_time_s"], 1),
        significant(report["control_effort"], 2),
        f"{report['min_margin_deg']:.2f}",
        verdict,
    ]


def _fly_all(args: argparse.Namespace) -> int:
    runtime.configure()
    chosen = {name: one for name, one in published().items() if not args.only or name in args.only}
    everybody = [load_agent(name) if name == "universal" else load_controller(name) for name in CONTROLLERS]
    order = [
        (name, by)
        for name, one in published().items()
        for by in (
            one.published.by if one.published else "",
            *(f"{controller}{suffix}" for controller in CONTROLLERS for suffix in ("", " + shield")),
        )
    ]
    table = stamp.GrowingTable(args.markdown, "benchmarks/published.py", COLUMNS, order)
    for name, maneuver in chosen.items():
        table.add(reported(name, maneuver))
        for controller in everybody:
            for shielded in (False, True):
                if not args.controllers or controller.name in args.controllers:
                    table.add(flown(name, maneuver, controller, shielded))
    return 0


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/published.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[], help="names of maneuver files, by default all")
    parser.add_argument("--controllers", nargs="*", default=[], help=f"any of {', '.join(CONTROLLERS)}")
    parser.add_argument("--markdown", type=Path, help="write the table, or add to it, for docs/results/")
    return exit_status(lambda: _fly_all(parser.parse_args(argv)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
