"""Many maneuvers in step, for code that wants an environment: the core in jax, and NumPy arrays around it.

Every adapter (brax, Gymnasium, Stable-Baselines3) draws from here, so an environment flies the same in all of them: the
one with seed s flies in its episode k the scenario of ``jax.random.fold_in(jax.random.key(s), k)``.
"""

import functools
import operator
from collections.abc import Mapping, Sequence
from typing import Any, SupportsIndex

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from flax import struct

from koz_jax.adapters.forks import refuse_in_fork
from koz_jax.config.task import TaskConfig, check_deviations, check_feasible
from koz_jax.errors import SettingsError
from koz_jax.task import maneuver, pointing_constraints, reward
from koz_jax.task.environment import Reorientation
from koz_jax.task.observation_layout import ACTION_SIZE, SLICES, as_numbers, observation_bounds
from koz_jax.task.scenario import Scenario
from koz_jax.task.state import EnvState

MAX_ENVS = 2**20

# Options of a reset that make a maneuver: arguments of ``maneuver.maneuver``.
MANEUVER_OPTIONS = frozenset({"start", "target", "zones", "boresight", "rate_deg"})


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


def episode_keys(key: jax.Array, episode: jax.Array) -> jax.Array:
    """Keys (n,) of maneuvers.  key: (n,) typed, one per environment; episode: (n,) int32, its number there."""
    return jax.vmap(jax.random.fold_in)(key, episode)


@jax.jit
def reset(env: Reorientation, key: jax.Array, episode: jax.Array) -> tuple[VectorState, jax.Array]:
    """Begin an episode in every environment.

    key: (n,) typed; episode: (n,) int32.  Returns the state and observations (n, entries).
    """
    return begin(env, jax.vmap(env.sample)(episode_keys(key, episode)), key, episode)


@jax.jit
def begin(env: Reorientation, drawn: Scenario, key: jax.Array, episode: jax.Array) -> tuple[VectorState, jax.Array]:
    """Begin an episode with a scenario in every environment.  drawn: leaves (n, ...); the rest as of ``reset``."""
    begun = jax.vmap(env.reset)(drawn)
    return VectorState(begun, key, episode, jax.vmap(env.margin)(begun)), jax.vmap(env.observe)(begun)


@jax.jit
def _draw(env: Reorientation, key: jax.Array, episode: jax.Array) -> Scenario:
    """Draw the scenarios of an episode.  Returns leaves (n, ...)."""
    return jax.vmap(env.sample)(episode_keys(key, episode))


@jax.jit
def step(env: Reorientation, state: VectorState, action: jax.Array) -> tuple[VectorState, VectorStep]:
    """Step every environment; where that ends an episode, the next one begins within the same step.

    action: (n, 3) in [-1, 1] (clipped).
    """
    stepped = env.step_autoreset(state.maneuver, action, lambda: episode_keys(state.key, state.episode + 1))
    over, margin, angle = stepped.truncated, stepped.outcome.zone_margin, stepped.outcome.angle
    min_margin = jnp.minimum(state.min_margin, margin)
    after = VectorState(
        maneuver=stepped.state,
        key=state.key,
        episode=state.episode + over,
        min_margin=jnp.where(over, jax.vmap(env.margin)(stepped.state), min_margin),
    )
    return after, VectorStep(
        observation=stepped.observation,
        final_observation=stepped.final_observation,
        reward=reward.total(stepped.terms, reward.PAPER_WEIGHTS),
        terminated=stepped.terminated,
        truncated=over,
        zone_margin=margin,
        pointing_error=reward.pointing_error(angle, env.reward),
        settled=reward.is_settled(angle, env.reward),
        violated=~(min_margin > 0.0),
    )


