"""An agent trained for one spacecraft beside the shipped one for any: how much faster it settles at the same effort.

    python benchmarks/own_training.py --runs FOLDER [--preset NAME] [--cases N] [--only NAME ...] [--markdown FILE]

Three spacecraft: a CubeSat of 6 units and 12 kg, a telescope of 500 kg, a slender CubeSat of 3 units.  Each is trained
for as ``koz train --spacecraft FILE`` does; a run that the folder holds is gone on with.  ``universal`` then flies the
same cases at the urgency at which it takes the same effort.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NamedTuple

import stamp

from koz_jax.agents.agent import Agent, load_agent
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.maneuvers.maneuver_file import SpacecraftFile
from koz_jax.config.presets.named import preset
from koz_jax.config.presets.spacecraft import for_spacecraft
from koz_jax.config.task import TaskConfig
from koz_jax.evaluation.monte_carlo import monte_carlo
from koz_jax.evaluation.summary import summarise
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.trainer import train
from koz_jax.storage import runtime

COLUMNS = (
    "spacecraft",
    "agent",
    "urgency",
    "success",
    "settling time [T]",
    "effort [u² T]",
    "settling, times the other's",
)

# Uniform boxes: 0.34 x 0.23 x 0.10 m, a cylinder of 2.5 m by 1.2 m, 0.34 x 0.10 x 0.10 m.
SPACECRAFT = {
    "6U CubeSat, 12 kg": ((0.061, 0.126, 0.167), 0.004, (0.0, 0.0, 1.0), 0.1),
    "telescope, 500 kg": ((305.0, 305.0, 90.0), 0.2, (0.0, 0.0, 1.0), 1.0),
    "slender 3U CubeSat": ((0.0067, 0.0419, 0.0419), 0.002, (1.0, 0.0, 0.0), 0.1),
}  # moments [kg m2], torque limit of each axis [N m], instrument, time step [s]

# Steps of the search for the urgency, over so many cases each; an effort this near is the same.
_STEPS, _CASES, _SAME = 10, 1000, 0.005


class Flown(NamedTuple):
    """What some cases come to, in units of the spacecraft."""

    success: float
    settling: float  # [T]
    effort: float  # [u^2 T]


def task_of(name: str) -> TaskConfig:
    """The paper's draw of maneuvers for a spacecraft, in its units."""
    (x, y, z), torque_limit, boresight, step_seconds = SPACECRAFT[name]
    return SpacecraftFile.model_validate(
        {
            "step_seconds": step_seconds,
            "spacecraft": {
                "inertia": ((x, 0.0, 0.0), (0.0, y, 0.0), (0.0, 0.0, z)),
                "torque_limit": torque_limit,
            },
            "instruments": ({"name": "telescope", "boresight": boresight},),
        }
    ).task


def own_agent(task: TaskConfig, folder: Path, chosen: str) -> Agent:
    """Train for a spacecraft, or go on."""
    config = for_spacecraft(preset(chosen), task)
    train(config, folder, resume=RunFolder(folder).config.exists(), progress=False)
    return load_agent(folder)


def fly(agent: Agent, task: TaskConfig, cases: int) -> Flown:
    """Fly cases of a seed that nothing was trained on."""
    summary = summarise(monte_carlo(agent, cases=cases, task=task, seed=1).results)
    time, torque = task.spacecraft.time_unit, task.spacecraft.strength
    return Flown(
        summary.success_rate, summary.settling_time_mean / time, summary.control_effort_mean / (torque**2 * time)
    )


def urgency_of(effort: float, agent: Agent, task: TaskConfig) -> float:
    """Urgency at which an agent for any spacecraft takes an effort, by bisection; an end where it takes it nowhere."""
    low, middle, high = 0.0, 0.5, 1.0
    for _ in range(_STEPS):
        found = fly(agent.with_urgency(middle), task, _CASES).effort
        if abs(found / effort - 1.0) < _SAME:
            break
        low, high = (middle, high) if found < effort else (low, middle)
        middle = (low + high) / 2.0
    return middle


def cells(name: str, agent: str, urgency: str, flown: Flown, other: Flown) -> list[str]:
    """A row of the table."""
    return [
        name,
        agent,
        urgency,
        f"{100 * flown.success:.2f} %",
        f"{flown.settling:.3f}",
        f"{flown.effort:.3f}",
        f"{flown.settling / other.settling:.3f}",
    ]


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/own_training.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--preset", default="fast", help="preset of the trainings")
    parser.add_argument("--cases", type=int, default=2000, help="cases of each row")
    parser.add_argument(
        "--only", nargs="+", choices=SPACECRAFT, default=[*SPACECRAFT], help="spacecraft, by default all"
    )
    parser.add_argument("--markdown", type=Path, help="write the table with its origin, for docs/results/")
    args = parser.parse_args(argv)
    return exit_status(lambda: _compare(args, argv))


def _compare(args: argparse.Namespace, argv: list[str]) -> int:
    runtime.configure()
    lines = [stamp.row([*COLUMNS]), stamp.row(["---"] * len(COLUMNS))]
    print("\n".join(lines))
    for name in args.only:
        task = task_of(name)
        own = fly(own_agent(task, args.runs / name.split(",")[0].replace(" ", "-"), args.preset), task, args.cases)
        universal = load_agent("universal")
        urgency = urgency_of(own.effort, universal, task)
        shipped = fly(universal.with_urgency(urgency), task, args.cases)
        rows = [cells(name, "its own", "-", own, shipped), cells(name, "universal", f"{urgency:.3f}", shipped, own)]
        lines += [stamp.row(row) for row in rows]
        print("\n".join(lines[-2:]), flush=True)
    if args.markdown:
        stamp.write_table(args.markdown, ["benchmarks/own_training.py", *argv], "\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
