"""The environment as a ``VecEnv``, on which Stable-Baselines3 and SBX train with thousands of jitted environments.

    from stable_baselines3 import SAC
    from koz_jax.adapters.sb3_env import ReorientationVecEnv

    SAC("MlpPolicy", ReorientationVecEnv(64), gradient_steps=8).learn(100_000)

Environment i seeded with ``seed`` flies the same scenarios as every other adapter's environment with ``seed + i``.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from koz_jax.adapters.vector_env import NumpyVectorEnv, VectorStep, seeds_from
from koz_jax.config.task import TaskConfig
from koz_jax.errors import SettingsError, missing_extra

try:
    from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices
except ModuleNotFoundError as error:
    raise missing_extra(error, "stable_baselines3", "sb3") from None

from koz_jax.adapters.gym_env import single_spaces


class ReorientationVecEnv(VecEnv):
    """Many maneuvers in step.

    Where an episode is over, the observation returned is the first of the next one, and the info holds
    ``terminal_observation``, ``TimeLimit.truncated`` (always true: a maneuver ends by time alone) and ``is_success``
    (settled, and no zone entered).  What a step measured in all environments is in ``last_step``, as arrays.
    """

    last_step: VectorStep

    def __init__(
        self,
        num_envs: int,
        task: TaskConfig | None = None,
        min_angle_deg: float = 80.0,
        max_angle_deg: float = 180.0,
    ) -> None:
        """Deviations are uniform between the two angles [deg]."""
        task = task or TaskConfig()
        self._envs = NumpyVectorEnv(num_envs, task, min_angle_deg, max_angle_deg)
        super().__init__(num_envs, *single_spaces(task))

    def reset(self) -> npt.NDArray[np.float32]:
        """Begin new random scenarios: the first of the seeds where ``seed`` was called, else the next ones.

        Options that ``set_options`` has set for an environment, as those of ``gym_env.ReorientationEnv.reset``, give
        the scenario of its next episode instead.
        """
        given = [self._envs.scenario_of(options) for options in self._options]
        if not self._envs.begun and self._seeds[0] is None:
            self.seed()
        seeds = [seed for seed in self._seeds if seed is not None]
        observed = self._envs.reset(seeds or None, given)
        self._reset_seeds()
        self._reset_options()
        return observed

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seeds of the next reset: environment i gets ``seed + i``; None draws one.  Returns them."""
        if seed is None:
            # From the generator that set_random_seed of Stable-Baselines3 seeds.
            seed = int(np.random.randint(2**32 - self.num_envs + 1, dtype=np.int64))
        return super().seed(seeds_from(seed, self.num_envs)[0])

    def step_async(self, actions: npt.NDArray[np.float32]) -> None:
        """Step every environment.  actions: (num_envs, 3) in [-1, 1] (clipped)."""
        self.last_step = self._envs.step(actions)

    def step_wait(
        self,
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Observations, rewards, whether episodes are over, and infos of the step."""
        stepped: Any = self.last_step
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        success = stepped.settled & ~stepped.violated
        for i in np.flatnonzero(stepped.truncated):
            infos[i] = {
                "terminal_observation": stepped.final_observation[i],
                "TimeLimit.truncated": True,
                "is_success": bool(success[i]),
            }
        return stepped.observation, stepped.reward, stepped.truncated, infos

    def close(self) -> None:
        """Nothing is held."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute, which all environments share."""
        value = None if attr_name == "render_mode" else getattr(self, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refuse: the environments have no attributes of their own."""
        raise SettingsError(f"set_attr: the environments have no attributes of their own, got {attr_name}")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Refuse: the environments have no methods of their own."""
        raise SettingsError(f"env_method: the environments have no methods of their own, got {method_name}")

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """No environment has a wrapper of its own."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[npt.NDArray[np.uint8] | None]:
        """There are none."""
        return [None] * self.num_envs
