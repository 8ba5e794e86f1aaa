"""Fly one maneuver and draw it: ``python fly.py``, ``python fly.py --help`` for every setting."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from koz_jax.errors import UserError, exit_status

if TYPE_CHECKING:
    from koz_jax.scenario import Scenario
    from koz_jax.task_config import TaskConfig


@dataclasses.dataclass(frozen=True)
class FlyArgs:
    """Fly one maneuver with a trained agent; draw the boresight's trace on the sphere and the time histories."""

    agent: str = "phase2"
    """A shipped agent by name (phase1, phase2), or the folder of a run or of an agent."""
    scenario: Literal["paper"] | None = None
    """The paper's test scenario; also what is flown without --case."""
    case: int | None = None
    """A case of the Monte Carlo draw of eval_mc.py, by its index."""
    cases: int = 10_000
    """Number of cases of the draw."""
    seed: int = 0
    """Seed of the draw; case i of a seed is always the same."""
    min_angle_deg: float = 80.0
    """Smallest initial deviation of the draw [deg]."""
    max_angle_deg: float = 180.0
    """Largest initial deviation of the draw [deg]."""
    angle_convention: Literal["full", "half"] | None = None
    """phi is the full rotation angle or half of it (the paper's literal equation); by default the agent's own."""
    infeasible_zone: Literal["resample", "shrink"] | None = None
    """Where a zone of the draw would hold start or target: draw again, or make it smaller; by default the agent's."""
    out: Path = Path("figures")
    """Folder for sphere.png, histories.png (and .pdf of both) and history.csv; files of these names are replaced."""
    gif: bool = False
    """Also write the maneuver as a short moving picture, maneuver.gif."""


# Settings that only a case of the draw depends on.
_DRAW = ("cases", "seed", "min_angle_deg", "max_angle_deg", "infeasible_zone")


def main(argv: list[str]) -> int:
    """Fly and draw.  Returns the exit status."""
    return exit_status(lambda: _fly(tyro.cli(FlyArgs, args=argv, prog="fly.py")))


def _fly(args: FlyArgs) -> int:
    _check(args)
    # jax and matplotlib are imported only now: --help and flags that do not exist are answered at once.
    from koz_jax import evaluation, runtime, storage, tables
    from koz_jax.agent import load_agent
    from koz_jax.figures import animation, histories, sphere, style

    runtime.configure()
    agent = load_agent(args.agent)
    task = agent.task.with_rules(args.angle_convention, args.infeasible_zone)
    drawn = _scenario(args, task)
    storage.make_folder("out", args.out)
    history, result = evaluation.fly_scenario(agent, drawn, task)
    what = "the paper's test scenario" if args.case is None else f"case {args.case} of seed {args.seed}"
    print(f"{what}: {tables.describe_result(result)}")
    title = f"{style.short_name(args.agent)}: {what}"
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


def _scenario(args: FlyArgs, task: TaskConfig) -> Scenario:
    import jax.numpy as jnp

    from koz_jax import evaluation, scenario

    if args.case is None:
        return scenario.paper_test()
    config = evaluation.MonteCarloConfig(args.cases, args.seed, args.min_angle_deg, args.max_angle_deg)
    evaluation.check_feasible(task, config.max_angle_deg)
    return evaluation.draw_case(task, config, jnp.int32(args.case))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