class NumpyVectorEnv:
    """Environments behind NumPy arrays; what the adapters outside jax share."""

    def __init__(
        self,
        num_envs: int,
        task: TaskConfig | None = None,
        min_angle_deg: float = 80.0,
        max_angle_deg: float = 180.0,
    ) -> None:
        """Set up; ``reset`` before the first step."""
        if not isinstance(num_envs, int | np.integer) or not 1 <= num_envs <= MAX_ENVS:
            raise SettingsError(f"num_envs: must be a whole number from 1 to {MAX_ENVS}, got {num_envs!r}")
        self.task = task or TaskConfig()
        check_deviations(min_angle_deg, max_angle_deg)
        check_feasible(self.task, max_angle_deg)
        self.num_envs = num_envs
        self._angles_deg = (min_angle_deg, max_angle_deg)
        self._state: VectorState | None = None

    @functools.cached_property
    def _env(self) -> Reorientation:
        """The core; made at the first reset, so that an environment that is only asked for its spaces starts no jax."""
        return Reorientation.from_config(self.task, *self._angles_deg)

    @property
    def begun(self) -> bool:
        """Whether there was a first reset."""
        return self._state is not None

    def maneuver(self, number: int) -> EnvState:
        """State in one environment, on the host."""
        if self._state is None:
            raise SettingsError("reset: must come first, got none so far")
        return jax.tree.map(lambda leaf: np.asarray(leaf[number]), self._state.maneuver)

    def reset(
        self, seeds: Sequence[int] | None = None, given: Sequence[Scenario | None] | None = None
    ) -> npt.NDArray[np.float32]:
        """Begin the first episode of every seed, or with None the next one of the seeds that are set.

        Args:
            seeds: one per environment, from 0 to 2^32 - 1 (see ``seeds_from``).
            given: one per environment, see ``scenario_of``: flown in this episode in place of the drawn one.

        Returns:
            Observations (n, entries).

        """
        refuse_in_fork()
        if seeds is not None:
            key, episode = _keys(seeds, self.num_envs), jnp.zeros(self.num_envs, jnp.int32)
        elif self._state is not None:
            key, episode = self._state.key, self._state.episode + 1
        else:
            raise SettingsError("seeds: must be given at the first reset, got None")
        if given is None or all(one is None for one in given):
            self._state, observed = reset(self._env, key, episode)
        else:
            drawn = jax.tree.map(np.array, _draw(self._env, key, episode))
            for number, one in enumerate(given):
                if one is not None:
                    jax.tree.map(lambda rows, row, i=number: rows.__setitem__(i, row), drawn, one)
            self._state, observed = begin(self._env, drawn, key, episode)
        return np.array(observed)

    def scenario_of(self, options: Mapping[str, Any] | None) -> Scenario | None:
        """Take the scenario out of the options of a reset; None where there are none.

        options: ``{"scenario": a Scenario}``, or the arguments of ``koz_jax.maneuver``, whose boresight is by default
        that of the task.

        Raises:
            SettingsError: an option is unknown or is refused, there are more zones than the task has, or the rate is
                outside of the observation's bounds.

        """
        if not options:
            return None
        refuse_in_fork()
        if "scenario" in options and len(options) == 1:
            asked = maneuver.checked(options["scenario"])
        elif "start" in options and options.keys() <= MANEUVER_OPTIONS:
            asked = maneuver.maneuver(**{"boresight": self.task.spacecraft.boresight, **options})
        else:
            raise SettingsError(
                f"options: must be 'scenario' alone, or 'start' and any of {sorted(MANEUVER_OPTIONS - {'start'})}, got"
                f" {sorted(options)}"
            )
        fastest = observation_bounds(self.task)[1][SLICES["omega_BN_B"]].min()
        if np.abs(asked.initial.omega_BN_B).max() > fastest:
            raise SettingsError(
                f"rate_deg: must be at most {np.rad2deg(fastest):.6g} deg/s about each axis, the observation's bound"
                f" for this task, got {np.rad2deg(asked.initial.omega_BN_B).tolist()}"
            )
        return _filled_up(asked, self.task.zones[1])

    def step(self, actions: npt.ArrayLike) -> VectorStep:
        """Step every environment.  actions: (n, 3) in [-1, 1] (clipped).  Returns NumPy leaves (n, ...)."""
        if self._state is None:
            raise SettingsError("step: must come after a reset, got none so far")
        refuse_in_fork()
        given = as_numbers("actions", actions)
        if given.shape != (self.num_envs, ACTION_SIZE):
            raise SettingsError(f"actions: must have shape {(self.num_envs, ACTION_SIZE)}, got {given.shape}")
        self._state, stepped = step(self._env, self._state, given)
        # Copies, because what jax lends is read-only.
        return jax.tree.map(np.array, stepped)


def _filled_up(asked: Scenario, zones: int) -> Scenario:
    """A scenario with as many zones as a stack of the task has, absent ones among them."""
    stack = asked.constraints
    present = np.flatnonzero(np.asarray(stack.half_angle) > 0.0)
    if len(present) > zones:
        raise SettingsError(f"zones: must be at most {zones} (max_zones of the task's scenarios), got {len(present)}")
    if stack.axis_rate_N is not None:
        raise SettingsError("zones: must have fixed axes, got some that turn")
    stack = jax.tree.map(lambda leaf: np.asarray(leaf)[present] if len(present) else np.asarray(leaf)[:1], stack)
    return asked.replace(constraints=pointing_constraints.filled_up(stack, zones))


def _keys(seeds: Sequence[int], num_envs: int) -> jax.Array:
    """Typed keys (n,) of the environments."""
    if len(seeds) != num_envs:
        raise SettingsError(f"seeds: must be one for each of {num_envs} environments, got {len(seeds)}")
    checked = [_checked_seed(seed) for seed in seeds]
    return jax.vmap(jax.random.key)(np.array(checked, np.uint32))


def seeds_from(first: SupportsIndex, num_envs: int) -> range:
    """Seeds of environments that follow one another.

    Raises:
        SettingsError: they do not all lie from 0 to 2^32 - 1.

    """
    start = _checked_seed(first)
    if start + num_envs > 2**32:
        raise SettingsError(f"seed: must be from 0 to 2^32 - {num_envs} for {num_envs} environments, got {first}")
    return range(start, start + num_envs)


def _checked_seed(seed: SupportsIndex) -> int:
    try:
        number = operator.index(seed)
    except TypeError:
        number = -1
    if not 0 <= number < 2**32:
        raise SettingsError(f"seed: must be a whole number from 0 to 2^32 - 1, got {seed!r}")
    return number
