"""Fly one maneuver and draw it: ``python fly.py``, ``python fly.py --help`` for every setting."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from koz_jax.errors import UserError, exit_status
from koz_jax.flight_args import FlightArgs

if TYPE_CHECKING:
    from koz_jax.evaluation import MonteCarloConfig
    from koz_jax.scenario import Scenario
    from koz_jax.task_config import TaskConfig


@dataclasses.dataclass(frozen=True)
class FlyArgs(FlightArgs):
    """Fly one maneuver with a trained agent or another controller; draw the boresight's trace on the sphere and the
    time histories.
    """

    scenario: Literal["paper"] | None = None
    """The paper's test scenario; also what is flown without --case."""
    case: int | None = None
    """A case of the Monte Carlo draw of eval_mc.py, by its index."""
    out: Path = Path("figures")
    """Folder for sphere.png, histories.png (and .pdf of both) and history.csv; files of these names are replaced."""
    gif: bool = False
    """Also write the maneuver as a short moving picture, maneuver.gif."""


# Settings that only a case of the draw depends on.
_DRAW = ("cases", "seed", "min_angle_deg", "max_angle_deg", "infeasible_zone", "zones", "max_rate_deg")


def main(argv: list[str]) -> int:
    """Fly and draw.  Returns the exit status."""
    return exit_status(lambda: _fly(tyro.cli(FlyArgs, args=argv, prog="fly.py")))


def _fly(args: FlyArgs) -> int:
    _check(args)
    # jax and matplotlib are imported only now: --help and flags that do not exist are answered at once.
    from koz_jax import evaluation, runtime, storage, tables
    from koz_jax.figures import animation, histories, sphere, style

    config = args.config()
    runtime.configure()
    pilot = args.pilot()
    task = args.task(pilot)
    drawn = _scenario(args, task, config)
    storage.make_folder("out", args.out)
    history, result = evaluation.fly_scenario(pilot, drawn, task, config, args.case or 0)
    what = "the paper's test scenario" if args.case is None else f"case {args.case} of seed {args.seed}"
    print(f"{what}: {tables.describe_result(result)}")
    title = f"{style.short_name(args.name)}: {what}"
    storage.write_text(args.out / "history.csv", tables.history_csv(history, task))
    written = [
        args.out / "history.csv",
        *style.save(sphere.draw(history, task, title), args.out, "sphere"),
        *style.save(histories.draw(history, result, task, title), args.out, "histories"),
    ]
    if args.gif:
        written.append(animation.write(args.out / "maneuver.gif", history, result, task, title))
    for path in written:
        print(f"written: {path}")
    return 0


def _check(args: FlyArgs) -> None:
    if args.case is None:
        for field in dataclasses.fields(args):
            if field.name in _DRAW and getattr(args, field.name) != field.default:
                raise UserError(f"{field.name}: is of the draw, and needs --case; the paper's scenario has no draw")
    elif args.scenario is not None:
        raise UserError(f"scenario: give either --scenario {args.scenario} or --case, got both")
    elif not 0 <= args.case < args.cases:
        raise UserError(f"case: must be from 0 to cases - 1 = {args.cases - 1}, got {args.case}")


def _scenario(args: FlyArgs, task: TaskConfig, config: MonteCarloConfig) -> Scenario:
    import jax.numpy as jnp

    from koz_jax import evaluation, scenario

    if args.case is None:
        return scenario.paper_test()
    evaluation.check_feasible(task, config.max_angle_deg)
    return evaluation.draw_case(task, config, jnp.int32(args.case))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
