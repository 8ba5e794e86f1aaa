"""Torque requests that do their worst under the shield, found by search, flown again by another integrator in float64.

    python benchmarks/worst_torques.py [--only WORD ...] [--cases N] [--markdown FILE]

For each case the cross-entropy method looks for the 300 requests, each held for ten steps, whose smallest margin is
least.  The torques that the shield makes of the worst ones are then integrated in NumPy, 20 instants a step, and the
zones are checked at every instant.
"""

import argparse
import dataclasses
import functools
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import stamp

from koz_jax.cli.exit_status import exit_status
from koz_jax.config.filters import FilterConfig, for_cones
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import ScenarioConfig, TaskConfig
from koz_jax.control.filters.from_settings import under_filter
from koz_jax.storage import runtime
from koz_jax.task.environment import Reorientation
from koz_jax.task.scenario import Scenario
from koz_jax.task.state import EnvState

STEPS, HELD = 300, 10
POPULATION, ELITE, GENERATIONS = 64, 8, 8
SMALLEST_SPREAD = 0.1
INSTANTS = 20
COLUMNS = ("trial", "by", "cases", "violated", "smallest margin [deg]", "of the first draw [deg]")


@dataclasses.dataclass(frozen=True)
class Trial:
    """Cases that are searched."""

    title: str
    task: TaskConfig


def trials() -> Iterator[Trial]:
    """Everything that is searched."""
    anyone = SpreadConfig(spacecraft=True)

    def of(**changes: Any) -> TaskConfig:
        return TaskConfig(spread=anyone.model_copy(update=changes))

    yield Trial("the paper's spacecraft", TaskConfig())
    yield Trial("random spacecraft, 4 zones", of(zones=(4, 4)))
    yield Trial("random, slender, 4 zones", of(zones=(4, 4), slenderness=(0.05, 0.1)))
    yield Trial("random, 8 zones of 3 instruments, some to be kept in", of(zones=(8, 8), instruments=3, keep_in=0.4))
    yield Trial("random, at most 5 deg/s, 4 zones", of(zones=(4, 4), max_rate_deg=(5.0, 5.0)))
    yield Trial("random, four wheels in a pyramid, 4 zones", of(zones=(4, 4), wheels="pyramid"))
    yield Trial("random, long steps, 4 zones", of(zones=(4, 4), step_shares=(0.1, 0.5)))
    turning = {"scenario": ScenarioConfig(cone_rate_deg=0.2)}
    yield Trial("random, zones that turn by 0.2 deg/s, 4 zones", of(zones=(4, 4)).model_copy(update=turning))


class Flight(NamedTuple):
    """What a sequence of requests came to."""

    margin: jax.Array  # () [rad] smallest, at the steps
    torque_B: jax.Array  # (STEPS, 3) [N m] on the body
    held_B: jax.Array  # (3,) [N m s] momentum in the wheels at the start


class Case(NamedTuple):
    """A case, and the worst that was found in it."""

    env: Reorientation
    scenario: Scenario
    first: jax.Array  # () [rad] least of the first generation
    worst: Flight


