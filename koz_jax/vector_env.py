"""Many maneuvers in step, for code that wants an environment: the pure core, and NumPy arrays around it.

Every adapter (brax, Gymnasium, Stable-Baselines3) draws from here, so an environment flies the same in all of them: the
one with seed s flies in its episode k the scenario of ``jax.random.fold_in(jax.random.key(s), k)``.
"""

import operator
from collections.abc import Sequence
from typing import SupportsIndex

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from flax import struct

from koz_jax import env, evaluation, keep_out, observation, reward, scenario, task
from koz_jax.env import EnvParams, EnvState
from koz_jax.errors import UserError
from koz_jax.evaluation import MonteCarloConfig
from koz_jax.layout import ACTION_SIZE, as_numbers
from koz_jax.scenario import InfeasibleRule, ScenarioRanges
from koz_jax.task_config import TaskConfig

MAX_ENVS = 2**20


class Maneuvers(struct.PyTreeNode):
    """What is flown; its numbers are traced, so that other ones do not mean another compilation."""

    params: EnvParams
    ranges: ScenarioRanges
    rule: InfeasibleRule = struct.field(pytree_node=False)
    episode_steps: int = struct.field(pytree_node=False)

    def begin(self, key: jax.Array) -> EnvState:
        """Begin a maneuver.  key: () typed, of this episode alone."""
        return env.reset(scenario.sample(key, self.ranges, self.params.spacecraft.boresight_B, self.rule))

    def observe(self, state: EnvState) -> jax.Array:
        """What is seen of all the zones that a scenario can have.  Returns (16,), 5 more for each zone above one."""
        return observation.observe(state, self.params, self.ranges.max_zones)


class VectorState(struct.PyTreeNode):
    """Environments under way; leaves have a leading axis of environments."""

    maneuver: EnvState
    key: jax.Array  # (n,) typed, one per environment for all its episodes
    episode: jax.Array  # (n,) int32, episodes begun before this one
    min_margin: jax.Array  # (n,) [rad] smallest margin to any zone in this episode


class VectorStep(struct.PyTreeNode):
    """What one step of all environments gives.  An environment whose episode is over is already in its next one.

    Observations have 16 entries, 5 more for each zone above one that a scenario can have.
    """

    observation: jax.Array  # (n, entries) to act on next: the first of the new episode where the old one is over
    final_observation: jax.Array  # (n, entries) that the step itself led to
    reward: jax.Array  # (n,) of the paper
    terminated: jax.Array  # (n,) bool, always false: neither settling nor a violation ends a maneuver
    truncated: jax.Array  # (n,) bool, the episode's time is up
    zone_margin: jax.Array  # (n,) [rad] to the nearest zone, after the step
    pointing_error: jax.Array  # (n,) [rad] phi after the step
    settled: jax.Array  # (n,) bool, phi is within the accuracy asked for
    violated: jax.Array  # (n,) bool, some zone was entered in this episode


def maneuvers(
    task_config: TaskConfig | None = None, min_angle_deg: float = 80.0, max_angle_deg: float = 180.0
) -> Maneuvers:
    """Set up maneuvers of a task with deviations uniform between two angles [deg].

    Raises:
        UserError: the angles are not in [0, 180], not in order, or leave no room for a zone.

    """
    task_config = task_config or TaskConfig()
    MonteCarloConfig(min_angle_deg=min_angle_deg, max_angle_deg=max_angle_deg)
    evaluation.check_feasible(task_config, max_angle_deg)
    return Maneuvers(
        params=task.env_params(task_config),
        ranges=task.scenario_ranges(task_config.scenario, min_angle_deg, max_angle_deg),
        rule=task_config.scenario.infeasible_zone,
        episode_steps=task_config.episode_steps,
    )


def _margin(flown: Maneuvers, state: EnvState) -> jax.Array:
    boresight_N = env.boresight_N(state.body, flown.params.spacecraft)
    return keep_out.smallest_margin(boresight_N, state.scenario.zones)


@jax.jit
def reset(flown: Maneuvers, key: jax.Array, episode: jax.Array) -> tuple[VectorState, jax.Array]:
    """Begin an episode in every environment.

    key: (n,) typed; episode: (n,) int32.  Returns the state and observations (n, entries).
    """
    begun = jax.vmap(flown.begin)(jax.vmap(jax.random.fold_in)(key, episode))
    margin = jax.vmap(_margin, in_axes=(None, 0))(flown, begun)
    observed = jax.vmap(flown.observe)(begun)
    return VectorState(begun, key, episode, margin), observed


