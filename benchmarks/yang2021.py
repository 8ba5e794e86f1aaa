"""Yang et al.'s published maneuver with the torque limit and the time step that are lost, tried one beside the other.

    python benchmarks/yang2021.py [--markdown FILE]

Energies are over 150 s, as published.  1000 N m stand for no limit.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import stamp

import koz_jax
from koz_jax.agents.suite import load_suite
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.maneuvers.maneuver import ManeuverConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.registry import NamedController, load_controller
from koz_jax.storage import runtime

CONTROLLERS = ("yang_sliding", "lee_mesbahi_pd", "lee_mesbahi_backstepping")

# Torque limit [N m] and time step [s].
CONDITIONS = ((2.0, 0.1), (2.0, 0.01), (1000.0, 0.01), (1000.0, 0.003))

# Gains are in units of the spacecraft flown, u and T ~ u^-1/2: powers of u that leave them as published.
POWERS = {
    "stiffness": -1.0,
    "switching": -1.0,
    "damping": -0.5,
    "reach": -0.5,
    "slide": -0.5,
    "layer": -0.5,
    "rate": -0.5,
}
PUBLISHED_LIMIT = 2.0  # [N m] for which they are

COLUMNS = ("controller", "torque limit [N m]", "time step [s]", "settling time [s]", "energy [N² m² s]", "margin [deg]")


def flown(controller: str, limit: float, step: float) -> list[str]:
    """A row of the table."""
    given = load_suite()["yang2021"].model_dump()
    changes = {
        "step_seconds": step,
        "duration_seconds": 150.0,
        "spacecraft": given["spacecraft"] | {"torque_limit": limit},
    }
    law: Any = load_controller(controller).controller
    share = limit / PUBLISHED_LIMIT
    gains = {name: getattr(law, name) * share**power for name, power in POWERS.items() if hasattr(law, name)}
    flying = NamedController(controller, law.replace(**gains), TaskConfig())
    report = koz_jax.fly(ManeuverConfig.model_validate(given | changes), flying).report()
    settling, effort = (report[name] for name in ("settling_time_s", "control_effort"))
    shown = "-" if settling is None else f"{settling:.1f}"
    return [controller, f"{limit:g}", f"{step:g}", shown, f"{effort:.1f}", f"{report['min_margin_deg']:.2f}"]


def _fly_all(args: argparse.Namespace, argv: list[str]) -> int:
    runtime.configure()
    lines = [stamp.row(list(COLUMNS)), stamp.row(["---"] * len(COLUMNS))]
    lines.append(stamp.row(["published: sliding; Lee & Mesbahi's", "lost", "lost", "70", "113.4; 268.5", "-"]))
    print("\n".join(lines))
    for controller in CONTROLLERS:
        for limit, step in CONDITIONS:
            lines.append(stamp.row(flown(controller, limit, step)))
            print(lines[-1], flush=True)
    if args.markdown:
        stamp.write_table(args.markdown, ["benchmarks/yang2021.py", *argv], "\n".join(lines))
    return 0


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/yang2021.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--markdown", type=Path, help="write the table with its origin, for docs/results/")
    return exit_status(lambda: _fly_all(parser.parse_args(argv), argv))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
