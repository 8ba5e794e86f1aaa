"""Judge a controller by Monte Carlo: ``python eval_mc.py``, ``python eval_mc.py --help`` for every setting."""

import dataclasses
import sys
from pathlib import Path
from typing import Literal

import tyro
from pydantic import ValidationError

from koz_jax.errors import UserError, explain


@dataclasses.dataclass(frozen=True)
class EvalArgs:
    """Fly a trained agent over many random cases and print the paper's table beside its own."""

    agent: str = "phase2"
    """A shipped agent by name (phase1, phase2), or the folder of a run or of an agent."""
    cases: int = 10_000
    """Number of cases."""
    seed: int = 0
    """Seed of the draw; case i of a seed is always the same."""
    min_angle_deg: float = 80.0
    """Smallest initial deviation [deg]."""
    max_angle_deg: float = 180.0
    """Largest initial deviation [deg]."""
    angle_convention: Literal["full", "half"] | None = None
    """phi is the full rotation angle or half of it (the paper's literal equation); by default the agent's own."""
    infeasible_zone: Literal["resample", "shrink"] | None = None
    """Where a zone would hold start or target: draw again, or make it smaller; by default the agent's own."""
    substeps: int = 1
    """Check the zone at so many instants per time step; 1 checks at the steps only."""
    json: Path | None = None
    """Write the results as JSON."""
    csv: Path | None = None
    """Write a row per case."""
    replay_case: int | None = None
    """Fly only this case of the draw, and write its history."""
    history: Path | None = None
    """File for --replay-case; by default case-I.csv."""


def main(argv: list[str]) -> int:
    """Evaluate and print.  Returns the exit status."""
    try:
        return _evaluate(tyro.cli(EvalArgs, args=argv, prog="eval_mc.py"))
    except ValidationError as error:
        print(f"error: {explain(error)}", file=sys.stderr)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
    return 2


def _evaluate(args: EvalArgs) -> int:
    from koz_jax import evaluation, runtime, storage, tables
    from koz_jax.agent import load_agent
    from koz_jax.summary import summarise, table

    runtime.configure()
    config = evaluation.MonteCarloConfig(
        args.cases, args.seed, args.min_angle_deg, args.max_angle_deg, args.substeps
    )
    agent = load_agent(args.agent)
    task = agent.task.with_rules(args.angle_convention, args.infeasible_zone)
    evaluation.check_feasible(task, config.max_angle_deg)
    for path in (args.json, args.csv, args.history):
        if path is not None and not path.parent.is_dir():
            raise UserError(f"{path}: the folder {path.parent} does not exist")

    if args.replay_case is not None:
        history, result = evaluation.fly_case(agent, args.replay_case, config, task)
        path = args.history or Path(f"case-{args.replay_case}.csv")
        storage.write_text(path, tables.history_csv(history, task))
        print(tables.describe_case(args.replay_case, result))
        print(f"history: {path}")
        return 0

    flown = evaluation.run_cases(agent, task, config)
    summary = summarise(flown.results)
    print(table(summary, args.cases, args.agent))
    print(f"compiled in {flown.compile_s:.1f} s, flown in {flown.wall_s:.1f} s")
    if args.json:
        storage.write_json(args.json, evaluation.report(flown, summary))
    if args.csv:
        storage.write_text(args.csv, tables.cases_csv(flown.results))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
