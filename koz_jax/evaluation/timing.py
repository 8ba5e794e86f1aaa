"""How long a controller takes to decide, and to prepare for a maneuver.  Measured, so no function of its arguments."""

import time
from collections.abc import Callable

import jax
import jax.numpy as jnp

from koz_jax.config.filters import FilterConfig
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.base import Controller, Memoryless
from koz_jax.evaluation import cases, rollout
from koz_jax.task import scenario
from koz_jax.task.environment import Reorientation
from koz_jax.task.state import EnvState, Model

_REPEATS = 5


class _Idle(Memoryless):
    """Decides nothing."""

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """No torque."""
        return jnp.zeros(3), memory


def decision_us(controller: Controller, task: TaskConfig, shield: FilterConfig | None = None) -> float:
    """Microseconds per decision of one maneuver alone, filter included.

    The time of the paper's test maneuver, less that of one in which nothing is decided, over its steps.
    """

    def seconds(flown: Controller, shield: FilterConfig | None) -> float:
        env = cases.environment(task, MonteCarloConfig(shield=shield))
        run = jax.jit(lambda env, who: rollout.run_case(env, who, scenario.paper_test()).reward)
        return _best_seconds(lambda: run(env, flown))

    return 1e6 * (seconds(controller, shield) - seconds(_Idle(), None)) / task.episode_steps


def planning_ms(controller: Controller, task: TaskConfig) -> float:
    """Milliseconds to the first decision of the paper's test maneuver, in which planners plan."""
    env = cases.environment(task, MonteCarloConfig())

    @jax.jit
    def first(env: Reorientation, who: Controller) -> jax.Array:
        start = env.reset(scenario.paper_test())
        return who.decide(start, env.model, who.begin(start, env.model, jax.random.key(0)))[0]

    return 1e3 * _best_seconds(lambda: first(env, controller))


def _best_seconds(run: Callable[[], object]) -> float:
    """Shortest time of several, compilation apart."""
    jax.block_until_ready(run())
    times = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(run())
        times.append(time.perf_counter() - start)
    return min(times)
