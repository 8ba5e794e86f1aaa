"""Agents and classical controllers over the same cases, with and without the shield: one table.

    python benchmarks/rivals.py [--zones N] [--cases N] [--json FILE] [--markdown FILE]

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
import stamp

from koz_jax.agents.agent import load_agent
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.base import Controller, Memoryless, TaskController
from koz_jax.control.registry import ADVERSARIAL, CLASSICAL, load_controller
from koz_jax.evaluation import cases, rollout
from koz_jax.evaluation.summary import Summary, summarise
from koz_jax.storage import files, runtime
from koz_jax.task import scenario
from koz_jax.task.state import EnvState, Model

SUBSTEPS = 5


@dataclasses.dataclass(frozen=True)
class Row:
    """One controller of the table."""

    name: str
    shielded: bool
    summary: Summary
    decision_us: float


COLUMNS = (
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


def decision_us(controller: Controller, task: TaskConfig, shield: ShieldConfig | None) -> float:
    """Microseconds per decision, shield included: a maneuver's time, less that of one in which nothing is decided."""
    drawn = scenario.paper_test()

    def seconds(flown: Controller, shield: ShieldConfig | None) -> float:
        env = cases.environment(task, MonteCarloConfig(shield=shield))
        run = jax.jit(lambda env, who: rollout.run_case(env, who, drawn).reward)
        jax.block_until_ready(run(env, flown))
        times = []
        for _ in range(5):
            start = time.perf_counter()
            jax.block_until_ready(run(env, flown))
            times.append(time.perf_counter() - start)
        return min(times)

    return 1e6 * (seconds(controller, shield) - seconds(_Idle(), None)) / task.episode_steps


class _Idle(Memoryless):
    """Decides nothing."""

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """No torque."""
        return jnp.zeros(3), memory


def evaluate(flown: TaskController, task: TaskConfig, count: int, shield: ShieldConfig | None) -> Row:
    """Fly a controller over the cases and time it."""
    config = MonteCarloConfig(cases=count, substeps=SUBSTEPS, shield=shield)
    summary = summarise(cases.fly_cases(flown.controller, task, config))
    return Row(flown.name, shield is not None, summary, decision_us(flown.controller, task, shield))


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
    parser.add_argument("--adversarial", action="store_true", help="also the controllers that try the shield")
    parser.add_argument("--only", nargs="*", help="names of the controllers; by default all")
    parser.add_argument("--json", type=Path, help="write the rows as JSON")
    parser.add_argument("--markdown", type=Path, help="write the table with its origin, for docs/results/")
    args = parser.parse_args(argv)
    return exit_status(lambda: _compare(args, argv))


def _compare(args: argparse.Namespace, argv: list[str]) -> int:
    runtime.configure()
    agents = ["zones3"] if args.zones > 1 else ["phase2", "phase2-sac", "zones3"]
    names = args.only or [*agents, *CLASSICAL, *(ADVERSARIAL if args.adversarial else ())]
    rows = []
    for name in names:
        untrained = name in (*CLASSICAL, *ADVERSARIAL)
        flown = load_controller(name) if untrained else load_agent(name)
        task = flown.task.with_rules(zones=args.zones)
        for shield in (None, ShieldConfig()):
            rows.append(evaluate(flown, task, args.cases, shield))
            print(markdown(rows[-1:]).splitlines()[-1], flush=True)
    table = markdown(rows)
    print(f"\n{args.cases} cases, zones per case: {args.zones}\n\n{table}")
    if args.json:
        files.write_json(args.json, {"rows": [dataclasses.asdict(row) for row in rows]})
    if args.markdown:
        stamp.write_table(args.markdown, ["benchmarks/rivals.py", *argv], table)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
