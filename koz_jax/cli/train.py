"""``koz train``: train an agent, or go on with a run."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import Field, model_validator

from koz_jax.cli import invocation
from koz_jax.cli.exit_status import exit_status
from koz_jax.cli.flags import parsing
from koz_jax.cli.flags.process import ProcessFlags
from koz_jax.config.base import CaseCount, PositiveInt
from koz_jax.config.maneuvers.maneuver_file import load_spacecraft
from koz_jax.config.presets.named import PRESETS, preset
from koz_jax.config.presets.spacecraft import for_spacecraft
from koz_jax.config.training import TrainConfig
from koz_jax.errors import SettingsError

if TYPE_CHECKING:
    from koz_jax.agents.agent import Agent

_CASES = 10_000  # of the table, unless told otherwise

_HELPS = {"preset": f"Settings to begin from: {', '.join(PRESETS)}; every other flag changes one of them."}


class TrainFlags(ProcessFlags):
    """Train a controller that turns a spacecraft without looking into a keep-out zone."""

    spacecraft: Path | None = None
    """Train for this spacecraft instead of the paper's, times of the preset in its own units: a TOML file with a table
    [spacecraft] and step_seconds, such as a maneuver file."""
    run: Path | None = None
    """Folder of the run; by default a new one under runs/."""
    resume: Path | None = None
    """Go on exactly where the run in this folder stopped; takes all settings from it."""
    start_from: Path | None = None
    """Begin with the learner and the replay buffer of a snapshot, or of another run; where both phases have 0 updates,
    with an agent by name or folder, and refine it."""
    cases: CaseCount | None = None
    """Monte Carlo cases of the table at the end; by default 10,000, or as many as a resumed run was begun with."""
    devices: PositiveInt = 1
    """Divide the environments and the replay buffer among so many devices of each process (not with --seeds)."""
    sizes: Literal["auto", "cpu", "gpu"] = "auto"
    """Batches and lengths of the preset that suit this device, or that of another; what is set by a flag stays."""
    seeds: Annotated[int, Field(gt=0, le=1000)] = 1
    """Train so many seeds, from --seed on, each on a core of its own; the best by evaluation is the run's agent."""

    @model_validator(mode="after")
    def _can_be_together(self) -> Self:
        if self.devices > 1 and self.seeds > 1:
            raise ValueError(f"devices: must be 1 with --seeds, got {self.devices}")
        if self.coordinator is not None:
            if self.seeds > 1:
                raise ValueError(f"coordinator: is for one agent, not for --seeds {self.seeds}; got {self.coordinator}")
            if self.run is None and self.resume is None:
                raise ValueError("run: must be given where several processes write to one folder")
        return self


def parse(argv: Sequence[str]) -> tuple[TrainConfig, TrainFlags]:
    """Read the command line into the run's configuration and the other flags.

    Raises:
        SettingsError: a value is not allowed.

    """
    prog = invocation.command("train")
    chosen, others = _first_look(argv)
    if chosen.preset is not None:
        others += ["--preset", chosen.preset]
    if chosen.spacecraft is not None:
        others += ["--spacecraft", chosen.spacecraft]
    if chosen.resume is not None and others and not {"-h", "--help"} & set(argv):
        raise SettingsError(f"resume: takes all settings from the run; remove {shlex.join(others)}")
    begin_from = preset("fast" if chosen.preset is None else chosen.preset)
    if chosen.spacecraft:
        begin_from = for_spacecraft(begin_from, load_spacecraft(chosen.spacecraft).task)
    asked, config = parsing.parse_with(TrainFlags, begin_from, argv, prog, _HELPS)
    return config, asked


