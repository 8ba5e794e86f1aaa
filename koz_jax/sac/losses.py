"""The three losses of Soft Actor-Critic with a learned entropy coefficient (arXiv:1812.05905)."""

import jax
import jax.numpy as jnp
from flax import struct


class Batch(struct.PyTreeNode):
    """Transitions to learn from, over n steps where n-step returns are used."""

    observation: jax.Array  # (batch, n)
    action: jax.Array  # (batch, actions)
    reward: jax.Array  # (batch,) discounted sum over the window
    discount: jax.Array  # (batch,) factor on the value of next_observation; 0 where the episode terminated
    next_observation: jax.Array  # (batch, n) true observation at the window's end, never one after a reset


def critic_target(next_q: jax.Array, next_log_prob: jax.Array, alpha: jax.Array, batch: Batch) -> jax.Array:
    """Soft Bellman target (Eq. 2, 3 and 5), with the smaller of two target critics.

    next_q: (2, batch) target critics at a fresh action; next_log_prob: (batch,); alpha: ().  Returns (batch,).
    """
    next_value = jnp.min(next_q, axis=0) - alpha * next_log_prob
    return batch.reward + batch.discount * next_value


def critic_loss(q: jax.Array, target: jax.Array) -> jax.Array:
    """Soft Bellman residual (Eq. 5), summed over the two critics.  q: (2, batch), target: (batch,).  Returns ()."""
    return jnp.sum(jnp.mean(0.5 * jnp.square(q - jax.lax.stop_gradient(target)), axis=1))


def actor_loss(q: jax.Array, log_prob: jax.Array, alpha: jax.Array) -> jax.Array:
    """Policy objective (Eq. 9).  q: (2, batch) at the policy's own actions; log_prob: (batch,).  Returns ()."""
    return jnp.mean(alpha * log_prob - jnp.min(q, axis=0))


def alpha_loss(log_alpha: jax.Array, log_prob: jax.Array, target_entropy: float) -> jax.Array:
    """Objective of the entropy coefficient (Eq. 18, in log alpha as is usual).  Returns ()."""
    return -jnp.mean(log_alpha * jax.lax.stop_gradient(log_prob + target_entropy))