def fly(env: Reorientation, scenario: Scenario, requests: jax.Array) -> Flight:
    """Fly requests (STEPS / HELD, 3) under the shield."""

    def step(state: EnvState, number: jax.Array) -> tuple[EnvState, tuple[jax.Array, jax.Array]]:
        after = env.step(state, requests[number // HELD]).state
        return after, (env.margin(after), after.torque_B)

    start = env.reset(scenario)
    held_B = env.model.actuators.stored_momentum(start.actuators)
    _, (margins, torque_B) = jax.lax.scan(step, start, jnp.arange(STEPS))
    return Flight(jnp.min(margins), torque_B, jnp.zeros(3) if held_B is None else held_B)


def search(env: Reorientation, shield: FilterConfig, key: jax.Array) -> Case:
    """Draw a case, and look for the requests that are worst in it."""
    key_case, key_search = jax.random.split(key)
    own = under_filter(env.drawn(key_case), shield)
    drawn = own.sample(key_case)
    shape = (STEPS // HELD, 3)

    def generation(carry: Any, key: jax.Array) -> tuple[Any, jax.Array]:
        mean, spread, worst, least = carry
        tried = jnp.clip(mean + spread * jax.random.normal(key, (POPULATION, *shape)), -1.0, 1.0)
        margins = jax.vmap(lambda requests: fly(own, drawn, requests).margin)(tried)
        elite = tried[jnp.argsort(margins)[:ELITE]]
        best = jnp.argmin(margins)
        better = margins[best] < least
        carry = (
            jnp.mean(elite, axis=0),
            jnp.maximum(jnp.std(elite, axis=0), SMALLEST_SPREAD),
            jnp.where(better, tried[best], worst),
            jnp.minimum(margins[best], least),
        )
        return carry, margins[best]

    begin = (jnp.zeros(shape), jnp.ones(shape), jnp.zeros(shape), jnp.float32(jnp.inf))
    (_, _, worst, _), found = jax.lax.scan(generation, begin, jax.random.split(key_search, GENERATIONS))
    return Case(own, drawn, found[0], fly(own, drawn, worst))


def smallest_margins(cases: Case) -> np.ndarray:
    """Margins of the worst flights, leaves (n, ...), by Runge-Kutta steps in float64.  Returns (n,) [rad]."""
    model, constraints = cases.env.model, cases.scenario.constraints

    def numbers(leaf: Any) -> np.ndarray:
        return np.asarray(leaf, np.float64)

    inertia, dt = numbers(model.inertia_B), numbers(model.dt) / INSTANTS
    count = len(cases.first)
    inertia = np.broadcast_to(inertia, (count, 3, 3))
    inverse, dt = np.linalg.inv(inertia), np.broadcast_to(dt, count)[:, None]
    q, w = numbers(cases.scenario.initial.q_BN), numbers(cases.scenario.initial.omega_BN_B)
    held, torques = numbers(cases.worst.held_B), numbers(cases.worst.torque_B)
    axes, rates = numbers(constraints.axis_N), constraints.axis_rate_N
    least = np.full(count, np.inf)

    def slopes(q: np.ndarray, w: np.ndarray, held: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        scalar = -np.sum(q[:, 1:] * w, axis=1, keepdims=True)
        q_slope = 0.5 * np.hstack([scalar, q[:, :1] * w + np.cross(q[:, 1:], w)])
        momentum = np.einsum("nij,nj->ni", inertia, w) + held
        return q_slope, np.einsum("nij,nj->ni", inverse, torque - np.cross(w, momentum))

    for number in range(STEPS):
        torque = torques[:, number]
        for _ in range(INSTANTS):
            q1, w1 = slopes(q, w, held, torque)
            q2, w2 = slopes(q + 0.5 * dt * q1, w + 0.5 * dt * w1, held - 0.5 * dt * torque, torque)
            q3, w3 = slopes(q + 0.5 * dt * q2, w + 0.5 * dt * w2, held - 0.5 * dt * torque, torque)
            q4, w4 = slopes(q + dt * q3, w + dt * w3, held - dt * torque, torque)
            q = q + dt / 6.0 * (q1 + 2.0 * q2 + 2.0 * q3 + q4)
            q /= np.linalg.norm(q, axis=1, keepdims=True)
            w = w + dt / 6.0 * (w1 + 2.0 * w2 + 2.0 * w3 + w4)
            if cases.env.model.actuators.stored_momentum(cases.env.model.actuators.initial_state()) is not None:
                held = held - dt * torque
            if rates is not None:
                axes = _turned(axes, numbers(rates) * dt[:, None])
            least = np.minimum(
                least, _margins(q, numbers(constraints.boresight_B), axes, numbers(constraints.half_angle))
            )
    return least


def _turned(axes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Turn vectors by small rotation vectors, exactly.  axes, angles: (n, zones, 3)."""
    size = np.linalg.norm(angles, axis=-1, keepdims=True)
    about = angles / np.where(size > 0.0, size, 1.0)
    along = np.sum(about * axes, axis=-1, keepdims=True) * about
    return along + np.cos(size) * (axes - along) + np.sin(size) * np.cross(about, axes)


def _margins(q: np.ndarray, boresights: np.ndarray, axes: np.ndarray, half_angles: np.ndarray) -> np.ndarray:
    """Smallest margin of each case.  q: (n, 4); boresights, axes: (n, zones, 3).  Returns (n,) [rad]."""
    vector = np.broadcast_to(q[:, None, 1:], boresights.shape)
    looks = boresights + 2.0 * np.cross(vector, np.cross(vector, boresights) + q[:, :1, None] * boresights)
    angles = np.arctan2(np.linalg.norm(np.cross(looks, axes), axis=-1), np.sum(looks * axes, axis=-1))
    return np.min(angles - half_angles, axis=1)


def _try_all(args: argparse.Namespace) -> int:
    runtime.configure()
    order = [(trial.title, "search") for trial in trials()]
    table = stamp.GrowingTable(args.markdown, "benchmarks/worst_torques.py", COLUMNS, order)
    for trial in trials():
        if args.only and not any(word in trial.title for word in args.only):
            continue
        shield = for_cones(ShieldConfig(), trial.task.scenario.cone_rate_deg)
        env = Reorientation.from_config(trial.task)
        keys = jax.random.split(jax.random.key(args.seed), args.cases)
        one = functools.partial(search, env, shield)
        cases = jax.jit(functools.partial(jax.lax.map, one, batch_size=10))(keys)
        found, first = smallest_margins(cases), np.asarray(cases.first)
        row = [trial.title, "search", str(args.cases), str(int(np.sum(~(found > 0.0))))]
        table.add([*row, f"{np.rad2deg(found.min()):.4f}", f"{np.rad2deg(first.min()):.4f}"])
    return 0


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/worst_torques.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[], help="words that a trial's title must hold, any of them")
    parser.add_argument("--cases", type=int, default=100, help="cases of each trial")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw and of the search")
    parser.add_argument("--markdown", type=Path, help="write the table, or add to it, for docs/results/")
    return exit_status(lambda: _try_all(parser.parse_args(argv)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
