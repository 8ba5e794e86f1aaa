"""Replay a maneuver in 3-D: ``python -m koz_jax.replay``, ``python -m koz_jax.replay --help`` for every setting."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from koz_jax.errors import UserError, exit_status

if TYPE_CHECKING:
    from koz_jax.scenario import Scenario
    from koz_jax.task_config import TaskConfig


@dataclasses.dataclass(frozen=True)
class ReplayArgs:
    """Show one case as trained agents fly it, side by side, in an HTML file that opens offline."""

    agent: tuple[str, ...] = ("phase1", "phase2")
    """Shipped agents by name (phase1, phase2), or folders of runs or of agents."""
    case: int | None = None
    """Case of the Monte Carlo draw of eval_mc.py, by its index; by default the paper's test scenario."""
    cases: int = 10_000
    """Number of cases of the draw."""
    seed: int = 0
    """Seed of the draw; case i of a seed is always the same."""
    min_angle_deg: float = 80.0
    """Smallest initial deviation of the draw [deg]."""
    max_angle_deg: float = 180.0
    """Largest initial deviation of the draw [deg]."""
    seconds: float | None = None
    """How much of the maneuver to show [s]; by default until soon after the last agent has settled."""
    out: Path = Path("replay.html")
    """The file to write."""


def main(argv: list[str]) -> int:
    """Fly and write.  Returns the exit status."""
    return exit_status(lambda: _replay(tyro.cli(ReplayArgs, args=argv, prog="python -m koz_jax.replay")))


def _replay(args: ReplayArgs) -> int:
    _check(args)
    # jax is imported only now: --help and flags that do not exist are answered at once.
    from koz_jax import runtime, storage
    from koz_jax.agent import load_agent
    from koz_jax.replay import page
    from koz_jax.replay.maneuver import fly
    from koz_jax.tables import describe_result

    if not 1 <= len(args.agent) <= page.MOST:
        raise UserError(f"agent: one page shows 1 to {page.MOST}, got {len(args.agent)}")
    storage.check_writable("out", args.out)
    page.plotly_library()
    runtime.configure()
    agents = [load_agent(name) for name in args.agent]
    drawn = _scenario(args, agents[0].task)
    maneuvers = [fly(agent, drawn) for agent in agents]
    what = "the paper's test scenario" if args.case is None else f"case {args.case} of seed {args.seed}"
    page.write_replay(args.out, maneuvers, f"Replay of {what}", args.seconds)
    for maneuver in maneuvers:
        print(f"{maneuver.label}: {describe_result(maneuver.result)}")
    print(f"replay: {args.out} ({args.out.stat().st_size / 1e6:.1f} MB; open it in a browser, no network needed)")
    return 0


def _check(args: ReplayArgs) -> None:
    if args.case is None:
        for field in dataclasses.fields(args):
            if field.name in _DRAW and getattr(args, field.name) != field.default:
                raise UserError(f"{field.name}: is of the draw, and needs --case; the paper's scenario has no draw")
    elif not 0 <= args.case < args.cases:
        raise UserError(f"case: must be from 0 to cases - 1 = {args.cases - 1}, got {args.case}")
    if args.seconds is not None and not 0.0 < args.seconds < float("inf"):
        raise UserError(f"seconds: must be positive and finite, got {args.seconds}")


# Settings that only a case of the draw depends on.
_DRAW = ("cases", "seed", "min_angle_deg", "max_angle_deg")


def _scenario(args: ReplayArgs, task: TaskConfig) -> Scenario:
    from koz_jax import evaluation, scenario

    if args.case is None:
        return scenario.paper_test()
    config = evaluation.MonteCarloConfig(args.cases, args.seed, args.min_angle_deg, args.max_angle_deg)
    evaluation.check_feasible(task, config.max_angle_deg)
    return evaluation.draw_case(task, config, args.case)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
