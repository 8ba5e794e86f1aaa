"""Replay buffer: a ring over time of rows with one transition per environment, written in place."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.sac.losses import Batch


class Transition(struct.PyTreeNode):
    """One step of one environment, before any reward is computed."""

    observation: jax.Array  # (n,)
    action: jax.Array  # (actions,)
    outcome: Any  # what the reward is computed from; any pytree
    terminated: jax.Array  # () bool, the task itself ended: no value follows
    truncated: jax.Array  # () bool, the episode was cut: value follows, but no further step
    next_observation: jax.Array  # (n,) true observation after the step, also at the end of an episode


class ReplayBuffer(struct.PyTreeNode):
    """The ring.  Leaves of ``rows`` have the leading axes (steps, environments)."""

    rows: Transition
    head: jax.Array  # () int32, where the next row goes
    size: jax.Array  # () int32, rows that hold data


def init(example: Transition, steps: int) -> ReplayBuffer:
    """An empty buffer.  example: one row of transitions, leaves (environments, ...); steps: rows it can hold."""
    rows = jax.tree.map(lambda leaf: jnp.zeros((steps, *leaf.shape), leaf.dtype), example)
    return ReplayBuffer(rows=rows, head=jnp.zeros((), jnp.int32), size=jnp.zeros((), jnp.int32))


def insert(buffer: ReplayBuffer, row: Transition) -> ReplayBuffer:
    """Write one row, over the oldest one when full.  row: leaves (environments, ...)."""
    steps = jax.tree.leaves(buffer.rows)[0].shape[0]
    rows = jax.tree.map(
        lambda leaf, new: jax.lax.dynamic_update_index_in_dim(leaf, new, buffer.head, axis=0), buffer.rows, row
    )
    return ReplayBuffer(rows=rows, head=(buffer.head + 1) % steps, size=jnp.minimum(buffer.size + 1, steps))


def truncate_newest(buffer: ReplayBuffer) -> ReplayBuffer:
    """Cut the newest row's episodes, so that no window runs on into rows of other environments."""
    newest = (buffer.head - 1) % buffer.rows.truncated.shape[0]
    truncated = buffer.rows.truncated.at[newest].set(True)
    return buffer.replace(rows=buffer.rows.replace(truncated=truncated))


def sample_windows(
    buffer: ReplayBuffer, key: jax.Array, count: int, length: int, priority: jax.Array | None = None
) -> Transition:
    """Draw runs of consecutive steps of one environment, uniformly or in proportion to the priority of the first step.

    Needs at least ``length`` rows of data.  priority: (steps, environments) int32, at least 1, of each step where it is
    in the ring; their sum must stay below 2^31.  Returns leaves (length, count, ...).
    """
    steps, num_envs = buffer.rows.terminated.shape
    oldest = buffer.head - buffer.size
    starts = buffer.size - length + 1
    if priority is None:
        key_start, key_env = jax.random.split(key)
        start = oldest + jax.random.randint(key_start, (count,), 0, starts)
        env = jax.random.randint(key_env, (count,), 0, num_envs)
    else:
        may_start = (jnp.arange(steps) - oldest) % steps < starts
        # Whole numbers: a sum of a million of them is exact.
        ends = jnp.cumsum(jnp.where(may_start[:, None], priority, 0).ravel())
        place = jnp.searchsorted(ends, jax.random.randint(key, (count,), 0, ends[-1]), side="right")
        start, env = place // num_envs, place % num_envs
    step = (start + jnp.arange(length)[:, None]) % steps
    return jax.tree.map(lambda leaf: leaf[step, env], buffer.rows)


def n_step_batch(window: Transition, reward: jax.Array, discount: jax.Array | float) -> Batch:
    """Sum the rewards of each window up to the end of its episode.

    window: leaves (length, count, ...); reward: (length, count); discount: gamma per step.  A window that is cut by
    a truncation bootstraps from the true observation at the cut, one that terminates does not bootstrap.  As is usual,
    the entropy of the steps inside a window is left out, and their actions are not corrected for being older.
    """
    length = reward.shape[0]
    ended = window.terminated | window.truncated
    # alive[k]: no episode end before step k, so step k belongs to the window's first episode.
    alive = jnp.cumprod(jnp.concatenate([jnp.ones_like(ended[:1]), ~ended[:-1]]).astype(jnp.int32), axis=0)
    last = jnp.sum(alive, axis=0) - 1
    powers = discount ** jnp.arange(length)

    def at_last(leaf: jax.Array) -> jax.Array:
        return leaf[last, jnp.arange(leaf.shape[1])]

    return Batch(
        observation=window.observation[0],
        action=window.action[0],
        reward=jnp.sum(powers[:, None] * alive * reward, axis=0),
        discount=powers[last] * discount * ~at_last(window.terminated),
        next_observation=at_last(window.next_observation),
    )