@jax.jit
def step(flown: Maneuvers, state: VectorState, action: jax.Array) -> tuple[VectorState, VectorStep]:
    """Step every environment; where that ends an episode, the next one begins within the same step.

    action: (n, 3) in [-1, 1] (clipped).
    """
    params = flown.params
    after, outcome = jax.vmap(env.step, in_axes=(0, 0, None))(state.maneuver, action, params)
    terms = jax.vmap(reward.terms, in_axes=(0, None, None))(outcome, params.reward, params.spacecraft.torque_limit)
    min_margin = jnp.minimum(state.min_margin, outcome.zone_margin)
    truncated = after.steps >= flown.episode_steps
    final_observation = jax.vmap(flown.observe)(after)
    going_on = state.replace(maneuver=after, min_margin=min_margin)

    def restart() -> tuple[VectorState, jax.Array]:
        fresh = reset(flown, state.key, state.episode + 1)
        return env.choose(truncated, fresh, (going_on, final_observation))

    # Drawing scenarios costs more than a step, and most steps end no episode.
    next_state, observed = jax.lax.cond(jnp.any(truncated), restart, lambda: (going_on, final_observation))
    return next_state, VectorStep(
        observation=observed,
        final_observation=final_observation,
        reward=reward.total(terms, reward.PAPER_WEIGHTS),
        terminated=jnp.zeros_like(truncated),
        truncated=truncated,
        zone_margin=outcome.zone_margin,
        pointing_error=reward.pointing_error(after.angle, params.reward),
        settled=reward.is_settled(after.angle, params.reward),
        violated=min_margin <= 0.0,
    )


class Fleet:
    """Environments behind NumPy arrays; what the adapters outside jax share."""

    def __init__(
        self,
        num_envs: int,
        task_config: TaskConfig | None = None,
        min_angle_deg: float = 80.0,
        max_angle_deg: float = 180.0,
    ) -> None:
        """Set up; ``reset`` before the first step."""
        if not isinstance(num_envs, int | np.integer) or not 1 <= num_envs <= MAX_ENVS:
            raise UserError(f"num_envs: must be a whole number from 1 to {MAX_ENVS}, got {num_envs!r}")
        self.num_envs = num_envs
        self._maneuvers = maneuvers(task_config, min_angle_deg, max_angle_deg)
        self._state: VectorState | None = None

    @property
    def begun(self) -> bool:
        """Whether there was a first reset."""
        return self._state is not None

    def reset(self, seeds: Sequence[int] | None = None) -> npt.NDArray[np.float32]:
        """Begin the first episode of every seed, or with None the next one of the seeds that are set.

        seeds: one per environment, from 0 to 2^32 - 1 (see ``seeds_from``).  Returns observations (n, entries).
        """
        if seeds is not None:
            key, episode = _keys(seeds, self.num_envs), jnp.zeros(self.num_envs, jnp.int32)
        elif self._state is not None:
            key, episode = self._state.key, self._state.episode + 1
        else:
            raise UserError("seeds: must be given at the first reset, got None")
        self._state, observed = reset(self._maneuvers, key, episode)
        return np.array(observed)

    def step(self, actions: npt.ArrayLike) -> VectorStep:
        """Step every environment.  actions: (n, 3) in [-1, 1] (clipped).  Returns NumPy leaves (n, ...)."""
        if self._state is None:
            raise UserError("step: must come after a reset, got none so far")
        given = as_numbers("actions", actions)
        if given.shape != (self.num_envs, ACTION_SIZE):
            raise UserError(f"actions: must have shape {(self.num_envs, ACTION_SIZE)}, got {given.shape}")
        self._state, stepped = step(self._maneuvers, self._state, given)
        # Copies, because what jax lends is read-only.
        return jax.tree.map(np.array, stepped)


def _keys(seeds: Sequence[int], num_envs: int) -> jax.Array:
    """Typed keys (n,) of the environments."""
    if len(seeds) != num_envs:
        raise UserError(f"seeds: must be one for each of {num_envs} environments, got {len(seeds)}")
    checked = [_checked_seed(seed) for seed in seeds]
    return jax.vmap(jax.random.key)(np.array(checked, np.uint32))


def seeds_from(first: SupportsIndex, num_envs: int) -> range:
    """Seeds of environments that follow one another.

    Raises:
        UserError: they do not all lie from 0 to 2^32 - 1.

    """
    start = _checked_seed(first)
    if start + num_envs > 2**32:
        raise UserError(f"seed: must be from 0 to 2^32 - {num_envs} for {num_envs} environments, got {first}")
    return range(start, start + num_envs)


def _checked_seed(seed: SupportsIndex) -> int:
    try:
        number = operator.index(seed)
    except TypeError:
        number = -1
    if not 0 <= number < 2**32:
        raise UserError(f"seed: must be a whole number from 0 to 2^32 - 1, got {seed!r}")
    return number


def observation_bounds(task_config: TaskConfig) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Bounds that no observation of a maneuver leaves, for code that wants a finite space.  Returns (low, high).

    Momentum grows by at most the torque's impulse; the rest are unit vectors, and angles of at most a half turn.
    """
    spacecraft = task_config.spacecraft
    moments = np.linalg.eigvalsh(np.array(spacecraft.inertia))
    start = np.sqrt(3.0) * np.deg2rad(task_config.scenario.max_rate_deg) * moments[-1]
    impulse = np.sqrt(3.0) * spacecraft.torque_limit * task_config.episode_seconds
    limits = {
        "omega_BN_B": (start + impulse) / moments[0],
        "zone_angle": np.pi,
        "zone_margin": np.pi - keep_out.NO_ZONE_HALF_ANGLE,
    }
    zones = task_config.scenario.max_zones
    high = np.ones(observation.size(zones))
    for name, part in observation.slices(zones).items():
        # Further zones have a number in front of the name.
        high[part] = next((limit for ending, limit in limits.items() if name.endswith(ending)), 1.0)
    # A little more, for what float32 rounds.
    high = (1.001 * high).astype(np.float32)
    return -high, high
