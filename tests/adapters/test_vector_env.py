import jax
import jax.numpy as jnp
import numpy as np
import pytest

from koz_jax.adapters import vector_env
from koz_jax.adapters.vector_env import NumpyVectorEnv, VectorState, seeds_from
from koz_jax.config.task import ScenarioConfig, SpacecraftConfig, TaskConfig
from koz_jax.control.base import Memoryless
from koz_jax.errors import SettingsError
from koz_jax.evaluation import rollout
from koz_jax.task import observation_layout
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.environment import Reorientation

SHORT = TaskConfig(episode_seconds=2.0)


def vector_state(env, drawn, keys):
    """Environments that fly given scenarios (leaves with a leading axis)."""
    begun = jax.jit(jax.vmap(env.reset))(drawn)
    return VectorState(begun, keys, jnp.zeros(len(keys), jnp.int32), jnp.full(len(keys), jnp.inf))


@pytest.mark.slow
def test_environments_do_not_know_of_each_other():
    envs = NumpyVectorEnv(3, SHORT)
    actions = np.random.default_rng(0).uniform(-1, 1, (25, 3, 3))

    def fly(seeds, order):
        envs.reset(seeds)
        return [jax.tree.map(lambda leaf: leaf[order], envs.step(action[order])) for action in actions]

    together, apart = fly([1, 2, 3], [0, 1, 2]), fly([9, 1, 7], [1, 0, 2])
    for ours, other in zip(together, apart, strict=True):
        for leaf, moved in zip(jax.tree.leaves(ours), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(leaf[0], moved[0], rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_an_episode_is_judged_as_the_monte_carlo_judges_it():
    """Violated: in a zone at some step of the episode, whatever the margin is now.  Settled: now."""

    class Hold(Memoryless):
        def decide(self, state, model, memory):
            return jnp.array([0.0, 0.0, -1.0]), memory

    env = Reorientation.from_config(SHORT)
    keys = jax.random.split(jax.random.key(0), 3)
    drawn = jax.jit(jax.vmap(env.sample))(keys)
    # From the target itself the boresight turns towards -y: past a small zone, away from one, towards a far one.
    angles = jnp.deg2rad(jnp.array([[-1.5], [1.5], [-30.0]]))
    drawn = drawn.replace(
        initial=RigidBodyState(jnp.tile(jnp.array([1.0, 0, 0, 0]), (3, 1)), jnp.zeros((3, 3))),
        constraints=drawn.constraints.replace(
            axis_N=jnp.stack([jnp.cos(angles), jnp.sin(angles), jnp.zeros((3, 1))], axis=2),
            half_angle=jnp.deg2rad(jnp.array([[1.0], [1.0], [5.0]])),
        ),
    )
    state = vector_state(env, drawn, keys)
    for _ in range(env.episode_steps):
        state, stepped = vector_env.step(env, state, jnp.tile(jnp.array([0.0, 0.0, -1.0]), (3, 1)))
    judged = jax.jit(jax.vmap(lambda one: rollout.run_case(env, Hold(), one)))(drawn)
    np.testing.assert_array_equal(stepped.violated, judged.violated)
    np.testing.assert_array_equal(stepped.settled, judged.settled)
    np.testing.assert_array_equal(stepped.violated, [True, False, False])
    assert float(stepped.zone_margin[0]) > 0.0


def test_what_was_violated_is_forgotten_in_the_next_episode():
    env = Reorientation.from_config(SHORT)
    keys = jax.random.split(jax.random.key(0), 3)
    state, _ = vector_env.reset(env, keys, jnp.zeros(3, jnp.int32))
    state = state.replace(min_margin=jnp.array([-0.1, 0.1, 0.1]))
    still = jnp.zeros((3, 3))
    violated = []
    for _ in range(21):
        state, stepped = vector_env.step(env, state, still)
        violated.append(np.asarray(stepped.violated))
    np.testing.assert_array_equal(violated, [[True, False, False]] * 20 + [[False] * 3])


def test_episodes_out_of_step_restart_one_by_one():
    env = Reorientation.from_config(SHORT)
    keys = jax.random.split(jax.random.key(1), 3)
    state, _ = vector_env.reset(env, keys, jnp.zeros(3, jnp.int32))
    state = state.replace(maneuver=state.maneuver.replace(steps=jnp.array([0, 5, 19])))
    over = []
    for _ in range(40):
        state, stepped = vector_env.step(env, state, jnp.zeros((3, 3)))
        over.append(np.asarray(stepped.truncated))
        fresh = np.asarray(state.maneuver.steps) == 0
        np.testing.assert_array_equal(fresh, stepped.truncated)
    np.testing.assert_array_equal(np.argwhere(np.array(over)), [[0, 2], [14, 1], [19, 0], [20, 2], [34, 1], [39, 0]])
    np.testing.assert_array_equal(state.episode, [2, 2, 2])


def test_a_reset_without_seeds_goes_on_to_the_scenarios_that_autoreset_would_bring():
    by_hand, by_time = NumpyVectorEnv(3, SHORT), NumpyVectorEnv(3, SHORT)
    by_hand.reset([5, 6, 7])
    by_time.reset([5, 6, 7])
    for _ in range(20):
        stepped = by_time.step(np.zeros((3, 3)))
    np.testing.assert_array_equal(by_hand.reset(), stepped.observation)


@pytest.mark.slow
@pytest.mark.parametrize(
    "task",
    [
        TaskConfig(),
        TaskConfig(
            spacecraft=SpacecraftConfig(inertia=((4.0, 0, 0), (0, 9.0, 0), (0, 0, 12.0)), torque_limit=(5.0, 2.0, 8.0)),
            scenario=ScenarioConfig(max_rate_deg=5.0, infeasible_zone="shrink", max_zones=3),
            episode_seconds=30.0,
        ),
    ],
)
def test_no_observation_leaves_its_bounds(task):
    low, high = observation_layout.observation_bounds(task)
    env = Reorientation.from_config(task, 0.0)
    actions = jax.random.choice(jax.random.key(2), jnp.array([-1.0, 1.0]), (64, 3))

    def fly(key, action):
        # The same full torque all the time: nothing else spins the spacecraft up so much.
        def advance(state, _):
            stepped = env.step(state, action)
            return stepped.state, stepped.observation

        return jax.lax.scan(advance, env.reset(key), None, length=env.episode_steps)[1]

    seen = np.asarray(jax.jit(jax.vmap(fly))(jax.random.split(jax.random.key(3), 64), actions))
    assert np.all(np.isfinite(low)) and np.all(np.isfinite(high))
    assert np.all(seen >= low) and np.all(seen <= high)
    rates = np.abs(seen[..., observation_layout.SLICES["omega_BN_B"]])
    assert rates.max() > 0.1 * high[observation_layout.SLICES["omega_BN_B"]].max()


@pytest.mark.parametrize("num_envs", [0, -1, 2**20 + 1, 2.0, "2"])
def test_a_number_of_environments_that_cannot_be_is_refused(num_envs):
    with pytest.raises(SettingsError, match=f"num_envs: must be a whole number from 1 to .*, got {num_envs!r}"):
        NumpyVectorEnv(num_envs)


@pytest.mark.parametrize(
    ("seeds", "message"),
    [
        ([1], "seeds: must be one for each of 2 environments, got 1"),
        ([1, -1], "seed: must be a whole number from 0 to .*, got -1"),
        ([2**32, 1], "seed: must be a whole number from 0 to .*, got 4294967296"),
        ([1.5, 2], "seed: must be a whole number from 0 to .*, got 1.5"),
        (["1", 2], "seed: must be a whole number from 0 to .*, got '1'"),
        (None, "seeds: must be given at the first reset"),
    ],
)
def test_seeds_that_cannot_be_are_refused(seeds, message):
    with pytest.raises(SettingsError, match=message):
        NumpyVectorEnv(2).reset(seeds)


def test_seeds_follow_one_another():
    assert list(seeds_from(np.int64(3), 2)) == [3, 4]
    assert list(seeds_from(2**32 - 2, 2)) == [2**32 - 2, 2**32 - 1]
    with pytest.raises(SettingsError, match=r"seed: must be from 0 to 2\^32 - 2 for 2 environments, got 4294967295"):
        seeds_from(2**32 - 1, 2)
    with pytest.raises(SettingsError, match=r"seed: must be a whole number .*, got 1\.5"):
        seeds_from(1.5, 2)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros(3), r"actions: must have shape \(2, 3\), got \(3,\)"),
        (np.zeros((3, 2)), r"actions: must have shape \(2, 3\), got \(3, 2\)"),
        (np.array([[0, 0, 0], [0, np.nan, 0]]), r"actions: must be finite in float32, got nan at \[1, 1\]"),
        (np.array([[0, 0, 0], [0, -np.inf, 0]]), r"actions: must be finite in float32, got -inf at \[1, 1\]"),
        ([["a", 0, 0], [0, 0, 0]], "actions: must be an array of real numbers"),
        ([[0, 0, 0], [0, 0]], "actions: must be an array of real numbers"),
        (np.zeros((2, 3), complex), "actions: must be an array of real numbers, got type complex128"),
    ],
)
def test_actions_that_cannot_be_are_refused(actions, message):
    envs = NumpyVectorEnv(2, SHORT)
    envs.reset([0, 1])
    with pytest.raises(SettingsError, match=message):
        envs.step(actions)


def test_a_step_before_the_first_reset_is_refused():
    with pytest.raises(SettingsError, match="step: must come after a reset"):
        NumpyVectorEnv(1).step(np.zeros((1, 3)))


def test_other_numbers_of_the_task_mean_no_other_compilation():
    compiled = []
    for torque_limit in (1.0, 2.0, (1.0, 2.0, 3.0)):
        envs = NumpyVectorEnv(
            3, TaskConfig(spacecraft=SpacecraftConfig(torque_limit=torque_limit), episode_seconds=2.0)
        )
        envs.reset([0, 1, 2])
        for _ in range(3):
            envs.step(np.zeros((3, 3)))
        compiled.append(vector_env.step._cache_size())  # pyright: ignore
    assert len(set(compiled)) == 1
