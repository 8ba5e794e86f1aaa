"""A run that diverges: numbers that are not finite end it before they are saved, a diverging critic is warned of."""

import math
from typing import Any

import jax

from koz_jax.config.training import TrainConfig
from koz_jax.errors import DivergenceError
from koz_jax.learning.finite_checks import NO_FAULT, all_finite, fault_name
from koz_jax.sac.actor_critic import LearnerMetrics
from koz_jax.storage import processes, pytrees
from koz_jax.task.reward import PAPER_WEIGHTS

# A critic that promises so many times what the reward can give has diverged.
_FAR_BEYOND = 2.0


@jax.jit
def _finite_flags(tree: Any) -> Any:
    return jax.tree.map(all_finite, pytrees.key_data(tree))


def check_finite(done: int, fault: int, state: Any) -> None:
    """Refuse what a chunk came to if there is anything in it that is not finite.

    Args:
        done: updates (then refinement iterations) after the chunk.
        fault: what ``finite_checks.first_fault`` found in it.
        state: everything that must be finite after it; leaves are named by their place.

    Raises:
        DivergenceError: there is; it names the first term.

    """
    if fault != NO_FAULT:
        name = fault_name(fault)
    else:
        flags = pytrees.named_leaves(jax.device_get(processes.wait_for_devices(_finite_flags(state))))
        broken = [name for name, sound in flags.items() if not sound]
        if not broken:
            return
        name = ", ".join(broken[:3]) + (f" and {len(broken) - 3} more" if len(broken) > 3 else "")
    raise DivergenceError(
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

    largest_torque = math.hypot(*task.spacecraft.torque_limits)
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


def critic_warning(config: TrainConfig, metrics: LearnerMetrics) -> str | None:
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
