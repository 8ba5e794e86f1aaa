"""Pictures of a maneuver under way."""

import sys
import types
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo
from test_adapters import TASK

import koz_jax
from koz_jax.adapters.drawing import SphereDrawing
from koz_jax.adapters.gym_env import ENV_ID, ReorientationEnv, ReorientationVectorEnv
from koz_jax.config.task import TaskConfig
from koz_jax.errors import SettingsError

ZONE = ((0.5, 0.866, 0.0), 20.0)
START = (0.5, 0.0, 0.0, np.sqrt(0.75))
STILL = np.zeros(3, np.float32)


def is_red(picture: np.ndarray) -> np.ndarray:
    return picture[..., 0].astype(int) - picture[..., 2] > 30


def is_black(picture: np.ndarray) -> np.ndarray:
    return picture.max(axis=-1) < 60


def turned(degrees: float) -> np.ndarray:
    half = np.deg2rad(degrees) / 2
    return np.array([np.cos(half), 0.0, 0.0, np.sin(half)])


def test_zones_have_their_size_on_the_sphere():
    """The zone is in the middle of the view: a disc whose radius is the sine of its half angle."""
    picture = SphereDrawing(koz_jax.maneuver(START, zones=[ZONE])).picture()
    radius = 0.92 * 240
    np.testing.assert_allclose(is_red(picture).sum(), np.pi * (radius * np.sin(np.deg2rad(20.0))) ** 2, rtol=0.03)
    rows, columns = np.nonzero(is_red(picture))
    np.testing.assert_allclose((rows.mean(), columns.mean()), (239.5, 239.5), atol=1.0)
    without = SphereDrawing(koz_jax.maneuver(START)).picture()
    assert not is_red(without).any()


def test_the_trace_grows_where_the_telescope_looks():
    """From 120 deg straight to the target about z, across the zone: half-way it is in the middle of the picture."""
    drawing = SphereDrawing(koz_jax.maneuver(START, zones=[ZONE]))
    before = is_black(drawing.picture())
    assert not before[239, 239]
    drawing.add(turned(60.0))
    half_way = is_black(drawing.picture())
    assert half_way[237:243, 237:243].all() and half_way.sum() > before.sum() + 300
    drawing.add_error(turned(0.0).astype(np.float32))
    assert is_black(drawing.picture()).sum() > half_way.sum() + 300


@pytest.mark.slow
def test_an_environment_draws_what_it_flies():
    env = gymnasium.make(ENV_ID, task=TaskConfig(episode_seconds=6.0), render_mode="rgb_array")
    env.reset(options={"start": START, "zones": [ZONE], "rate_deg": (0.0, 0.0, -20.0)})
    first: Any = env.render()
    assert first.shape == (480, 480, 3) and first.dtype == np.uint8
    for _ in range(20):
        env.step(STILL)
    last: Any = env.render()
    # 40 deg of a great circle, seen from its middle and drawn 3 pixels wide.
    assert is_black(last).sum() > is_black(first).sum() + 200
    assert is_red(last).sum() < is_red(first).sum() + 10
    env.reset()
    assert is_black(np.asarray(env.render())).sum() < is_black(last).sum()


def test_without_a_mode_nothing_is_drawn():
    env = ReorientationEnv(TASK)
    env.reset(seed=0)
    assert env.render() is None and env.render_mode is None
    with pytest.raises(SettingsError, match="render: must come after a reset"):
        ReorientationEnv(TASK, render_mode="rgb_array").render()


@pytest.mark.parametrize("mode", ["human", "ansi"])
def test_another_mode_is_refused_by_name(mode):
    with pytest.raises(SettingsError, match=f"render_mode: must be None or 'rgb_array', got '{mode}'"):
        ReorientationEnv(TASK, render_mode=mode)
    with pytest.raises(SettingsError, match=f"render_mode: must be None here; .*, got '{mode}'"):
        ReorientationVectorEnv(2, TASK, render_mode=mode)


@pytest.mark.slow
def test_a_film_is_recorded_in_the_time_of_the_maneuver(tmp_path, monkeypatch):
    """RecordVideo asks MoviePy for a film; here of what it is given."""
    films: list[tuple[int, list[np.ndarray]]] = []

    class ImageSequenceClip:
        def __init__(self, frames: list[np.ndarray], fps: int) -> None:
            films.append((fps, frames))

        def write_videofile(self, path: str, logger: Any) -> None:
            assert path.startswith(str(tmp_path))

    for name in ("moviepy", "moviepy.video", "moviepy.video.io", "moviepy.video.io.ImageSequenceClip"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setattr(
        sys.modules["moviepy.video.io.ImageSequenceClip"], "ImageSequenceClip", ImageSequenceClip, raising=False
    )
    task = TaskConfig(episode_seconds=2.0, step_seconds=0.2)
    env = RecordVideo(gymnasium.make(ENV_ID, task=task, render_mode="rgb_array"), str(tmp_path))
    env.reset(seed=0)
    while not env.step(STILL)[3]:
        pass
    env.close()
    fps, frames = films[0]
    assert fps == 5 and len(frames) == 11
    assert all(frame.shape == (480, 480, 3) for frame in frames)
