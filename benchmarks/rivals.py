"""Agents and classical controllers over the same cases, with and without the shield: one table.

    python benchmarks/rivals.py [--zones N] [--cases N] [--json FILE]

Zones are checked at five instants per time step.  The time per decision is that of one maneuver alone, on one core.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp

from koz_jax import evaluation, rollout, runtime, scenario, shield, storage, task
from koz_jax.agent import load_agent
from koz_jax.controllers.base import Controller, Memoryless, Pilot
from koz_jax.controllers.registry import CLASSICAL, ROGUES, load_controller
from koz_jax.env import EnvParams, EnvState
from koz_jax.errors import exit_status
from koz_jax.evaluation import MonteCarloConfig
from koz_jax.rollout import Conditions
from koz_jax.shield_config import ShieldConfig
from koz_jax.summary import Summary, summarise
from koz_jax.task_config import TaskConfig

SUBSTEPS = 5


@dataclasses.dataclass(frozen=True)
class Row:
    """One controller of the table."""

    name: str
    shielded: bool
    summary: Summary
    decision_us: float


COLUMNS = (
    ("mean reward", lambda s: f"{s.mean_reward:.0f} +- {s.std_reward:.0f}"),
    ("settling time [s]", lambda s: f"{s.settling_time_mean:.2f} +- {s.settling_time_std:.2f}"),
    ("effort [N2 m2 s]", lambda s: f"{s.control_effort_mean:.1f} +- {s.control_effort_std:.1f}"),
    ("accuracy [deg]", lambda s: f"{s.control_accuracy_deg_mean:.4f}"),
    ("not settled", lambda s: f"{100 * s.non_settled_rate:.2f} %"),
    ("violated", lambda s: f"{100 * s.violation_rate:.2f} %"),
    ("success", lambda s: f"{100 * s.success_rate:.2f} %"),
    ("smallest margin [deg]", lambda s: f"{s.min_margin_deg:.2f}"),
    ("shield acted", lambda s: f"{100 * s.intervention_rate:.2f} %"),
    ("deadlocked", lambda s: f"{100 * s.deadlock_rate:.2f} %"),
)


def decision_us(controller: Controller, task_config: TaskConfig, guard: ShieldConfig | None) -> float:
    """Microseconds per decision, shield included: a maneuver's time, less that of one in which nothing is decided."""
    params = task.env_params(task_config)
    made = shield.for_spacecraft(guard, params.spacecraft, params.dt) if guard else None
    steps = task_config.episode_steps

    def seconds(flown: Controller, conditions: Conditions) -> float:
        run = jax.jit(lambda who, how: rollout.run_case(who, scenario.paper_test(), params, steps, 1, how).reward)
        jax.block_until_ready(run(flown, conditions))
        times = []
        for _ in range(5):
            start = time.perf_counter()
            jax.block_until_ready(run(flown, conditions))
            times.append(time.perf_counter() - start)
        return min(times)

    return 1e6 * (seconds(controller, Conditions(shield=made)) - seconds(_Idle(), Conditions())) / steps


class _Idle(Memoryless):
    """Decides nothing."""

    def decide(self, state: EnvState, params: EnvParams, memory: None) -> tuple[jax.Array, None]:
        """No torque."""
        return jnp.zeros(3), memory


def judge(pilot: Pilot, task_config: TaskConfig, cases: int, guard: ShieldConfig | None) -> Row:
    """Fly a controller over the cases and time it."""
    config = MonteCarloConfig(cases, substeps=SUBSTEPS, shield=guard)
    summary = summarise(evaluation.fly_cases(pilot.controller, task_config, config))
    return Row(pilot.name, guard is not None, summary, decision_us(pilot.controller, task_config, guard))


def markdown(rows: list[Row]) -> str:
    """The table, a row per controller."""
    head = ["", *(name for name, _ in COLUMNS), "decision [us]"]
    lines = [head, ["---"] * len(head)]
    for row in rows:
        name = f"{row.name} + shield" if row.shielded else row.name
        lines.append([name, *(show(row.summary) for _, show in COLUMNS), f"{row.decision_us:.1f}"])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/rivals.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--zones", type=int, default=1, help="zones of every case")
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--rogues", action="store_true", help="also those that do their worst")
    parser.add_argument("--only", nargs="*", help="names of the controllers; by default all")
    parser.add_argument("--json", type=Path, help="write the rows as JSON")
    args = parser.parse_args(argv)
    return exit_status(lambda: _compare(args))


def _compare(args: argparse.Namespace) -> int:
    runtime.configure()
    agents = ["zones3"] if args.zones > 1 else ["phase2", "phase2-sac", "zones3"]
    names = args.only or [*agents, *CLASSICAL, *(ROGUES if args.rogues else ())]
    rows = []
    for name in names:
        classical = name in (*CLASSICAL, *ROGUES)
        pilot = load_controller(name) if classical else load_agent(name)
        task_config = pilot.task.with_rules(zones=args.zones)
        for guard in (None, ShieldConfig()):
            rows.append(judge(pilot, task_config, args.cases, guard))
            print(markdown(rows[-1:]).splitlines()[-1], flush=True)
    print(f"\n{args.cases} cases, zones per case: {args.zones}\n\n{markdown(rows)}")
    if args.json:
        storage.write_json(args.json, {"rows": [dataclasses.asdict(row) for row in rows]})
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
