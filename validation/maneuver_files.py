"""Exported C beside JAX over random maneuver files: the same verdicts.

    python validation/maneuver_files.py --files 1000 --keep build/differing

Every file is read by the product's own loader, flown in JAX as by ``koz fly FILE --agent universal``, and exported as
by ``koz export universal --to c --spacecraft FILE``, both with the shield or both without.  What is compiled flies it
again: C observes, decides, shields and shares out among wheels, and a rigid body in NumPy, float64, turns.  Verdicts
(settled, violated, a wheel above its momentum) may differ only where a file is within rounding of a threshold.  Ctrl-C
ends it with the table of what was flown.
"""

import collections
import dataclasses
import logging
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import c_flight
import numpy as np
import random_maneuvers
import tyro
from c_flight import Flown
from random_maneuvers import KINDS, Kind
from tqdm import tqdm

import koz_jax
from koz_jax.agents.agent import Agent, load_agent
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.maneuvers.maneuver import ManeuverConfig
from koz_jax.config.maneuvers.maneuver_file import load_maneuver, load_spacecraft
from koz_jax.config.maneuvers.maneuver_tables import fastest_cone_deg
from koz_jax.config.shield import ShieldConfig
from koz_jax.errors import SettingsError
from koz_jax.export import files as exports
from koz_jax.export.golden import Golden
from koz_jax.export.library import CLibrary
from koz_jax.export.shield_golden import ShieldGolden
from koz_jax.storage import runtime

COLUMNS = ("kind", "files", "settled", "violated", "shield acts", "verdicts differ", "margin, median; most [deg]")
COLUMNS += ("settling, most [steps]", "fullest wheel")

_ROUNDING_DEG = 1e-3  # what rounding makes of a margin or a pointing error over a maneuver, with room to spare
_FULL = 1.0 + 1e-5  # share of a wheel's largest momentum above which it holds more than it can
_DRAWS = 100  # that are tried for a file

_SITUATION = 27  # entries of a situation of four zones


@dataclasses.dataclass(frozen=True)
class FilesArgs:
    """Compare exported C with JAX over random maneuver files."""

    files: int = 1000
    """Number of files, of every kind as many."""
    first: int = 0
    """Number of the first file, to go on after an interruption."""
    seed: int = 0
    """Seed of the draw; file i of a seed is always the same."""
    agent: str = "universal"
    """An agent for any spacecraft: shipped, by name, or a folder."""
    keep: Path | None = None
    """Folder for the files whose verdicts differ."""


@dataclasses.dataclass(frozen=True)
class Compared:
    """A file, flown twice."""

    path: Path
    step_seconds: float
    limit_deg: float  # within which it is settled
    jax: Flown
    c: Flown
    shielded: bool  # whether the shield changed a torque, in JAX

    @property
    def differs(self) -> bool:
        """Whether the verdicts are not the same."""
        return verdict(self.jax) != verdict(self.c)

    @property
    def excused(self) -> bool:
        """Whether a threshold is within rounding."""
        return min(abs(self.jax.margin_deg), abs(self.jax.end_error_deg - self.limit_deg)) < _ROUNDING_DEG

    @property
    def steps(self) -> float:
        """Difference of the settling time in steps; nan where one does not settle."""
        return abs(self.jax.settling_seconds - self.c.settling_seconds) / self.step_seconds

    @property
    def margin_deg(self) -> float:
        """Difference of the smallest margin."""
        return abs(self.jax.margin_deg - self.c.margin_deg)


def verdict(flown: Flown) -> tuple[bool, bool, bool]:
    return flown.settled, flown.violated, flown.fill > _FULL


def main(argv: list[str]) -> int:
    return exit_status(lambda: compare(tyro.cli(FilesArgs, args=argv, prog="validation/maneuver_files.py")))


def compare(args: FilesArgs) -> int:
    runtime.configure()
    # One line for each file that is at the edge of what an agent was made for would hide the table.
    logging.getLogger("koz_jax").setLevel(logging.ERROR)
    leave_out_self_tests()
    agent, refused = load_agent(args.agent), collections.Counter()
    found: dict[Kind, list[Compared]] = {kind: [] for kind in KINDS}
    with tempfile.TemporaryDirectory() as folder:
        try:
            for kind, path in tqdm(written(args, Path(folder), refused), total=args.files, mininterval=60.0):
                found[kind].append(flown_twice(agent, path, kind))
                if found[kind][-1].differs:
                    print(described(found[kind][-1]), flush=True)
                    keep(path, args.keep)
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
    return report({kind: rows for kind, rows in found.items() if rows}, refused)


