"""The environment behind Gymnasium's contracts, jitted inside and NumPy outside.

Importing this module registers it::

    import gymnasium, koz_jax.adapters.gym_env

    env = gymnasium.make("koz_jax/Reorientation-v0")
    envs = gymnasium.make_vec("koz_jax/Reorientation-v0", num_envs=1024)

or, without the import, ``gymnasium.make("koz_jax.adapters.gym_env:koz_jax/Reorientation-v0")``.  The vector environment
needs no processes.  Those of ``vectorization_mode="async"`` must be spawned (``vector_kwargs={"context": "spawn"}``) or
forked before jax has computed anything, because it does not live through a fork; others are refused at the first reset.

Both take ``task``, ``min_angle_deg`` and ``max_angle_deg`` (initial deviations are uniform between the two).
A maneuver ends by ``truncated`` alone.  Environment i of a vector environment reset with ``seed`` flies the same
scenarios as the single environment reset with ``seed + i``; every reset without a seed goes on to new ones.

A maneuver of one's own: ``env.reset(options={"start": ..., "target": ..., "zones": ...})`` with the arguments of
``koz_jax.maneuver``, or ``{"scenario": a Scenario}``.  It is flown in this episode, by all environments of a vector
environment; the next reset draws again.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from koz_jax.adapters.drawing import Picture, SphereDrawing
from koz_jax.adapters.vector_env import NumpyVectorEnv, VectorStep, seeds_from
from koz_jax.config.task import TaskConfig
from koz_jax.errors import SettingsError, missing_extra
from koz_jax.task.observation_layout import ACTION_SIZE, SLICES, observation_bounds

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise missing_extra(error, "gymnasium", "gym") from None

ENV_ID = "koz_jax/Reorientation-v0"

Floats = npt.NDArray[np.float32]
Bools = npt.NDArray[np.bool_]


def single_spaces(task: TaskConfig) -> tuple[Any, Any]:
    """Boxes of the observation and of the action of one environment."""
    low, high = observation_bounds(task)
    return spaces.Box(low, high), spaces.Box(-1.0, 1.0, (ACTION_SIZE,))


def _info(stepped: VectorStep) -> dict[str, npt.NDArray[Any]]:
    """What a step tells besides observation and reward (see ``VectorStep``)."""
    names = ("zone_margin", "pointing_error", "settled", "violated")
    return {name: getattr(stepped, name) for name in names}


def _info_where(stepped: VectorStep, mask: Bools) -> dict[str, npt.NDArray[Any]]:
    """The same of some environments, each entry with its mask beside it, as Gymnasium's vector environments do."""
    info: dict[str, npt.NDArray[Any]] = {}
    if mask.any():
        for name, values in _info(stepped).items():
            info |= {name: np.where(mask, values, np.zeros_like(values)), f"_{name}": mask.copy()}
    return info


