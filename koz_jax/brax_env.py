"""The environment behind brax's ``Env`` contract.

The core (``env``, ``observation``, ``reward``) does not need brax; this adapter is for code that speaks its contract.
"""

import contextlib
import io

import jax
import jax.numpy as jnp

from koz_jax import env, observation, reward, scenario, task
from koz_jax.agent import ACTION_SIZE
from koz_jax.env import EnvState
from koz_jax.task_config import TaskConfig

# brax prints to stdout, while it is imported, which optional engines it could not find.
with contextlib.redirect_stdout(io.StringIO()):
    from brax.envs.base import Env, State


class ReorientationEnv(Env):
    """One maneuver at a time: a fresh random scenario at every reset, the paper's reward at every step.

    ``State.pipeline_state`` is the core's ``EnvState``.  A maneuver is cut after ``task.episode_steps`` steps:
    ``done`` is then 1 and ``info["truncation"]`` is 1, because a cut is no termination.
    """

    def __init__(
        self, task_config: TaskConfig | None = None, min_angle_deg: float = 80.0, max_angle_deg: float = 180.0
    ) -> None:
        """Deviations are uniform between the two angles [deg]."""
        self._task = task_config or TaskConfig()
        self._params = task.env_params(self._task)
        self._ranges = task.scenario_ranges(self._task.scenario, min_angle_deg, max_angle_deg)

    def reset(self, rng: jax.Array) -> State:
        """Draw a scenario.  rng: () typed key, or (2,) uint32 as brax's own trainers pass it."""
        key = rng if jnp.issubdtype(rng.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(rng)
        drawn = scenario.sample(
            key, self._ranges, self._params.spacecraft.boresight_B, self._task.scenario.infeasible_zone
        )
        zero = jnp.zeros(())
        state = env.reset(drawn)
        return State(
            pipeline_state=state,  # pyright: ignore[reportArgumentType]
            obs=observation.observe(state, self._params),
            reward=zero,
            done=zero,
            metrics={"zone_margin": zero, "pointing_error": zero},
            info={"truncation": zero},
        )

    def step(self, state: State, action: jax.Array) -> State:
        """Apply an action (3,) in [-1, 1]."""
        before: EnvState = state.pipeline_state  # pyright: ignore[reportAssignmentType]
        after, outcome = env.step(before, action, self._params)
        terms = reward.terms(outcome, self._params.reward, self._params.spacecraft.torque_limit)
        cut = (after.steps >= self._task.episode_steps).astype(jnp.float32)
        return state.replace(  # pyright: ignore[reportAttributeAccessIssue]
            pipeline_state=after,
            obs=observation.observe(after, self._params),
            reward=reward.total(terms, reward.PAPER_WEIGHTS),
            done=cut,
            metrics={
                **state.metrics,
                "zone_margin": outcome.zone_margin,
                "pointing_error": reward.pointing_error(after.angle, self._params.reward),
            },
            info={**state.info, "truncation": cut},
        )

    @property
    def observation_size(self) -> int:
        """Entries of the observation."""
        return observation.SIZE

    @property
    def action_size(self) -> int:
        """Entries of the action."""
        return ACTION_SIZE

    @property
    def backend(self) -> str:
        """The physics is the package's own."""
        return "koz_jax"