def keep(path: Path, folder: Path | None) -> None:
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, folder)


def leave_out_self_tests() -> None:
    """Draw no situations for the self-tests of exports, which are not run: that takes longer than all else."""
    none = np.zeros((0, 1), np.float32)
    vectors, answers, start = Golden(*6 * (none,)), ShieldGolden(*4 * (none,)), np.zeros(_SITUATION)
    for name, blank in (("golden", vectors), ("shield_golden", answers), ("example", start)):
        setattr(exports, name, lambda *_, blank=blank, **__: blank)


def written(args: FilesArgs, folder: Path, refused: collections.Counter[str]) -> Iterator[tuple[Kind, Path]]:
    """Draw and write files that can be read, the kinds in turn, and count why others cannot."""
    for number in range(args.first, args.first + args.files):
        kind = KINDS[number % len(KINDS)]
        path = folder / f"file{number:04}.toml"
        for attempt in range(_DRAWS):
            text = random_maneuvers.draw(kind, (args.seed, number, attempt))
            if text is None:
                refused["no place for a cone"] += 1
                continue
            path.write_text(text)
            try:
                load_maneuver(path)
            except SettingsError as error:
                refused[str(error).removeprefix(f"{path}: ").split(";")[0]] += 1
                continue
            yield kind, path
            break
        else:
            raise SettingsError(f"files: in {_DRAWS} draws none of file {number} can be flown, {kind}")


def flown_twice(agent: Agent, path: Path, kind: Kind) -> Compared:
    maneuver = load_maneuver(path)
    shield = ShieldConfig() if kind.shield else None
    report = koz_jax.fly(maneuver, agent, shield=shield).report()
    in_jax = Flown(
        settled=report["settled"],
        violated=report["violated"],
        settling_seconds=float("nan") if report["settling_time_s"] is None else report["settling_time_s"],
        margin_deg=report["min_margin_deg"],
        end_error_deg=report["end_error_deg"],
        rate_deg=report["peak_rate_deg"],
        fill=report["peak_wheel_momentum_share"] or 0.0,
    )
    return Compared(
        path,
        maneuver.step_seconds,
        maneuver.settled_angle_deg,
        in_jax,
        in_c(agent, path, maneuver, shield),
        shielded=report["intervention_rate"] > 0.0,
    )


def in_c(agent: Agent, path: Path, maneuver: ManeuverConfig, shield: ShieldConfig | None) -> Flown:
    """Export as ``koz export --spacecraft`` does, with the rate of the fastest cone told, and fly."""
    described = load_spacecraft(path)
    told = None
    if shield is not None:
        told = shield.model_copy(update={"cone_rate_deg": fastest_cone_deg(maneuver.constraints)})
    further = tuple(instrument.boresight for instrument in described.instruments[1:])
    with tempfile.TemporaryDirectory() as folder:
        exports.write_files(Path(folder), exports.export(agent, "c", told, described.task, further))
        library = CLibrary(folder)
    return c_flight.fly(maneuver, library, [instrument.name for instrument in described.instruments])


def described(one: Compared) -> str:
    rounded = " (within rounding of a threshold)" if one.excused else ""
    return f"{one.path.name}{rounded}\n  JAX: {one.jax}\n  C:   {one.c}"


def report(found: dict[Kind, list[Compared]], refused: collections.Counter[str]) -> int:
    every = [one for rows in found.values() for one in rows]
    print(f"| {' | '.join(COLUMNS)} |\n{len(COLUMNS) * '|---'}|")
    for kind, rows in found.items():
        print(row(str(kind), rows))
    print(row("all", every))
    print(f"largest difference of a margin: {described(max(every, key=lambda one: one.margin_deg))}")
    for reason, count in refused.most_common():
        print(f"drawn again {count} times: {reason}")
    return 0 if all(one.excused for one in every if one.differs) else 1


def row(name: str, rows: list[Compared]) -> str:
    margins = [one.margin_deg for one in rows]
    steps = [one.steps for one in rows if np.isfinite(one.steps)]
    cells = [
        name,
        f"{len(rows)}",
        f"{sum(one.jax.settled for one in rows)}",
        f"{sum(one.jax.violated for one in rows)}",
        f"{sum(one.shielded for one in rows)}",
        f"{sum(one.differs for one in rows)}",
        f"{np.median(margins):.0e}; {np.max(margins):.0e}",
        f"{max(steps, default=0.0):.0f}",
        f"{100 * max(max(one.jax.fill, one.c.fill) for one in rows):.1f} %",
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
