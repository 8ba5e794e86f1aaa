"""Flying cases of a draw: any number in one jitted call, sharded over devices; or one of them, with its history.

A case is its index: case i of a seed is the same alone, in a chunk, or among a million.
"""

import dataclasses
import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh, PartitionSpec

from koz_jax import devices
from koz_jax.config.filters import FilterConfig, for_cones
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig, check_feasible
from koz_jax.control.base import Controller, TaskController
from koz_jax.control.filters.from_settings import under_filter
from koz_jax.control.registry import as_task_controller
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cautions, rollout
from koz_jax.evaluation.rollout import CaseResult, History
from koz_jax.task import maneuver, uncertainty
from koz_jax.task.any_spacecraft import spread
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.environment import Reorientation
from koz_jax.task.scenario import SamplingRule, Scenario

# Cases that a core flies together: enough to fill the vector units, few enough to stay in its cache.
_CHUNK = 500

# The same on a GPU, which takes as long for one case as for thousands.
_CHUNK_ON_GPU = 100_000

# Separates the draws of the Monte Carlo from those of training with the same seed.
_PURPOSE = 0x4D43

# Separates what is random in flight from the draw of the cases.
_IN_FLIGHT = 0x464C59


@dataclasses.dataclass(frozen=True)
class Flown:
    """The outcome of some cases, and what it took."""

    results: CaseResult  # NumPy leaves (cases,)
    compile_s: float  # [s] tracing and compiling
    wall_s: float  # [s] flying


class _Flight(struct.PyTreeNode):
    """Who flies what; traced but for the counts, so that another seed or range does not mean a new compilation."""

    env: Reorientation
    controller: Controller
    key: jax.Array  # () typed PRNG key of the draw
    substeps: int = struct.field(pytree_node=False)
    shield: FilterConfig | None = struct.field(pytree_node=False)

    def case(self, index: jax.Array | int) -> Scenario:
        """Draw one case.  index: () int."""
        return self.env.sample(jax.random.fold_in(self.key, index))

    def flight_key(self, index: jax.Array | int) -> jax.Array:
        """Key of what is random while a case is flown.  index: () int."""
        return _flight_key(self.key, index)

    def of_case(self, index: jax.Array | int) -> "_Flight":
        """The flight with all that is drawn for a case.  index: () int."""
        return self.replace(env=_of_case(self.env, self.key, index, self.shield))

    def evaluate(self, drawn: Scenario, key: jax.Array) -> CaseResult:
        return rollout.run_case(self.env, self.controller, drawn, self.substeps, key)


def environment(task: TaskConfig, config: MonteCarloConfig) -> Reorientation:
    """Set up what cases are flown in, under the conditions that the settings ask for.

    Raises:
        SettingsError: the shield has no torque for what it is to withstand.

    """
    rule = SamplingRule(task.scenario.infeasible_zone)
    env = Reorientation.from_config(task, config.min_angle_deg, config.max_angle_deg, rule=rule)
    if config.uncertainty is not None:
        env = env.replace(uncertainty=uncertainty.from_config(config.uncertainty))
    flown_under = _filter(task, config)
    if flown_under is not None:
        flown_under.check(task.spacecraft.brake_limits)
    return under_filter(env, flown_under)


def _filter(task: TaskConfig, config: MonteCarloConfig) -> FilterConfig | None:
    """What is flown under, which allows for zones that turn."""
    return None if config.shield is None else for_cones(config.shield, task.scenario.cone_rate_deg)


def _key(config: MonteCarloConfig) -> jax.Array:
    return jax.random.fold_in(jax.random.key(config.seed), _PURPOSE)


def _of_case(env: Reorientation, key: jax.Array, index: jax.Array | int, shield: FilterConfig | None) -> Reorientation:
    """An environment with all that is drawn for a case, and the shield of the spacecraft that is drawn."""
    if env.spread is None:
        return env
    return under_filter(env.drawn(jax.random.fold_in(jax.random.fold_in(key, spread.PURPOSE), index)), shield)


def _flight_key(key: jax.Array, index: jax.Array | int) -> jax.Array:
    return jax.random.fold_in(jax.random.fold_in(key, _IN_FLIGHT), index)


def _flight(controller: Controller, task: TaskConfig, config: MonteCarloConfig) -> _Flight:
    env = environment(task, config)
    # Where every case has a spacecraft of its own, it also has a shield of its own.
    shield = None if env.spread is None else _filter(task, config)
    return _Flight(env, controller, _key(config), config.substeps, shield)


def draw_case(task: TaskConfig, config: MonteCarloConfig, case: jax.Array | int) -> Scenario:
    """Draw the scenario of one case.  case: () int, its index.

    Raises:
        SettingsError: no zone fits between start and target.

    """
    check_feasible(task, config.max_angle_deg)
    return _draw(environment(task, config), _key(config), jnp.int32(case))


@jax.jit
def _draw(env: Reorientation, key: jax.Array, case: jax.Array) -> Scenario:
    return _of_case(env, key, case, None).sample(jax.random.fold_in(key, case))


def _chunk() -> int:
    """Cases that a device flies together."""
    return _CHUNK_ON_GPU if devices.on_gpu() else _CHUNK


