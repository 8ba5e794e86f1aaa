"""Train a controller: ``python train.py`` (some minutes), ``python train.py --help`` for every setting."""

from __future__ import annotations

import argparse
import dataclasses
import os
import shlex
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from koz_jax import flags
from koz_jax.config import TrainConfig
from koz_jax.errors import UserError, exit_status
from koz_jax.presets import preset
from koz_jax.process_args import ProcessArgs

if TYPE_CHECKING:
    from koz_jax.agent import Agent


@dataclasses.dataclass(frozen=True)
class RunArgs(ProcessArgs):
    """Train a controller that turns a spacecraft without looking into a keep-out zone."""

    run: Path | None = None
    """Folder of the run; by default a new one under runs/."""
    resume: Path | None = None
    """Go on exactly where the run in this folder stopped; takes all settings from it."""
    start_from: Path | None = None
    """Begin with the learner and the replay buffer of a snapshot, or of another run."""
    cases: int = 10_000
    """Monte Carlo cases of the table at the end."""
    devices: int = 1
    """Divide the environments and the replay buffer among so many devices of each process (not with --seeds)."""
    seeds: int = 1
    """Train so many seeds, from --seed on, each on a core of its own; the best by evaluation is the run's agent."""


def parse(argv: list[str]) -> tuple[TrainConfig, RunArgs]:
    """Read the command line into the run's configuration and the other arguments."""
    first = argparse.ArgumentParser(prog="train.py", add_help=False, allow_abbrev=False)
    first.add_argument("--preset", nargs="?", const="")
    first.add_argument("--resume", nargs="?", const="")
    first.add_argument("--cases", nargs="?")
    for name in ("devices", "coordinator", "processes", "process"):
        first.add_argument(f"--{name}", nargs="?")
    chosen, others = first.parse_known_args(argv)
    if chosen.preset is not None:
        others += ["--preset", chosen.preset]
    if chosen.resume is not None and others and not {"-h", "--help"} & set(argv):
        raise UserError(f"resume: takes all settings from the run; remove {shlex.join(others)}")
    config, args = flags.parse(preset("fast" if chosen.preset is None else chosen.preset), RunArgs(), argv, "train.py")
    if not 1 <= args.cases < 2**31:
        raise UserError(f"cases: must be from 1 to 2^31 - 1, got {args.cases}")
    if not 1 <= args.seeds <= 1000:
        raise UserError(f"seeds: must be from 1 to 1000, got {args.seeds}")
    if args.devices < 1 or (args.devices > 1 and args.seeds > 1):
        raise UserError(f"devices: must be 1 or more, and 1 with --seeds, got {args.devices}")
    args.check()
    if args.coordinator is not None:
        if args.seeds > 1:
            raise UserError(f"coordinator: is for one agent, not for --seeds {args.seeds}; got {args.coordinator}")
        if args.run is None and args.resume is None:
            raise UserError("run: must be given where several processes write to one folder")
    return config, args


def main(argv: list[str]) -> int:
    """Train, evaluate, print the table.  Returns the exit status."""
    return exit_status(lambda: _train(*parse(argv)))


def _train(config: TrainConfig, args: RunArgs) -> int:
    # jax is imported only now: a bad flag is refused before it costs a second.
    from koz_jax import processes, runtime
    from koz_jax.run_folder import RunFolder
    from koz_jax.trainer import train

    run = args.resume or args.run or Path("runs", time.strftime(f"{config.preset}-seed{config.seed}-%Y%m%d-%H%M%S"))
    if args.seeds > 1 or (args.resume is not None and os.path.isfile(run / "seeds.json")):
        for name in ("devices", "processes"):
            if getattr(args, name) > 1:
                raise UserError(f"{name}: must be 1 for several seeds, as in {run}; got {getattr(args, name)}")
        return _train_seeds(config, args, run)
    runtime.configure()
    args.join()
    if args.resume:
        config = processes.together(RunFolder(run).read_config)
    agent = train(config, run, resume=args.resume is not None, start_from=args.start_from, devices=args.devices)
    # The others wait for the first, which reports.
    return processes.together(lambda: 0 if args.process > 0 else _report(agent, config, args.cases, run))


def _report(agent: Agent | None, config: TrainConfig, cases: int, run: Path) -> int:
    from koz_jax import evaluation, storage
    from koz_jax.run_folder import RunFolder
    from koz_jax.summary import summarise, table

    if agent is None:
        return _stopped(run)
    shield = config.shielding.in_force
    flown = evaluation.monte_carlo(agent, cases, shield=shield)
    summary = summarise(flown.results)
    storage.write_json(RunFolder(run).evaluation, evaluation.report(flown, summary))
    print(table(summary, cases, run.resolve().name + (" + shield" if shield else ""), shield is not None))
    flags = f"--shield --shield-margin-deg {shield.margin_deg:g} " if shield else ""
    print(f"\nlook further: python eval_mc.py --agent {shlex.quote(str(run))} {flags}--csv cases.csv")
    return 0


def _stopped(run: Path) -> int:
    print(f"stopped; go on with: python train.py --resume {shlex.quote(str(run))}", file=sys.stderr)
    return 0


def _train_seeds(config: TrainConfig, args: RunArgs, run: Path) -> int:
    from koz_jax import runtime, seeds

    runtime.configure()
    if args.resume is None:
        start_from = None if args.start_from is None else str(args.start_from.resolve())
        plan = seeds.Plan(config=config, seeds=args.seeds, start_from=start_from)
        seeds.begin(run, plan)
    else:
        plan = seeds.read_plan(run)
    if not seeds.train_all(run, plan):
        return _stopped(run)
    best, judged = seeds.judge(run, plan, args.cases)
    print(seeds.table(judged, args.cases))
    print(f"\nthe best (seed {best.provenance.seed}): python eval_mc.py --agent {shlex.quote(str(run))}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
