"""What the shield guarantees, tried: controllers that do their worst, from rest and at speed, with and without errors.

    python benchmarks/guarantee.py [--cases N] [--markdown FILE]

Counts the cases in which the boresight enters a zone, checked at five instants per time step.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np
import stamp

from koz_jax.cli.exit_status import exit_status
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig, UncertaintyConfig
from koz_jax.control.registry import ADVERSARIAL, load_controller
from koz_jax.evaluation.cases import fly_cases
from koz_jax.storage import runtime

ERRORS = UncertaintyConfig(inertia_error=0.1, disturbance_torque=0.01, attitude_noise_deg=0.01, rate_noise_deg=0.001)


@dataclasses.dataclass(frozen=True)
class Trial:
    """One column of the table."""

    title: str
    shield: ShieldConfig | None
    uncertainty: UncertaintyConfig | None = None
    max_rate_deg: float | None = None
    zones: int = 1


TRIALS = (
    Trial("no shield", None),
    Trial("shield", ShieldConfig()),
    Trial("shield, initial rates up to 10 deg/s per axis", ShieldConfig(), max_rate_deg=10.0),
    Trial("robust shield, with errors", ShieldConfig(error_bounds=ERRORS), ERRORS),
    Trial("shield, 3 zones", ShieldConfig(), zones=3),
)


def fly(name: str, trial: Trial, cases: int) -> str:
    """Violations and the smallest margin [deg] of one cell."""
    flown = load_controller(name)
    task = flown.task.with_rules(zones=trial.zones, max_rate_deg=trial.max_rate_deg)
    config = MonteCarloConfig(cases=cases, substeps=5, shield=trial.shield, uncertainty=trial.uncertainty)
    results = fly_cases(flown.controller, task, config)
    return f"{int(np.sum(results.violated))} ({np.rad2deg(np.min(results.min_margin)):.3f} deg)"


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/guarantee.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--markdown", type=Path, help="write the table with its origin, for docs/results/")
    args = parser.parse_args(argv)
    return exit_status(lambda: _try_all(args.cases, args.markdown, argv))


def _try_all(cases: int, markdown: Path | None, argv: list[str]) -> int:
    runtime.configure()
    print(f"violations in {cases} cases (smallest margin)\n")
    lines = [_row(["", *(trial.title for trial in TRIALS)]), _row(["---"] * (len(TRIALS) + 1))]
    print("\n".join(lines))
    for name in ADVERSARIAL:
        lines.append(_row([name, *(fly(name, trial, cases) for trial in TRIALS)]))
        print(lines[-1], flush=True)
    if markdown:
        stamp.write_table(markdown, ["benchmarks/guarantee.py", *argv], "\n".join(lines))
    return 0


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
