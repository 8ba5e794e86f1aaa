"""A maneuver of one's own in every adapter: flown where it is asked for, and refused by name where it is none."""

from typing import Any

import numpy as np
import pytest
from test_adapters import TASK

import koz_jax
from koz_jax.adapters.gym_env import ReorientationEnv, ReorientationVectorEnv
from koz_jax.adapters.sb3_env import ReorientationVecEnv
from koz_jax.config.task import ScenarioConfig, SpacecraftConfig, TaskConfig
from koz_jax.errors import SettingsError
from koz_jax.task import observation, state
from koz_jax.task.environment import model_from_config
from koz_jax.task.observation_layout import SLICES, layout

START = (0.5, 0.0, 0.0, np.sqrt(0.75))
OWN = {"start": START, "zones": [((0.5, 0.866, 0.0), 20.0)], "rate_deg": (0.1, 0.0, -0.1)}
STILL = np.zeros(3, np.float32)


def expected(task: TaskConfig = TASK, observed: int = 1, **maneuver: Any) -> np.ndarray:
    drawn = koz_jax.maneuver(**{"boresight": task.spacecraft.boresight, **OWN, **maneuver})
    return np.asarray(observation.observe(state.begin(drawn, model_from_config(task)), observed))


def sb3(options: Any, seed: int | None = None) -> tuple[ReorientationVecEnv, np.ndarray]:
    env = ReorientationVecEnv(3, TASK)
    env.seed(seed)
    env.set_options(options)
    return env, env.reset()


@pytest.mark.slow
@pytest.mark.parametrize("options", [OWN, {"scenario": koz_jax.maneuver(**OWN)}])
def test_it_begins_where_it_is_told(options):
    single, many = ReorientationEnv(TASK), ReorientationVectorEnv(3, TASK)
    np.testing.assert_allclose(single.reset(options=options)[0], expected(), atol=1e-6)
    np.testing.assert_allclose(many.reset(options=options, seed=3)[0], np.tile(expected(), (3, 1)), atol=1e-6)
    np.testing.assert_allclose(sb3(options)[1], np.tile(expected(), (3, 1)), atol=1e-6)


@pytest.mark.slow
def test_it_is_flown_as_the_monte_carlo_flies_it():
    """Without torque, to the end of the episode."""
    env = ReorientationEnv(TASK)
    env.reset(options=OWN)
    steps = [env.step(STILL) for _ in range(TASK.episode_steps)]
    assert steps[-1][3] and not any(step[3] for step in steps[:-1])
    idle = koz_jax.load_controller("pd")
    drawn = koz_jax.maneuver(**OWN)
    history, _ = koz_jax.fly_scenario(idle, drawn, TASK)
    np.testing.assert_allclose(history.zone_margin[0], expected()[SLICES["zone_margin"]][0], atol=1e-6)
    # At 0.14 deg/s the attitude turns by 0.28 deg in the two seconds.
    turned = np.linalg.norm(steps[-1][0][:4] - expected()[:4])
    np.testing.assert_allclose(2 * np.rad2deg(turned), 2.0 * 0.1 * np.sqrt(2.0), rtol=0.05)


@pytest.mark.slow
def test_the_next_episode_is_drawn_again():
    env, plain = ReorientationEnv(TASK), ReorientationEnv(TASK)
    env.reset(seed=4, options=OWN)
    plain.reset(seed=4)
    np.testing.assert_array_equal(env.reset()[0], plain.reset()[0])
    many, single = ReorientationVectorEnv(3, TASK), ReorientationEnv(TASK)
    many.reset(seed=4, options=OWN)
    for _ in range(TASK.episode_steps):
        observed, _, _, over, _ = many.step(np.zeros((3, 3), np.float32))
    assert over.all()
    single.reset(seed=4)
    np.testing.assert_allclose(observed[0], single.reset()[0], rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_a_given_maneuver_after_the_end_of_an_episode_is_flown():
    env = ReorientationEnv(TASK)
    env.reset(seed=4)
    while not env.step(STILL)[3]:
        pass
    np.testing.assert_allclose(env.reset(options=OWN)[0], expected(), atol=1e-6)


@pytest.mark.slow
def test_environments_without_options_fly_what_is_drawn():
    _, observed = sb3([OWN, {}, {}], seed=7)
    _, plain = sb3(None, seed=7)
    np.testing.assert_allclose(observed[0], expected(), atol=1e-6)
    np.testing.assert_allclose(observed[1:], plain[1:], atol=1e-6)
    env, _ = sb3(OWN, seed=7)
    after = env.reset()
    assert np.abs(after - expected()).max(axis=1).min() > 1e-2, "options are of one reset only"


@pytest.mark.slow
def test_fewer_zones_than_the_task_has_are_filled_up_and_the_boresight_is_its_own():
    task = TaskConfig(
        episode_seconds=2.0,
        spacecraft=SpacecraftConfig(boresight=(0.0, 0.0, 1.0)),
        scenario=ScenarioConfig(max_zones=3),
    )
    env = ReorientationEnv(task)
    observed, _ = env.reset(options=OWN)
    np.testing.assert_allclose(observed, expected(task, 3), atol=1e-6)
    assert len(observed) == sum(layout(3).values())
    without, _ = env.reset(options={"start": START})
    assert without[SLICES["zone_margin"]][0] > np.pi
    env.step(STILL)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"scenarios": 3}, r"options: must be 'scenario' alone, or 'start' and any of .*, got \['scenarios'\]"),
        ({"start": START, "zone": []}, r"options: must be .*, got \['start', 'zone'\]"),
        ({"target": START}, r"options: must be .*, got \['target'\]"),
        ({"scenario": koz_jax.maneuver(**OWN), "start": START}, r"options: must be 'scenario' alone"),
        ({"scenario": 3}, "scenario: must be a Scenario"),
        ({"start": (2.0, 0.0, 0.0, 0.0)}, "start: must have length 1"),
        ({"start": START, "zones": [((8, 6, 1), 30)]}, r"zones\[0\], axis: must have length 1"),
        ({"start": START, "zones": [((0, 0, 1), 20), ((0, 1, 0), 20)]}, "zones: must be at most 1 .*, got 2"),
        ({"start": START, "rate_deg": (0, 0, 20)}, r"rate_deg: must be at most 8\.\d+ deg/s about each axis"),
    ],
)
def test_what_is_no_option_is_refused_by_name(options, reason):
    for refused in (
        lambda: ReorientationEnv(TASK).reset(options=options),
        lambda: ReorientationVectorEnv(3, TASK).reset(options=options),
        lambda: sb3(options),
    ):
        with pytest.raises(SettingsError, match=reason):
            refused()
