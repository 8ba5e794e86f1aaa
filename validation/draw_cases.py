"""What an independent simulator needs: cases of ``koz evaluate``, our verdicts, and the exported code.

    python validation/draw_cases.py --agent phase2 --cases 1000 --out build/basilisk

Writes ``cases.npz`` and the exported C source.  ``validation/basilisk.py`` flies them.
"""

import dataclasses
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from koz_jax.agents.agent import Agent, load_agent
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.base import checked
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.evaluation.cases import draw_case, fly_cases
from koz_jax.export.files import export, write_files
from koz_jax.storage import files, runtime
from koz_jax.task import dynamics
from koz_jax.task.dynamics import RigidBodyState

_TUMBLES = 20
_LARGEST_TUMBLE = 0.2  # [rad/s]


@dataclasses.dataclass(frozen=True)
class DrawArgs:
    """Draw cases, fly them, export the agent."""

    out: Path
    """Folder to write into."""
    agent: str = "phase2"
    """A shipped agent by name, or a folder."""
    cases: int = 1000
    """Number of cases."""
    seed: int = 0
    """Seed of the draw; case i of a seed is always the same."""


class Tumbles(NamedTuple):
    """Torque-free motion by the core's own integrator in float64; leading axes (tumbles, steps + 1)."""

    q_BN: np.ndarray
    omega_BN_B: np.ndarray


def main(argv: list[str]) -> int:
    return exit_status(lambda: draw(tyro.cli(DrawArgs, args=argv, prog="validation/draw_cases.py")))


def draw(args: DrawArgs) -> int:
    config = checked(MonteCarloConfig, cases=args.cases, seed=args.seed)
    files.make_folder("out", args.out)
    runtime.configure()
    agent = load_agent(args.agent)
    write_files(args.out, export(agent, "c"))
    tumbled = tumbles(agent.task)
    np.savez(
        args.out / "cases.npz",
        allow_pickle=False,
        **cases(agent, config),
        **spacecraft(agent.task),
        tumble_q_BN=tumbled.q_BN,
        tumble_omega_BN_B=tumbled.omega_BN_B,
    )
    print(args.out / "cases.npz")
    return 0


def cases(agent: Agent, config: MonteCarloConfig) -> dict[str, np.ndarray]:
    """The scenarios and our verdicts by name; leading axis (cases,)."""
    indices = jnp.arange(config.cases)
    drawn = jax.jit(jax.vmap(lambda case: draw_case(agent.task, config, case)))(indices)
    flown = fly_cases(agent.controller, agent.task, config)
    return {
        "q_BN": np.asarray(drawn.initial.q_BN),
        "omega_BN_B": np.asarray(drawn.initial.omega_BN_B),
        "q_DN": np.asarray(drawn.q_DN),
        "zone_axis_N": np.asarray(drawn.constraints.axis_N),
        "zone_half_angle": np.asarray(drawn.constraints.half_angle),
        "settled": np.asarray(flown.settled),
        "violated": np.asarray(flown.violated),
        "settling_time": np.asarray(flown.settling_time),
        "control_effort": np.asarray(flown.control_effort),
        "min_margin": np.asarray(flown.min_margin),
    }


def spacecraft(task: TaskConfig) -> dict[str, np.ndarray]:
    """What the simulator must be set to."""
    return {
        "inertia": np.array(task.spacecraft.inertia),
        "boresight_B": np.array(task.spacecraft.boresight),
        "step_seconds": np.array(task.step_seconds),
        "steps": np.array(task.episode_steps),
        # Of the full rotation, whatever the convention.
        "settled_angle": np.deg2rad(task.reward.settled_angle_deg) / (1.0 if task.angle_convention == "full" else 0.5),
    }


def tumbles(task: TaskConfig) -> Tumbles:
    """Let the core's own integrator turn the free body in float64, from random attitudes and rates."""
    rng = np.random.default_rng(0)
    q_BN = rng.normal(size=(_TUMBLES, 4))
    omega = rng.normal(size=(_TUMBLES, 3))
    omega *= rng.uniform(0.0, _LARGEST_TUMBLE, (_TUMBLES, 1)) / np.linalg.norm(omega, axis=1, keepdims=True)
    with jax.enable_x64(True):
        start = RigidBodyState(jnp.asarray(q_BN / np.linalg.norm(q_BN, axis=1, keepdims=True)), jnp.asarray(omega))
        flown = jax.jit(jax.vmap(lambda state: _free(state, task)))(start)
        assert flown.q_BN.dtype == np.float64
        return Tumbles(np.asarray(flown.q_BN), np.asarray(flown.omega_BN_B))


def _free(start: RigidBodyState, task: TaskConfig) -> RigidBodyState:
    inertia_B = jnp.array(task.spacecraft.inertia)

    def advance(state: RigidBodyState, _: None) -> tuple[RigidBodyState, RigidBodyState]:
        following = dynamics.step(state, jnp.zeros(3), inertia_B, task.step_seconds)
        return following, following

    _, path = jax.lax.scan(advance, start, None, length=task.episode_steps)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, path)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
