"""Policy and critics, and the squashed Gaussian that the policy of Soft Actor-Critic draws from."""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.sac.dials import DIAL_FEATURES, Dials, spacing

Params = Any  # a pytree of arrays, as flax makes it
Encoding = tuple[tuple[int, int, float], ...]  # (start, stop, scale): also feed tanh(observation[start:stop] / scale)

# Bounds on the policy's log standard deviation, as in Stable-Baselines3.
LOG_STD_MIN = -20.0
LOG_STD_MAX = 2.0

# Weights uniform in +-1 / sqrt(inputs), as torch.nn.Linear and hence Stable-Baselines3 has it; biases start at zero.
_kernel_init = nn.initializers.variance_scaling(1.0 / 3.0, "fan_in", "uniform")


class SquashedGaussian(struct.PyTreeNode):
    """Distribution of actions: the tanh of a diagonal Gaussian (arXiv:1812.05905, appendix C)."""

    mean: jax.Array  # (..., actions)
    log_std: jax.Array  # (..., actions)

    def sample(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draw actions (..., actions) in (-1, 1) and their log probability (...)."""
        noise = jax.random.normal(key, self.mean.shape)
        raw = self.mean + jnp.exp(self.log_std) * noise
        # log(1 - tanh(x)^2), written so that it neither overflows nor cancels.
        log_slope = 2.0 * (jnp.log(2.0) - raw - jax.nn.softplus(-2.0 * raw))
        log_density = -0.5 * noise**2 - self.log_std - 0.5 * jnp.log(2.0 * jnp.pi)
        return jnp.tanh(raw), jnp.sum(log_density - log_slope, axis=-1)

    def mode(self) -> jax.Array:
        """The deterministic action, tanh(mean).  Returns (..., actions)."""
        return jnp.tanh(self.mean)


def encode(observation: jax.Array, encoding: Encoding) -> jax.Array:
    """Append finer views of some entries.  observation: (..., n).  Returns (..., n + extra)."""
    views = [jnp.tanh(observation[..., start:stop] / scale) for start, stop, scale in encoding]
    return jnp.concatenate([observation, *views], axis=-1)


def dial_features(observation: jax.Array, dials: Dials) -> jax.Array:
    """Gaussian features of each dial.  observation: (..., n).  Returns (..., dials * DIAL_FEATURES)."""
    features = [jnp.zeros((*observation.shape[:-1], 0))]
    for entry, low, high in dials:
        centres = jnp.arange(DIAL_FEATURES, dtype=jnp.float32)
        steps = (observation[..., entry, None] - low) / spacing(low, high) - centres
        features.append(jnp.exp(-0.5 * steps**2))
    return jnp.concatenate(features, axis=-1)


class Mlp(nn.Module):
    """Fully connected ReLU layers and a linear output; where there are dials, they shift and scale every layer."""

    hidden_sizes: tuple[int, ...]
    output_size: int

    @nn.compact
    def __call__(self, x: jax.Array, dialled: jax.Array | None = None) -> jax.Array:
        """x: (..., inputs); dialled: (..., features) of the dials.  Returns (..., output_size)."""
        for number, size in enumerate(self.hidden_sizes):
            x = nn.Dense(size, kernel_init=_kernel_init)(_beside(x, dialled))
            if dialled is not None:
                gain = nn.Dense(size, use_bias=False, kernel_init=nn.initializers.zeros, name=f"Gain_{number}")
                x = x * (1.0 + gain(dialled))
            x = nn.relu(x)
        return nn.Dense(self.output_size, kernel_init=_kernel_init)(_beside(x, dialled))


def _beside(x: jax.Array, dialled: jax.Array | None) -> jax.Array:
    return x if dialled is None else jnp.concatenate([x, dialled], axis=-1)


class Policy(nn.Module):
    """pi(a | s)."""

    hidden_sizes: tuple[int, ...]
    encoding: Encoding
    action_size: int
    dials: Dials = ()

    @nn.compact
    def __call__(self, observation: jax.Array) -> SquashedGaussian:
        """observation: (..., n).  Returns the distribution of actions (..., action_size)."""
        dialled = dial_features(observation, self.dials) if self.dials else None
        output = Mlp(self.hidden_sizes, 2 * self.action_size)(encode(observation, self.encoding), dialled)
        mean, log_std = jnp.split(output, 2, axis=-1)
        return SquashedGaussian(mean, jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX))


class Critics(nn.Module):
    """Independent estimates of Q(s, a)."""

    hidden_sizes: tuple[int, ...]
    encoding: Encoding
    count: int = 2

    @nn.compact
    def __call__(self, observation: jax.Array, action: jax.Array) -> jax.Array:
        """observation: (..., n), action: (..., actions).  Returns (count, ...)."""
        x = jnp.concatenate([encode(observation, self.encoding), action], axis=-1)
        return jnp.stack([Mlp(self.hidden_sizes, 1)(x)[..., 0] for _ in range(self.count)])
