"""Monte Carlo evaluation: any number of cases in one jitted call, sharded over devices, memory bounded.

A case is its index: case i of a seed is the same alone, in a chunk, or among a million.
"""

import dataclasses
import functools
import math
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh, PartitionSpec

from koz_jax import rollout, scenario, shield, task, uncertainty
from koz_jax.controllers.base import Controller, Pilot
from koz_jax.env import EnvParams
from koz_jax.errors import UserError
from koz_jax.rollout import CaseResult, Conditions
from koz_jax.scenario import InfeasibleRule, Scenario, ScenarioRanges
from koz_jax.shield_config import ShieldConfig, UncertaintyConfig
from koz_jax.summary import Summary
from koz_jax.task_config import TaskConfig

# Cases that a device flies together: enough to fill the vector units, few enough to stay in its cache.
_CHUNK = 500

# Separates the draws of the Monte Carlo from those of training with the same seed.
_PURPOSE = 0x4D43

# Separates what is random in flight from the draw of the cases.
_IN_FLIGHT = 0x464C59


@dataclasses.dataclass(frozen=True)
class MonteCarloConfig:
    """Which cases are flown, and how they are checked; static."""

    cases: int = 10_000
    seed: int = 0
    min_angle_deg: float = 80.0
    max_angle_deg: float = 180.0
    substeps: int = 1  # the zone is checked at so many instants per time step
    shield: ShieldConfig | None = None  # None flies without
    uncertainty: UncertaintyConfig | None = None  # None flies the model itself
    first: int = 0  # index of the first case

    def __post_init__(self) -> None:
        _require(0 < self.cases < 2**31, "cases", self.cases, "from 1 to 2^31 - 1")
        _require(0 <= self.first < 2**31 - self.cases + 1, "first", self.first, "from 0 to 2^31 - cases")
        _require(0 <= self.seed < 2**32, "seed", self.seed, "from 0 to 2^32 - 1")
        _require(0 < self.substeps <= 100, "substeps", self.substeps, "from 1 to 100")
        _require(0 <= self.min_angle_deg <= 180, "min_angle_deg", self.min_angle_deg, "in [0, 180]")
        _require(
            self.min_angle_deg <= self.max_angle_deg <= 180,
            "max_angle_deg",
            self.max_angle_deg,
            f"in [min_angle_deg = {self.min_angle_deg}, 180]",
        )


def _require(holds: bool, name: str, value: float, allowed: str) -> None:
    if not holds:
        raise UserError(f"{name}: must be {allowed}, got {value}")


@dataclasses.dataclass(frozen=True)
class MonteCarlo:
    """The outcome of every case, and what it took."""

    agent: str  # name of the agent, or the folder it came from
    config: MonteCarloConfig
    results: CaseResult  # NumPy leaves (cases,)
    compile_s: float  # [s] tracing and compiling
    wall_s: float  # [s] flying


def check_feasible(task_config: TaskConfig, max_angle_deg: float, name: str = "max_angle_deg") -> None:
    """Refuse a deviation range in which ``resample`` could draw for ever.

    The boresight is at most half the deviation away from the zone's axis at start and target.  name: the setting that
    gave ``max_angle_deg``, for the message.
    """
    needed = 2.0 * (task_config.scenario.min_half_angle_deg + task_config.scenario.separation_deg)
    if task_config.scenario.infeasible_zone == "resample" and max_angle_deg <= needed:
        raise UserError(
            f"{name}: must be above {needed:g} deg, so that a zone fits between start and target under the rule"
            f" 'resample'; got {max_angle_deg:g}. The rule 'shrink' leaves such zones out."
        )


