"""A watch over training: what is no number any more is named, and ends the run before it is saved.

A fault spreads to everything within an update or two, so what is found at the end of a chunk does not tell where it
began.  Each training step therefore notes the first term that is not finite, in the order of the computation.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax import processes, storage
from koz_jax.config import TrainConfig
from koz_jax.errors import UserError
from koz_jax.reward import PAPER_WEIGHTS, RewardTerms
from koz_jax.sac.learner import LearnerMetrics

# A critic that promises so many times what the reward can give has diverged.
_FAR_BEYOND = 2.0

_NEVER = 2**31 - 1
SOUND = -1


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


def _all_finite(tree: Any) -> jax.Array:
    """Whether all numbers of a pytree are finite.  Returns () bool."""
    flags = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(storage.key_data(tree))]
    return jnp.all(jnp.stack(flags))


def first_fault(watched: Watched) -> jax.Array:
    """Find the first term that is not finite.  Returns () int32, for ``fault_name``; ``SOUND`` if there is none."""
    before = [watched.parameters, watched.observation, *jax.tree.leaves(watched.reward), watched.drawn_reward]
    times = [jnp.where(_all_finite(part), _NEVER, 0) for part in before]
    for series in jax.tree.leaves(watched.train):
        broken = ~jnp.isfinite(series)
        times.append(jnp.where(jnp.any(broken), 1 + jnp.argmax(broken), _NEVER))
    stacked = jnp.stack(times)
    first = jnp.argmin(stacked)
    return jnp.where(stacked[first] < _NEVER, first, SOUND).astype(jnp.int32)


def fault_name(fault: int) -> str:
    """Name of a term that ``first_fault`` found."""
    return _NAMES[fault]


@jax.jit
def _sound(tree: Any) -> Any:
    return jax.tree.map(_all_finite, tree)


def check(done: int, fault: int, state: Any) -> None:
    """Refuse what a chunk came to if there is anything in it that is not finite.

    Args:
        done: updates (then refinement iterations) after the chunk.
        fault: what ``first_fault`` found in it.
        state: everything that must be finite after it; leaves are named by their place.

    Raises:
        UserError: there is; it names the first term.

    """
    if fault != SOUND:
        name = fault_name(fault)
    else:
        flags = storage.named_leaves(jax.device_get(processes.finished(_sound(state))))
        broken = [name for name, sound in flags.items() if not sound]
        if not broken:
            return
        name = ", ".join(broken[:3]) + (f" and {len(broken) - 3} more" if len(broken) > 3 else "")
    raise UserError(
        f"{name}: not finite in the chunk that ends at update {done}; the run ends here, nothing of the chunk is kept"
        " and the last checkpoint is good. To go on, begin another run from it (--start-from) with other settings,"
        " such as lower learning rates"
    )


def largest_value(config: TrainConfig, entropy_bonus: float = 0.0) -> float:
    """Compute what the discounted sum of rewards cannot exceed.

    entropy_bonus: what the learner adds to the reward of a step.
    """
    task, phases = config.task, (config.curriculum.phase1, config.curriculum.phase2)

    def most(ramp: str) -> float:
        return max(value for phase in phases for _, value in getattr(phase, ramp))

    largest_torque = math.sqrt(3.0) * task.spacecraft.torque_limit
    gain = PAPER_WEIGHTS.attitude + task.reward.settled_bonus
    loss = (
        task.reward.torque_cost
        + task.reward.torque_change_cost * 2.0 * largest_torque
        + task.reward.zone_height * most("zone_weight")
        + task.reward.no_progress_cost
        + 3.0 * most("effort_weight")
        + 2.0 * math.sqrt(3.0) * config.shielding.intervention_cost
    )
    per_step = config.sac.reward_scale * max(gain, loss) + abs(entropy_bonus)
    return float(per_step / (1.0 - most("discount")))


def divergence(config: TrainConfig, metrics: LearnerMetrics) -> str | None:
    """Describe a critic that promises far more than there is to get; None if it does not.

    metrics: means over a chunk, leaves ().
    """
    limit = largest_value(config, float(metrics.alpha * metrics.entropy))
    if abs(float(metrics.q_mean)) <= _FAR_BEYOND * limit:
        return None
    return (
        f"train/q_mean is {float(metrics.q_mean):.4g}, but no policy can collect more than {limit:.4g}: the critic"
        " diverges (lower learning rates, or a smaller soft_update, help)"
    )
