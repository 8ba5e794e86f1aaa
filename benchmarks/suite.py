"""Everybody over published maneuvers and over random cases, as ``koz evaluate --suite``: one table for the docs.

    python benchmarks/suite.py [--controllers NAME ...] [--unfiltered] [--cases N] [--markdown FILE]

The file is written after each row, and keeps the rows of others.  Times per decision and for planning are of one
maneuver alone, on one core.
"""

import argparse
import sys
from pathlib import Path

import stamp

from koz_jax.agents import suite
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.storage import runtime

FILTERS: tuple[suite.Under, ...] = (None, "shield")
SUBSTEPS = 5


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/suite.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--controllers", nargs="*", default=suite.EVERYBODY, help="by default everybody")
    parser.add_argument("--unfiltered", action="store_true", help="fly without a filter only")
    parser.add_argument("--cases", type=int, default=1000, help="random cases of the paper's task")
    parser.add_argument("--markdown", type=Path, help="write the table, or add to it, for docs/results/")
    args = parser.parse_args(argv)
    return exit_status(lambda: _fly_all(args))


def _fly_all(args: argparse.Namespace) -> int:
    runtime.configure()
    maneuvers = suite.load_suite()
    order = list(suite.labels(maneuvers, suite.EVERYBODY, FILTERS))
    table = stamp.GrowingTable(args.markdown, "benchmarks/suite.py", suite.COLUMNS, order)
    draw = MonteCarloConfig(cases=args.cases, substeps=SUBSTEPS)
    under = (None,) if args.unfiltered else FILTERS
    for flight in suite.fly_suite(maneuvers, args.controllers, under, draw):
        table.add(flight.row.cells())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