class _Draw(struct.PyTreeNode):
    """What cases are drawn from; traced, so that another seed or another range does not mean a new compilation."""

    key: jax.Array  # () typed PRNG key
    ranges: ScenarioRanges
    rule: InfeasibleRule = struct.field(pytree_node=False)

    def case(self, index: jax.Array | int, boresight_B: jax.Array) -> Scenario:
        """One case.  index: () int; boresight_B: (3,)."""
        return scenario.sample(jax.random.fold_in(self.key, index), self.ranges, boresight_B, self.rule)

    def flight_key(self, index: jax.Array | int) -> jax.Array:
        """Key of what is random while a case is flown.  index: () int."""
        return jax.random.fold_in(jax.random.fold_in(self.key, _IN_FLIGHT), index)


def _draw(task_config: TaskConfig, config: MonteCarloConfig) -> _Draw:
    return _Draw(
        key=jax.random.fold_in(jax.random.key(config.seed), _PURPOSE),
        ranges=task.scenario_ranges(task_config.scenario, config.min_angle_deg, config.max_angle_deg),
        rule=task_config.scenario.infeasible_zone,
    )


def conditions(task_config: TaskConfig, config: MonteCarloConfig) -> Conditions:
    """Make the shield and the uncertainty that the settings ask for."""
    params = task.env_params(task_config)
    if config.shield:
        config.shield.check(task_config.spacecraft.torque_limit)
    return Conditions(
        shield=shield.for_spacecraft(config.shield, params.spacecraft, params.dt) if config.shield else None,
        uncertainty=uncertainty.from_config(config.uncertainty) if config.uncertainty else None,
    )


def draw_case(task_config: TaskConfig, config: MonteCarloConfig, case: jax.Array | int) -> Scenario:
    """Draw the scenario of one case.  case: () int, its index."""
    return _draw(task_config, config).case(case, jnp.array(task_config.spacecraft.boresight))


class _Flight(struct.PyTreeNode):
    """Who flies what under which conditions; traced but for the counts."""

    controller: Controller
    params: EnvParams
    conditions: Conditions
    steps: int = struct.field(pytree_node=False)
    substeps: int = struct.field(pytree_node=False)

    def judge(self, drawn: Scenario, key: jax.Array) -> CaseResult:
        return rollout.run_case(self.controller, drawn, self.params, self.steps, self.substeps, self.conditions, key)

    def keep(self, drawn: Scenario, key: jax.Array) -> rollout.History:
        return rollout.fly(self.controller, drawn, self.params, self.steps, self.conditions, key)


def _flight(controller: Controller, task_config: TaskConfig, config: MonteCarloConfig) -> _Flight:
    return _Flight(
        controller=controller,
        params=task.env_params(task_config),
        conditions=conditions(task_config, config),
        steps=task_config.episode_steps,
        substeps=config.substeps,
    )


@functools.partial(jax.jit, static_argnames="mesh")
def _fly_cases(flight: _Flight, draw: _Draw, cases: jax.Array, *, mesh: Mesh) -> CaseResult:
    """cases: (devices * n,) int32 indices.  Returns leaves of the same length."""

    def one(case: jax.Array) -> CaseResult:
        return flight.judge(draw.case(case, flight.params.spacecraft.boresight_B), draw.flight_key(case))

    def on_one_device(cases: jax.Array) -> CaseResult:
        return jax.lax.map(one, cases, batch_size=_CHUNK)

    over_cases = PartitionSpec("cases")
    sharded = jax.shard_map(on_one_device, mesh=mesh, in_specs=over_cases, out_specs=over_cases, check_vma=False)
    return sharded(cases)


def _arguments(
    controller: Controller, task_config: TaskConfig, config: MonteCarloConfig
) -> tuple[tuple[_Flight, _Draw, jax.Array], dict[str, Any]]:
    """Traced and static arguments of ``_fly_cases``."""
    check_feasible(task_config, config.max_angle_deg)
    devices = jax.local_devices()[: config.cases]
    # Every device flies equally many cases, in whole chunks where there is more than one: in a chunk of another size
    # numbers are rounded differently.  The surplus is flown and dropped.
    share = -(-config.cases // len(devices))
    if share > _CHUNK or config.first:
        share = -(-share // _CHUNK) * _CHUNK
    padded = share * len(devices)
    traced = (
        _flight(controller, task_config, config),
        _draw(task_config, config),
        config.first + jnp.arange(padded, dtype=jnp.int32),
    )
    return traced, {"mesh": Mesh(np.array(devices), ("cases",))}


def _to_host(results: CaseResult, cases: int) -> CaseResult:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:cases], results)