def _first_look(argv: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """Find what decides how the rest is read, and what a run may also be resumed with; and all the rest."""
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", nargs="?", const="")
    first.add_argument("--spacecraft", nargs="?", const="")
    first.add_argument("--resume", nargs="?", const="")
    for name in ("cases", "devices", "coordinator", "processes", "process"):
        first.add_argument(f"--{name}", nargs="?")
    return first.parse_known_args(argv)


def _cases(asked: TrainFlags, run: Path) -> int:
    """Cases of the table: as asked for, or as the run was begun with."""
    from koz_jax.runs.folder import RunFolder

    if asked.cases is not None:
        return asked.cases
    try:
        begun_with = _first_look(shlex.split(RunFolder(run).read_command()))[0].cases
        return _CASES if begun_with is None else round(float(begun_with))
    except (ValueError, OverflowError):  # somebody else wrote it
        return _CASES


def main(argv: Sequence[str]) -> int:
    """Train, evaluate, print the table.  Returns the exit status."""
    return exit_status(lambda: _train(*parse(argv), invocation.typed("train", argv)))


def _train(config: TrainConfig, asked: TrainFlags, command: str) -> int:
    # jax is imported only now: a bad flag is refused before it costs a second.
    from koz_jax.runs.folder import RunFolder
    from koz_jax.runs.trainer import train
    from koz_jax.storage import processes, runtime

    runtime.configure()
    asked.join()
    if not asked.resume:
        config = _sized(config, asked.sizes)
    new = Path("runs", time.strftime(f"{config.preset}-seed{config.seed}-%Y%m%d-%H%M%S"))
    run = asked.resume or asked.run or new
    if asked.seeds > 1 or (asked.resume is not None and os.path.isfile(run / "seeds.json")):
        return _train_seeds(config, asked, run, command)
    if asked.resume:
        config = processes.all_or_none(RunFolder(run).read_config)
    agent = train(
        config,
        run,
        resume=asked.resume is not None,
        start_from=asked.start_from,
        devices=asked.devices,
        command=command,
    )
    # The others wait for the first, which reports.
    return processes.all_or_none(lambda: 0 if asked.process > 0 else _report(agent, config, _cases(asked, run), run))


def _sized(config: TrainConfig, asked: str) -> TrainConfig:
    """Settings with the sizes that are asked for; says what that changes."""
    from koz_jax import devices
    from koz_jax.config.presets import sizes

    if asked == "cpu" or (asked == "auto" and not devices.on_gpu()):
        return config
    sized, changed = sizes.for_gpu(config)
    if changed:
        told = ", ".join(f"{name} {value}" for name, value in changed.items())
        print(f"sizes for a GPU: {told}", file=sys.stderr)
    return sized


def _report(agent: Agent | None, config: TrainConfig, cases: int, run: Path) -> int:
    from koz_jax.evaluation import monte_carlo
    from koz_jax.evaluation.summary import summarise, table
    from koz_jax.runs.folder import RunFolder
    from koz_jax.storage import files

    if agent is None:
        return _stopped(run)
    folder, shield = RunFolder(run), config.shielding.in_force
    flown = monte_carlo.monte_carlo(agent, cases, shield=shield)
    files.write_json(folder.evaluation, monte_carlo.report(flown, summarise(flown.results)))
    print(table(flown, name=run.resolve().name + (" + shield" if shield else "")))
    record = agent.provenance
    if record.refinements_tried and not record.refinements:
        print(f"refinement did not improve the agent; kept the one of update {record.updates}")
    if folder.checkpoints():
        trim = f"{invocation.command('trim')} {shlex.quote(str(run))}"
        print(f"{run} takes {folder.size / 1e6:.0f} MB, most of it to resume from; make it small with: {trim}")
    shielded = f"--shield --shield-margin-deg {shield.margin_deg:g} " if shield else ""
    evaluate = invocation.command("evaluate")
    print(f"\nlook further: {evaluate} --agent {shlex.quote(str(run))} {shielded}--csv cases.csv")
    return 0


def _stopped(run: Path) -> int:
    print(f"stopped; go on with: {invocation.command('train')} --resume {shlex.quote(str(run))}", file=sys.stderr)
    return 0


def _train_seeds(config: TrainConfig, asked: TrainFlags, run: Path, command: str) -> int:
    from koz_jax.runs import seeds

    for name in ("devices", "processes"):
        if getattr(asked, name) > 1:
            raise SettingsError(f"{name}: must be 1 for several seeds, as in {run}; got {getattr(asked, name)}")
    if asked.resume is None:
        source = asked.start_from
        # The workers are in another folder; an agent may also be named.
        start_from = None if source is None else str(source.resolve() if source.exists() else source)
        plan = seeds.Plan(config=config, seeds=asked.seeds, start_from=start_from, cases=asked.cases or _CASES)
        seeds.begin(run, plan)
    else:
        plan = seeds.read_plan(run)
    if not seeds.train_all(run, plan, command=command):
        return _stopped(run)
    cases = asked.cases or plan.cases
    best, found = seeds.evaluate(run, plan, cases)
    print(seeds.table(found, cases))
    evaluate = invocation.command("evaluate")
    print(f"\nthe best (seed {best.provenance.seed}): {evaluate} --agent {shlex.quote(str(run))}")
    return 0
