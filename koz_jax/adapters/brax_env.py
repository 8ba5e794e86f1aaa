"""The environment behind brax's ``Env`` contract, registered as ``koz_jax_reorientation``.

The core (``task.environment``) does not need brax; this adapter is for code that speaks its contract.
Give brax's trainers ``wrap_env_fn=wrap_for_training``: their own wrapper replays every environment's first scenario.
So does ``brax.envs.create``; instead: ``wrap_for_training(env := get_environment(ENV_NAME), env.episode_steps)``.
"""

import contextlib
import io
from typing import Any

import jax
import jax.numpy as jnp

from koz_jax.adapters.forks import refuse_in_fork
from koz_jax.adapters.vector_env import episode_keys
from koz_jax.config.task import TaskConfig
from koz_jax.errors import SettingsError
from koz_jax.task import observation_layout, reward
from koz_jax.task.environment import Reorientation
from koz_jax.task.observation_layout import ACTION_SIZE
from koz_jax.task.state import EnvState

# brax prints to stdout, while it is imported, which optional engines it could not find.
with contextlib.redirect_stdout(io.StringIO()):
    from brax import envs
    from brax.envs.base import Env, State, Wrapper
    from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper

ENV_NAME = "koz_jax_reorientation"


class ReorientationEnv(Env):
    """One maneuver at a time: a fresh random scenario at every reset, the paper's reward at every step.

    ``State.pipeline_state`` is the core's ``EnvState``.  ``done`` stays 0: nothing but time ends a maneuver, and
    in brax that is a wrapper's business.
    """

    def __init__(
        self, task: TaskConfig | None = None, min_angle_deg: float = 80.0, max_angle_deg: float = 180.0
    ) -> None:
        """Deviations are uniform between the two angles [deg]."""
        refuse_in_fork()
        self.reorientation = Reorientation.from_config(task, min_angle_deg, max_angle_deg)

    @property
    def episode_steps(self) -> int:
        """Steps of a maneuver, the ``episode_length`` of brax's trainers."""
        return self.reorientation.episode_steps

    def reset(self, rng: jax.Array) -> State:
        """Draw a scenario.  rng: () typed key, or (2,) uint32 as brax's own trainers pass it."""
        zero = jnp.zeros(())
        state = self.reorientation.reset(_typed(rng))
        return State(
            pipeline_state=state,  # pyright: ignore[reportArgumentType]
            obs=self.reorientation.observe(state),
            reward=zero,
            done=zero,
            metrics={"zone_margin": zero, "pointing_error": zero},
        )

    def step(self, state: State, action: jax.Array) -> State:
        """Apply an action (3,) in [-1, 1]."""
        before: EnvState = state.pipeline_state  # pyright: ignore[reportAssignmentType]
        stepped = self.reorientation.step(before, action)
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=stepped.state,
            obs=stepped.observation,
            reward=reward.total(stepped.terms, reward.PAPER_WEIGHTS),
            metrics={
                **state.metrics,
                "zone_margin": stepped.outcome.zone_margin,
                "pointing_error": reward.pointing_error(stepped.outcome.angle, self.reorientation.reward),
            },
        )

    @property
    def observation_size(self) -> int:
        """Entries of the observation."""
        return observation_layout.size(self.reorientation.observed_zones)

    @property
    def action_size(self) -> int:
        """Entries of the action."""
        return ACTION_SIZE

    @property
    def backend(self) -> str:
        """The physics is the package's own."""
        return "koz_jax"


class ResampleWrapper(Wrapper):
    """Over an environment with many episodes in step: where one is over, a new random scenario begins.

    ``info["final_observation"]`` is what the step led to, also where ``obs`` is already the next episode's first.
    Episode k of the environment with key r flies the scenario of ``fold_in(r, k)``.
    """

    def reset(self, rng: jax.Array) -> State:
        """Begin.  rng: (n,) typed keys, or (n, 2) uint32."""
        keys = _typed(rng)
        episode = jnp.zeros(keys.shape, jnp.int32)
        state = self.env.reset(jax.random.key_data(episode_keys(keys, episode)))
        kept = {"key": jax.random.key_data(keys), "episode": episode, "final_observation": state.obs}
        return state.replace(info={**state.info, **kept})  # pyright: ignore[reportAttributeAccessIssue]

    def step(self, state: State, action: jax.Array) -> State:
        """Apply actions (n, 3)."""
        begun: Any = state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            done=jnp.zeros_like(state.done),
            info={**state.info, "steps": jnp.where(state.done > 0, 0.0, state.info["steps"])},
        )
        after: Any = self.env.step(begun, action)
        over = after.done > 0
        episode = after.info["episode"] + over

        bare: Any = self.unwrapped
        pipeline_state, obs = bare.reorientation.autoreset(
            over, after.pipeline_state, after.obs, lambda: episode_keys(_typed(after.info["key"]), episode)
        )
        info = {**after.info, "episode": episode, "final_observation": after.obs}
        return after.replace(pipeline_state=pipeline_state, obs=obs, info=info)


def wrap_for_training(
    env: Env, episode_length: int = 1000, action_repeat: int = 1, randomization_fn: Any = None
) -> Wrapper:
    """Batch, cut into episodes and resample; for the argument ``wrap_env_fn`` of brax's trainers."""
    if randomization_fn is not None:
        raise SettingsError(
            f"randomization_fn: this environment has no brax System to randomise, got {randomization_fn}"
        )
    for name, value in {"episode_length": episode_length, "action_repeat": action_repeat}.items():
        if value < 1:
            raise SettingsError(f"{name}: must be 1 or more, got {value}")
    return ResampleWrapper(EpisodeWrapper(VmapWrapper(env), episode_length, action_repeat))


def _typed(rng: jax.Array) -> jax.Array:
    return rng if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(rng)


envs.register_environment(ENV_NAME, ReorientationEnv)
