"""Judge a controller by Monte Carlo: ``python eval_mc.py``, ``python eval_mc.py --help`` for every setting."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from koz_jax.errors import UserError, exit_status
from koz_jax.flight_args import FlightArgs
from koz_jax.process_args import ProcessArgs

if TYPE_CHECKING:
    from koz_jax.controllers.base import Pilot
    from koz_jax.evaluation import MonteCarlo, MonteCarloConfig
    from koz_jax.task_config import TaskConfig


@dataclasses.dataclass(frozen=True)
class EvalArgs(ProcessArgs, FlightArgs):
    """Fly a trained agent, or another controller, over many random cases; print the paper's table beside its own."""

    substeps: int = 1
    """Check the zone at so many instants per time step; 1 checks at the steps only."""
    json: Path | None = None
    """Write the results as JSON."""
    csv: Path | None = None
    """Write a row per case."""
    partial: Path | None = None
    """Keep finished blocks of cases in this folder; the same command goes on from them when it was interrupted.
    Several processes need one, in which each puts its share of the blocks."""
    figures: Path | None = None
    """Draw the Monte Carlo figures into this folder, as PNG and PDF (needs the extra viz)."""
    replay_case: int | None = None
    """Fly only this case of the draw, and write its history."""
    history: Path | None = None
    """File for --replay-case; by default case-I.csv."""


def main(argv: list[str]) -> int:
    """Evaluate and print.  Returns the exit status."""
    return exit_status(lambda: _evaluate(tyro.cli(EvalArgs, args=argv, prog="eval_mc.py")))


def _evaluate(args: EvalArgs) -> int:
    # jax is imported only now: --help and flags that do not exist are answered at once.
    from koz_jax import processes, runtime

    config = args.config(args.substeps)
    args.check()
    if args.replay_case is not None and args.coordinator is not None:
        raise UserError(f"replay_case: is flown by one process, got {args.replay_case} with --coordinator")
    runtime.configure()
    args.join()
    pilot, task = processes.together(lambda: _prepare(args, config))
    if args.replay_case is not None:
        _replay(pilot, task, config, args.replay_case, _history_path(args))
    else:
        _monte_carlo(pilot, task, config, args)
    return 0


def _prepare(args: EvalArgs, config: MonteCarloConfig) -> tuple[Pilot, TaskConfig]:
    """Load who flies, and refuse what cannot be flown or written."""
    from koz_jax import evaluation

    pilot = args.pilot()
    task = args.task(pilot)
    evaluation.check_feasible(task, config.max_angle_deg)
    _check_outputs(args)  # last, since it makes a folder
    return pilot, task


def _history_path(args: EvalArgs) -> Path:
    return args.history or Path(f"case-{args.replay_case}.csv")


def _check_outputs(args: EvalArgs) -> None:
    """Refuse files that cannot be written, or that the rest of the command line leaves empty."""
    from koz_jax import storage

    outputs = {"json": args.json, "csv": args.csv}
    if args.replay_case is None:
        if args.history is not None:
            raise UserError(f"history: is written by --replay-case only, got {args.history} without it")
    else:
        for name, path in {**outputs, "partial": args.partial}.items():
            if path is not None:
                raise UserError(f"{name}: is not written with --replay-case, which writes --history; got {path}")
        if args.figures is not None:
            raise UserError(
                f"figures: are of many cases, and not drawn with --replay-case; got {args.figures}. One case is drawn"
                f" by python fly.py --case {args.replay_case} --seed {args.seed}"
            )
        if not 0 <= args.replay_case < args.cases:
            raise UserError(f"replay_case: must be from 0 to cases - 1 = {args.cases - 1}, got {args.replay_case}")
        outputs["history"] = _history_path(args)
    for name, path in outputs.items():
        if path is not None:
            storage.check_writable(name, path)
    if args.figures is not None:
        from koz_jax.figures import style  # noqa: F401  without matplotlib, say so before the flight

        storage.make_folder("figures", args.figures)


def _replay(pilot: Pilot, task: TaskConfig, config: MonteCarloConfig, case: int, path: Path) -> None:
    from koz_jax import evaluation, storage, tables

    history, result = evaluation.fly_case(pilot, case, config, task)
    storage.write_text(path, tables.history_csv(history, task))
    print(tables.describe_case(case, result))
    print(f"history: {path}")


def _monte_carlo(pilot: Pilot, task: TaskConfig, config: MonteCarloConfig, args: EvalArgs) -> None:
    from koz_jax import blocks, processes

    flown = blocks.run_cases(pilot, task, config, partial=args.partial)
    # The others wait for the first, which reports.
    processes.together(lambda: None if args.process > 0 else _report(flown, task, config, args))


def _report(flown: MonteCarlo, task: TaskConfig, config: MonteCarloConfig, args: EvalArgs) -> None:
    from koz_jax import evaluation, storage, tables
    from koz_jax.summary import summarise, table

    summary = summarise(flown.results)
    print(table(summary, config.cases, args.name, args.shield))
    print(f"compiled in {flown.compile_s:.1f} s, flown in {flown.wall_s:.1f} s")
    if args.json:
        storage.write_json(args.json, evaluation.report(flown, summary))
    if args.csv:
        storage.write_text(args.csv, tables.cases_csv(flown.results))
    if args.figures:
        from koz_jax.figures import monte_carlo, style

        title = f"{style.short_name(args.name)}: {config.cases} random cases, seed {config.seed}"
        for path in monte_carlo.write(args.figures, flown.results, task, title):
            print(f"figure: {path}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