class ReorientationEnv(gymnasium.Env[Floats, Floats]):
    """One maneuver at a time.

    With ``render_mode="rgb_array"``, ``render()`` gives a picture (480, 480, 3) of it on the sphere, see ``drawing``.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012  declared by the base

    def __init__(
        self,
        task: TaskConfig | None = None,
        min_angle_deg: float = 80.0,
        max_angle_deg: float = 180.0,
        render_mode: str | None = None,
    ) -> None:
        """Deviations are uniform between the two angles [deg]."""
        if render_mode not in (None, "rgb_array"):
            raise SettingsError(f"render_mode: must be None or 'rgb_array', got {render_mode!r}")
        task = task or TaskConfig()
        self.render_mode = render_mode
        # A film in the time of the maneuver.
        self.metadata = {**self.metadata, "render_fps": max(1, round(1.0 / task.step_seconds))}
        self._drawing: SphereDrawing | None = None
        self._envs = NumpyVectorEnv(1, task, min_angle_deg, max_angle_deg)
        self._next: Floats | None = None  # first observation of the episode to come, when one is over
        self.observation_space, self.action_space = single_spaces(task)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Begin a new random scenario: the first of the seed, or without a seed the next one; or that of the options.

        options: ``{"scenario": a Scenario}``, or arguments of ``koz_jax.maneuver``, whose boresight is by default that
        of the task.
        """
        given = self._envs.scenario_of(options)
        seeds = None if seed is None else seeds_from(seed, 1)
        super().reset(seed=None if seeds is None else seeds[0])
        if seeds is None and not self._envs.begun:
            seeds = [int(self.np_random.integers(2**32))]
        if seeds is None and given is None and self._next is not None:
            observed = self._next
        else:
            observed = self._envs.reset(seeds, [given])[0]
        self._next = None
        if self.render_mode is not None:
            self._drawing = SphereDrawing(self._envs.maneuver(0).scenario)
        return observed, {}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Apply an action (3,) in [-1, 1] (clipped)."""
        if self._next is not None:
            raise SettingsError("step: must come after a reset, got one after the end of the episode")
        stepped = self._envs.step([action])
        if stepped.truncated[0]:
            self._next = np.asarray(stepped.observation)[0]
        info = {name: values[0].item() for name, values in _info(stepped).items()}
        led_to = np.asarray(stepped.final_observation)[0]
        if self._drawing is not None:
            self._drawing.add_error(led_to[SLICES["q_e"]])
        return (
            led_to,
            float(stepped.reward[0]),
            bool(stepped.terminated[0]),
            bool(stepped.truncated[0]),
            info,
        )

    def render(self) -> Picture | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Picture (480, 480, 3) uint8 of the maneuver so far, with ``render_mode="rgb_array"``; else None."""
        if self.render_mode is None:
            return None
        if self._drawing is None:
            raise SettingsError("render: must come after a reset, got none so far")
        return self._drawing.picture()


class ReorientationVectorEnv(VectorEnv[Floats, Floats, npt.NDArray[Any]]):
    """Many maneuvers in step, with autoreset in the same step.

    Where an episode is over, the observation returned is the first of the next one, and ``info["final_obs"]`` (an array
    of objects, with the mask ``info["_final_obs"]``) holds the one that the step led to, ``info["final_info"]`` the
    info.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        task: TaskConfig | None = None,
        min_angle_deg: float = 80.0,
        max_angle_deg: float = 180.0,
        render_mode: str | None = None,
    ) -> None:
        """Deviations are uniform between the two angles [deg]."""
        if render_mode is not None:
            raise SettingsError(f"render_mode: must be None here; a single environment can draw, got {render_mode!r}")
        task = task or TaskConfig()
        self._envs = NumpyVectorEnv(num_envs, task, min_angle_deg, max_angle_deg)
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = single_spaces(task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin new random scenarios in all environments.

        seed: environment i gets ``seed + i``, or the i-th of a sequence, where None is drawn; without one all go on to
        their next scenario.  options: those of ``ReorientationEnv.reset``; all environments fly that scenario.
        """
        given = [self._envs.scenario_of(options)] * self.num_envs
        super().reset()
        if seed is None and not self._envs.begun:
            seed = [None] * self.num_envs
        if seed is None:
            return self._envs.reset(None, given), {}
        if not isinstance(seed, Sequence | np.ndarray):
            seeds = seeds_from(seed, self.num_envs)
            super().reset(seed=seeds[0])
            return self._envs.reset(seeds, given), {}
        drawn = self.np_random.integers(2**32, size=len(seed)).tolist()
        seeds = [new if one is None else one for one, new in zip(seed, drawn, strict=True)]
        return self._envs.reset(seeds, given), {}

    def step(self, actions: Floats) -> tuple[Floats, npt.NDArray[np.float64], Bools, Bools, dict[str, Any]]:
        """Apply actions (num_envs, 3) in [-1, 1] (clipped)."""
        stepped = self._envs.step(actions)
        over = np.asarray(stepped.truncated)
        info: dict[str, Any] = _info_where(stepped, ~over)
        if over.any():
            final_obs = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(over):
                final_obs[i] = np.asarray(stepped.final_observation)[i]
            info |= {"final_obs": final_obs, "_final_obs": over.copy()}
            info |= {"final_info": _info_where(stepped, over), "_final_info": over.copy()}
        return stepped.observation, stepped.reward, stepped.terminated, over, info  # pyright: ignore[reportReturnType]


gymnasium.register(
    ENV_ID,
    entry_point=f"{__name__}:{ReorientationEnv.__name__}",
    vector_entry_point=f"{__name__}:{ReorientationVectorEnv.__name__}",
)
