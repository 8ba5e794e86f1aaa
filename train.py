"""Train a controller: ``python train.py`` (some minutes), ``python train.py --help`` for every setting."""

import argparse
import dataclasses
import sys
import time
from pathlib import Path
from typing import Annotated

import tyro
from pydantic import ValidationError

from koz_jax.config import TrainConfig
from koz_jax.errors import UserError, explain
from koz_jax.presets import preset


@dataclasses.dataclass(frozen=True)
class TrainArgs:
    """Train a controller that turns a spacecraft without looking into a keep-out zone."""

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    run: Path | None = None
    """Folder of the run; by default a new one under runs/."""
    resume: Path | None = None
    """Go on exactly where the run in this folder stopped; takes all settings from it."""
    start_from: Path | None = None
    """Begin with the learner and the replay buffer of a snapshot, or of another run."""
    cases: int = 10_000
    """Monte Carlo cases of the table at the end."""


def parse(argv: list[str]) -> tuple[TrainConfig, TrainArgs]:
    """The run's configuration and the other arguments."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default="fast")
    first.add_argument("--resume", type=Path)
    first.add_argument("--cases")
    chosen, others = first.parse_known_args(argv)
    if chosen.resume is not None and others and "--help" not in argv and "-h" not in argv:
        raise UserError(f"resume: takes all settings from the run; remove {' '.join(others)}")
    defaults = TrainArgs(config=preset(chosen.preset))
    args = tyro.cli(TrainArgs, default=defaults, args=argv, prog="train.py")
    if args.cases <= 0:
        raise UserError(f"cases: must be at least 1, got {args.cases}")
    return args.config, args


def main(argv: list[str]) -> int:
    """Train, evaluate, print the table.  Returns the exit status."""
    try:
        config, args = parse(argv)
        run = args.resume or args.run or Path("runs", time.strftime(f"{config.preset}-seed{config.seed}-%Y%m%d-%H%M%S"))
        return _train(config, args, run)
    except ValidationError as error:
        print(f"error: {explain(error)}", file=sys.stderr)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
    return 2


def _train(config: TrainConfig, args: TrainArgs, run: Path) -> int:
    # jax is imported only now: a bad flag is refused before it costs a second.
    from koz_jax import evaluation, runtime, storage
    from koz_jax.run_folder import RunFolder
    from koz_jax.summary import summarise, table
    from koz_jax.trainer import train

    runtime.configure()
    if args.resume:
        config = RunFolder(run).read_config()
    print(f"run folder: {run}", file=sys.stderr)
    agent = train(config, run, resume=args.resume is not None, start_from=args.start_from)
    if agent is None:
        print(f"stopped; go on with: python train.py --resume {run}", file=sys.stderr)
        return 0
    flown = evaluation.monte_carlo(agent, args.cases)
    summary = summarise(flown.results)
    storage.write_json(RunFolder(run).evaluation, evaluation.report(flown, summary))
    print(table(summary, args.cases, run.name))
    print(f"\nlook further: python eval_mc.py --agent {run} --csv cases.csv")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
