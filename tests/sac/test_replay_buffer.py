"""Laws of the replay ring and of n-step returns."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koz_jax.sac import replay_buffer
from koz_jax.sac.replay_buffer import Transition

NUM_ENVS = 3
COUNT = 20_000  # windows per draw; one size, so that little is compiled


def stamped_row(time):
    """A row whose every leaf tells when it was made, and in which environment."""
    return stamped(10 * time + np.arange(NUM_ENVS))


def stamped(stamp):
    """Transitions with the given stamps, 10 * time + environment; leaves (*stamp.shape, ...)."""
    as_float = stamp.astype(np.float32)
    return Transition(
        observation=as_float[..., None] + np.array([0.0, 0.25], np.float32),
        action=as_float[..., None],
        outcome={"stamp": stamp.astype(np.int32), "nested": (as_float,)},
        terminated=stamp % 2 == 0,
        truncated=stamp % 3 == 0,
        next_observation=as_float[..., None] + np.array([0.5, 0.75], np.float32),
    )


def filled(steps, inserted):
    buffer = _init(stamped_row(0), steps)
    for time in range(inserted):
        buffer = _insert(buffer, stamped_row(time))
    return buffer


_init = jax.jit(replay_buffer.init, static_argnames="steps")
_insert = jax.jit(replay_buffer.insert)
_sample = jax.jit(replay_buffer.sample_windows, static_argnames=("count", "length"))
_n_step = jax.jit(replay_buffer.n_step_batch)


def test_init_takes_shapes_and_types_and_holds_nothing():
    buffer = _init(stamped_row(0), 5)
    assert buffer.size == 0 and buffer.head == 0
    for leaf, example in zip(jax.tree.leaves(buffer.rows), jax.tree.leaves(stamped_row(0)), strict=True):
        assert leaf.shape == (5, *example.shape) and leaf.dtype == example.dtype


@pytest.mark.slow
@settings(max_examples=25)
@given(steps=st.sampled_from([1, 2, 5]), inserted=st.integers(0, 15))
def test_ring_holds_exactly_the_newest_rows(steps, inserted):
    buffer = filled(steps, inserted)
    kept = range(max(0, inserted - steps), inserted)
    assert buffer.size == len(kept)
    assert buffer.head == inserted % steps
    for time in kept:
        row = jax.tree.map(lambda leaf, at=time % steps: leaf[at], buffer.rows)
        jax.tree.map(np.testing.assert_array_equal, row, stamped_row(time))


@pytest.mark.parametrize(("steps", "inserted"), [(8, 3), (8, 5), (8, 8), (8, 9), (8, 13), (8, 16), (8, 31)])
@pytest.mark.parametrize("length", [1, 3])
def test_windows_are_consecutive_in_time_and_never_cross_the_write_head(steps, inserted, length):
    window = _sample(filled(steps, inserted), jax.random.key(inserted), COUNT, length)
    stamp = np.asarray(window.action[..., 0])
    assert stamp.shape == (length, COUNT)
    np.testing.assert_array_equal(np.diff(stamp, axis=0), 10.0)  # one step later, same environment
    time, env = stamp // 10, stamp % 10
    oldest = max(0, inserted - steps)
    assert time.min() == oldest and time.max() == inserted - 1
    assert set(np.unique(env)) == set(range(NUM_ENVS))

    jax.tree.map(np.testing.assert_array_equal, window, stamped(stamp))  # every leaf from the same place


@pytest.mark.parametrize("inserted", [6, 8, 12])
def test_windows_are_drawn_uniformly(inserted):
    count, length = COUNT, 3
    stamp = np.asarray(_sample(filled(8, inserted), jax.random.key(1), count, length).action[0, :, 0], int)
    starts = min(inserted, 8) - length + 1
    values, found = np.unique(stamp, return_counts=True)
    assert len(values) == starts * NUM_ENVS
    expected = count / len(values)
    # Chi-square with k - 1 degrees of freedom: mean k - 1, variance 2 (k - 1).
    chi_square = np.sum((found - expected) ** 2 / expected)
    freedom = len(values) - 1
    assert chi_square < freedom + 4.0 * np.sqrt(2.0 * freedom)


@pytest.mark.parametrize("inserted", [6, 12])
def test_windows_are_drawn_in_proportion_to_the_priority_of_their_first_step(inserted):
    count, length = COUNT, 3
    buffer = filled(8, inserted)
    stamps = np.asarray(buffer.rows.action[..., 0], int)
    priority = jnp.asarray(np.where(stamps % 4 == 1, 5, 1), jnp.int32)
    window = _sample(buffer, jax.random.key(1), count, length, priority)
    stamp = np.asarray(window.action[..., 0], int)
    np.testing.assert_array_equal(np.diff(stamp, axis=0), 10)
    jax.tree.map(np.testing.assert_array_equal, window, stamped(stamp))
    values, found = np.unique(stamp[0], return_counts=True)
    assert len(values) == (min(inserted, 8) - length + 1) * NUM_ENVS
    share = np.where(values % 4 == 1, 5, 1)
    expected = count * share / share.sum()
    chi_square, freedom = np.sum((found - expected) ** 2 / expected), len(values) - 1
    assert chi_square < freedom + 4.0 * np.sqrt(2.0 * freedom)


def test_draws_differ_between_keys_and_within_a_batch():
    buffer = filled(8, 8)
    one, again, other = (np.asarray(_sample(buffer, jax.random.key(k), COUNT, 1).action) for k in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert np.any(one != other)
    assert len(np.unique(one)) > 10


def slow_n_step(window, reward, gamma):
    """What n_step_batch must give, one transition after another in plain Python."""
    length, count = reward.shape
    rewards, discounts, nexts = [], [], []
    for i in range(count):
        total, factor = 0.0, 1.0
        for k in range(length):
            total += factor * float(reward[k, i])
            factor *= gamma
            if window.terminated[k, i] or window.truncated[k, i]:
                break
        rewards.append(total)
        discounts.append(0.0 if window.terminated[k, i] else factor)
        nexts.append(window.next_observation[k, i])
    return np.array(rewards), np.array(discounts), np.array(nexts)


@pytest.mark.slow
@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**31 - 1),
    length=st.sampled_from([1, 2, 4]),
    gamma=st.sampled_from([0.5, 0.99]),
    ends=st.sampled_from([0.0, 0.3, 1.0]),
)
def test_n_step_batch_is_the_slow_loop(seed, length, gamma, ends):
    count = 64
    draw = np.random.default_rng(seed)
    window = Transition(
        observation=jnp.asarray(draw.normal(size=(length, count, 2)), jnp.float32),
        action=jnp.asarray(draw.normal(size=(length, count, 1)), jnp.float32),
        outcome=None,
        terminated=jnp.asarray(draw.random((length, count)) < ends / 2),
        truncated=jnp.asarray(draw.random((length, count)) < ends / 2),
        next_observation=jnp.asarray(draw.normal(size=(length, count, 2)), jnp.float32),
    )
    reward = draw.normal(size=(length, count)).astype(np.float32)
    batch = _n_step(window, jnp.asarray(reward), gamma)
    rewards, discounts, nexts = slow_n_step(jax.device_get(window), reward, gamma)
    np.testing.assert_allclose(batch.reward, rewards, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(batch.discount, discounts, rtol=1e-5)
    np.testing.assert_array_equal(batch.next_observation, nexts)
    np.testing.assert_array_equal(batch.observation, window.observation[0])
    np.testing.assert_array_equal(batch.action, window.action[0])


def flags(*steps):
    return jnp.array(steps)[:, None]


@pytest.mark.parametrize(
    ("terminated", "truncated", "reward", "discount", "next_time"),
    [
        ((0, 0, 0), (0, 0, 0), 1 + 0.5 * 2 + 0.25 * 4, 0.125, 2),
        ((0, 0, 0), (1, 0, 0), 1, 0.5, 0),  # cut: the value follows after the steps that were made
        ((0, 0, 0), (0, 1, 0), 1 + 0.5 * 2, 0.25, 1),
        ((1, 0, 0), (0, 0, 0), 1, 0.0, 0),  # ended: no value follows
        ((0, 1, 0), (0, 0, 0), 1 + 0.5 * 2, 0.0, 1),
        ((0, 0, 1), (1, 0, 0), 1, 0.5, 0),  # what the next episode does is of no concern
        ((0, 0, 1), (0, 0, 1), 1 + 0.5 * 2 + 0.25 * 4, 0.0, 2),  # both at once: it did end
    ],
)
def test_n_step_batch_at_the_end_of_an_episode(terminated, truncated, reward, discount, next_time):
    stamps = jnp.arange(3.0)[:, None, None]
    window = Transition(
        observation=stamps,
        action=stamps,
        outcome=None,
        terminated=flags(*terminated) == 1,
        truncated=flags(*truncated) == 1,
        next_observation=stamps,
    )
    batch = _n_step(window, flags(1.0, 2.0, 4.0), 0.5)
    assert batch.reward[0] == pytest.approx(reward)
    assert batch.discount[0] == pytest.approx(discount)
    assert batch.next_observation[0, 0] == next_time


@pytest.mark.parametrize("inserted", [3, 8, 13])
def test_truncating_the_newest_row_cuts_its_episodes_and_touches_nothing_else(inserted):
    """So that no window runs on from it into what other environments do next."""
    buffer = filled(8, inserted)
    cut = jax.jit(replay_buffer.truncate_newest)(buffer)
    newest = (inserted - 1) % 8
    assert np.all(np.asarray(cut.rows.truncated)[newest])
    expected = np.array(buffer.rows.truncated)
    expected[newest] = True
    np.testing.assert_array_equal(cut.rows.truncated, expected)
    same = cut.replace(rows=cut.rows.replace(truncated=buffer.rows.truncated))
    jax.tree.map(np.testing.assert_array_equal, same, buffer)
    # The next row is of other environments: of a window over both, only the first step counts.
    window = _sample(_insert(cut, stamped_row(100)), jax.random.key(0), COUNT, 2)
    batch = _n_step(window, jnp.ones((2, COUNT)), 0.5)
    over_the_cut = np.asarray(window.action[1, :, 0]) >= 1000.0
    assert over_the_cut.any()
    np.testing.assert_array_equal(batch.reward[over_the_cut], 1.0)