@functools.partial(jax.jit, static_argnames="mesh")
@devices.in_float32
def _fly_cases(flight: _Flight, cases: jax.Array, *, mesh: Mesh) -> CaseResult:
    """cases: (devices * n,) int32 indices.  Returns leaves of the same length."""

    def one(case: jax.Array) -> CaseResult:
        own = flight.of_case(case)
        return own.evaluate(own.case(case), own.flight_key(case))

    def on_one_device(cases: jax.Array) -> CaseResult:
        return jax.lax.map(one, cases, batch_size=_chunk())

    over_cases = PartitionSpec("cases")
    sharded = jax.shard_map(on_one_device, mesh=mesh, in_specs=over_cases, out_specs=over_cases, check_vma=False)
    return sharded(cases)


def _arguments(
    controller: Controller, task: TaskConfig, config: MonteCarloConfig
) -> tuple[tuple[_Flight, jax.Array], dict[str, Any]]:
    """Traced and static arguments of ``_fly_cases``."""
    check_feasible(task, config.max_angle_deg)
    present = jax.local_devices()[: config.cases]
    # Every device flies equally many cases, in whole chunks where there is more than one: in a chunk of another size
    # numbers are rounded differently.  The surplus is flown and dropped.
    share = -(-config.cases // len(present))
    if share > _chunk() or (config.first and not devices.on_gpu()):
        share = -(-share // _chunk()) * _chunk()
    padded = share * len(present)
    cases = config.first + jnp.arange(padded, dtype=jnp.int32)
    return (_flight(controller, task, config), cases), {"mesh": Mesh(np.array(present), ("cases",))}


def _to_host(results: CaseResult, cases: int) -> CaseResult:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:cases], results)


def fly_cases(controller: Controller, task: TaskConfig, config: MonteCarloConfig) -> CaseResult:
    """Fly all cases on all local devices.  Returns NumPy leaves (cases,)."""
    traced, static = _arguments(controller, task, config)
    return _to_host(_fly_cases(*traced, **static), config.cases)


def compile_flight(controller: Controller, task: TaskConfig, config: MonteCarloConfig) -> object:
    """Compile what ``fly_cases`` needs.  controller: its arrays, or their shapes alone."""
    traced, static = _arguments(controller, task, config)
    return _fly_cases.lower(*traced, **static).compile()


def result_shapes(controller: Controller, task: TaskConfig, config: MonteCarloConfig) -> CaseResult:
    """Shapes and types of what ``fly_cases`` returns, without flying."""
    traced, static = _arguments(controller, task, config)
    shapes = jax.eval_shape(functools.partial(_fly_cases, **static), *traced)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((config.cases,), leaf.dtype), shapes)


def fly_timed(controller: Controller, task: TaskConfig, config: MonteCarloConfig) -> Flown:
    """``fly_cases``, with compilation and flight timed apart."""
    traced, static = _arguments(controller, task, config)
    start = time.perf_counter()
    compiled = _fly_cases.lower(*traced, **static).compile()
    ready = time.perf_counter()
    results = jax.block_until_ready(compiled(*traced))
    done = time.perf_counter()
    return Flown(_to_host(results, config.cases), compile_s=ready - start, wall_s=done - ready)


def fly_case(
    agent: TaskController, case: int, config: MonteCarloConfig, task: TaskConfig | None = None
) -> tuple[History, CaseResult]:
    """Fly one case of the draw again and keep its history."""
    if not 0 <= case < config.cases:
        raise SettingsError(f"case: must be from 0 to cases - 1 = {config.cases - 1}, got {case}")
    flown = task or agent.task
    return fly_scenario(agent, draw_case(flown, config, jnp.int32(case)), flown, config, case)


def fly_scenario(
    agent: TaskController | Controller,
    drawn: Scenario,
    task: TaskConfig | None = None,
    config: MonteCarloConfig | None = None,
    case: int = 0,
) -> tuple[History, CaseResult]:
    """Fly one scenario, and keep its history and its judgement.

    drawn: checked before it is flown, see ``maneuver.checked``.  config: how it is flown and checked; its draw is not
    used.  case: index of the case whose random numbers are used.

    Raises:
        SettingsError: the scenario holds a direction, a quaternion, a rate or an angle that is none, or the
            controller cannot fly.

    """
    flying = as_task_controller(agent, task)
    how, flown = config or MonteCarloConfig(), task or flying.task
    right = maneuver.checked(drawn)
    maneuver.tell_of_another_boresight(right, flown.spacecraft.boresight)
    cautions.warn_of_differences(flying, flown)
    flown_under = _filter(flown, how)
    cautions.warn_of_target(flying, right, flown_under)
    rates = right.constraints.axis_rate_N
    if flown_under is not None and rates is not None:
        flown_under.check_cones(float(np.rad2deg(np.linalg.norm(rates, axis=1).max())))
    flight = _flight(flying.controller, flown, how).of_case(case)
    return _keep_and_evaluate(flight, right, flight.flight_key(case))


@jax.jit
@devices.in_float32
def _keep_and_evaluate(flight: _Flight, drawn: Scenario, key: jax.Array) -> tuple[History, CaseResult]:
    return rollout.fly_and_judge(flight.env, flight.controller, drawn, flight.substeps, key)


def within_steps(history: History, task: TaskConfig, config: MonteCarloConfig, case: int = 0) -> RigidBodyState:
    """Where the body was also between the steps of what ``fly_scenario`` flew with the same arguments.

    Returns leaves (steps * substeps + 1, ...), with the settings' ``substeps``.
    """
    env = _of_case(environment(task, config), _key(config), case, _filter(task, config))
    return _within_steps(env, history, _flight_key(_key(config), case), config.substeps)


@functools.partial(jax.jit, static_argnames="substeps")
def _within_steps(env: Reorientation, history: History, key: jax.Array, substeps: int) -> RigidBodyState:
    return rollout.within_steps(env, history, substeps, key)
