"""What the shield guarantees, tried: controllers that do their worst, from rest and at speed, with and without errors.

    python benchmarks/guarantee.py [--cases N]

Counts the cases in which the boresight enters a zone, checked at five instants per time step.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys

import numpy as np

from koz_jax import evaluation, runtime
from koz_jax.controllers.registry import ROGUES, load_controller
from koz_jax.errors import exit_status
from koz_jax.evaluation import MonteCarloConfig
from koz_jax.shield_config import ShieldConfig, UncertaintyConfig

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
    Trial("robust shield, with errors", ShieldConfig(withstands=ERRORS), ERRORS),
    Trial("shield, 3 zones", ShieldConfig(), zones=3),
)


def fly(name: str, trial: Trial, cases: int) -> str:
    """Violations and the smallest margin [deg] of one cell."""
    pilot = load_controller(name)
    flown = pilot.task.with_rules(zones=trial.zones, max_rate_deg=trial.max_rate_deg)
    config = MonteCarloConfig(cases, substeps=5, shield=trial.shield, uncertainty=trial.uncertainty)
    results = evaluation.fly_cases(pilot.controller, flown, config)
    return f"{int(np.sum(results.violated))} ({np.rad2deg(np.min(results.min_margin)):.3f} deg)"


def _try_all(cases: int) -> int:
    runtime.configure()
    print(f"violations in {cases} cases (smallest margin)\n")
    print("|", *(f"| {trial.title}" for trial in TRIALS), "|")
    print("|---" * (len(TRIALS) + 1) + "|")
    for name in ROGUES:
        print("|", " | ".join([name, *(fly(name, trial, cases) for trial in TRIALS)]), "|", flush=True)
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="benchmarks/guarantee.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=int, default=10_000)
    arguments = parser.parse_args()
    sys.exit(exit_status(lambda: _try_all(arguments.cases)))