def fly_cases(controller: Controller, task_config: TaskConfig, config: MonteCarloConfig) -> CaseResult:
    """Fly all cases on all local devices.  Returns NumPy leaves (cases,)."""
    traced, static = _arguments(controller, task_config, config)
    return _to_host(_fly_cases(*traced, **static), config.cases)


def result_shapes(controller: Controller, task_config: TaskConfig, config: MonteCarloConfig) -> CaseResult:
    """Shapes and types of what ``fly_cases`` returns, without flying."""
    traced, static = _arguments(controller, task_config, config)
    shapes = jax.eval_shape(functools.partial(_fly_cases, **static), *traced)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((config.cases,), leaf.dtype), shapes)


def run_cases(agent: Pilot, task_config: TaskConfig, config: MonteCarloConfig) -> MonteCarlo:
    """``fly_cases`` for an agent, with compilation and flight timed apart."""
    traced, static = _arguments(agent.controller, task_config, config)
    start = time.perf_counter()
    compiled = _fly_cases.lower(*traced, **static).compile()
    ready = time.perf_counter()
    results = jax.block_until_ready(compiled(*traced))
    done = time.perf_counter()
    results = _to_host(results, config.cases)
    return MonteCarlo(agent.name, config, results, compile_s=ready - start, wall_s=done - ready)


def report(flown: MonteCarlo, summary: Summary) -> dict[str, float | int | str | None]:
    """Put the results into a JSON object (keys as in the documentation of ``eval_mc.py``); nan becomes null."""
    rows = {name: None if math.isnan(value) else value for name, value in vars(summary).items()}
    return {
        "cases": flown.config.cases,
        "seed": flown.config.seed,
        "agent": flown.agent,
        **rows,
        "compile_s": flown.compile_s,
        "wall_s": flown.wall_s,
    }


def monte_carlo(
    agent: Pilot, cases: int = 10_000, seed: int = 0, task_config: TaskConfig | None = None, **options: Any
) -> MonteCarlo:
    """Fly an agent over ``cases`` random cases of the task it was trained for (or of another one).

    options: further fields of ``MonteCarloConfig``.
    """
    config = MonteCarloConfig(cases=cases, seed=seed, **options)
    return run_cases(agent, task_config or agent.task, config)


def fly_case(
    agent: Pilot, case: int, config: MonteCarloConfig, task_config: TaskConfig | None = None
) -> tuple[rollout.History, CaseResult]:
    """Fly one case of the draw again and keep its history."""
    _require(0 <= case < config.cases, "case", case, f"from 0 to cases - 1 = {config.cases - 1}")
    flown = task_config or agent.task
    check_feasible(flown, config.max_angle_deg)
    return fly_scenario(agent, draw_case(flown, config, jnp.int32(case)), flown, config, case)


def fly_scenario(
    agent: Pilot,
    drawn: Scenario,
    task_config: TaskConfig | None = None,
    config: MonteCarloConfig | None = None,
    case: int = 0,
) -> tuple[rollout.History, CaseResult]:
    """Fly one scenario, and keep its history and its judgement.

    config: how it is flown and checked; its draw is not used.  case: index of the case whose random numbers are used.
    """
    flown, how = task_config or agent.task, config or MonteCarloConfig()
    key = _draw(flown, how).flight_key(case)
    return _keep_and_judge(_flight(agent.controller, flown, how), drawn, key)


@jax.jit
def _keep_and_judge(flight: _Flight, drawn: Scenario, key: jax.Array) -> tuple[rollout.History, CaseResult]:
    return flight.keep(drawn, key), flight.judge(drawn, key)
