"""The first term of a training step that is not finite.

A fault spreads to everything within an update or two, so what is found at the end of a chunk does not tell where it
began.  Each training step therefore notes the first term that is not finite, in the order of the computation.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.sac.actor_critic import LearnerMetrics
from koz_jax.task.reward import RewardTerms

_NEVER = 2**31 - 1

NO_FAULT = -1


class Watched(struct.PyTreeNode):
    """What a training step computes, in the order in which it does."""

    parameters: Any  # networks before the step; any pytree
    observation: jax.Array  # (environments, n)
    reward: RewardTerms  # leaves (environments,)
    drawn_reward: jax.Array  # (drawn,) of the batches
    train: LearnerMetrics  # leaves (updates,)


_NAMES = (
    "parameters",
    "observation",
    *(f"reward/{name}" for name in RewardTerms.__dataclass_fields__),
    "reward of the drawn transitions",
    *(f"train/{name}" for name in LearnerMetrics.__dataclass_fields__),
)


def all_finite(tree: Any) -> jax.Array:
    """Whether all numbers of a pytree are finite.  Returns () bool."""
    flags = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]
    return jnp.all(jnp.stack(flags))


def first_fault(watched: Watched) -> jax.Array:
    """Find the first term that is not finite.  Returns () int32, for ``fault_name``; ``NO_FAULT`` if there is none."""
    before = [watched.parameters, watched.observation, *jax.tree.leaves(watched.reward), watched.drawn_reward]
    times = [jnp.where(all_finite(part), _NEVER, 0) for part in before]
    for series in jax.tree.leaves(watched.train):
        broken = ~jnp.isfinite(series)
        times.append(jnp.where(jnp.any(broken), 1 + jnp.argmax(broken), _NEVER))
    stacked = jnp.stack(times)
    first = jnp.argmin(stacked)
    return jnp.where(stacked[first] < _NEVER, first, NO_FAULT).astype(jnp.int32)


def fault_name(fault: int) -> str:
    """Name of a term that ``first_fault`` found."""
    return _NAMES[fault]
