"""Double DQN (van Hasselt et al. 2016, arXiv:1509.06461): which of some actions is worth most."""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax import struct

from koz_jax.sac.actor_critic import adam, descend, towards
from koz_jax.sac.losses import Batch
from koz_jax.sac.networks import Encoding, Mlp, Params, encode


class ActionValues(nn.Module):
    """Q(s, a) of every action a."""

    hidden_sizes: tuple[int, ...]
    encoding: Encoding
    actions: int

    @nn.compact
    def __call__(self, observation: jax.Array) -> jax.Array:
        """observation: (..., n).  Returns (..., actions)."""
        return Mlp(self.hidden_sizes, self.actions)(encode(observation, self.encoding))


class DqnState(struct.PyTreeNode):
    """Everything that learning changes."""

    values: Params
    averaged_values: Params  # the one that is shipped
    target_values: Params
    optimizer: optax.OptState


@dataclasses.dataclass(frozen=True, kw_only=True)
class Dqn:
    """What an update needs besides its state; static."""

    hidden_sizes: tuple[int, ...]
    encoding: Encoding
    observation_size: int
    actions: int
    soft_update: float
    average: float

    @property
    def network(self) -> ActionValues:
        """The network."""
        return ActionValues(self.hidden_sizes, self.encoding, self.actions)

    def value(self, values: Params, observation: jax.Array) -> jax.Array:
        """Value (..., actions) of every action.  observation: (..., n)."""
        return self.network.apply(values, observation)  # pyright: ignore[reportReturnType]

    def explore(self, learner: DqnState, observation: jax.Array, key: jax.Array, share: jax.Array) -> jax.Array:
        """Actions (...) int32: the best ones, but a share () of them at random.  observation: (..., n)."""
        key_where, key_which = jax.random.split(key)
        best = jnp.argmax(self.value(learner.values, observation), axis=-1)
        at_random = jax.random.uniform(key_where, best.shape) < share
        return jnp.where(at_random, jax.random.randint(key_which, best.shape, 0, self.actions), best)

    def init(self, key: jax.Array) -> DqnState:
        """A fresh learner.  key: () typed PRNG key."""
        values = self.network.init(key, jnp.zeros(self.observation_size))
        return DqnState(
            values=values,
            averaged_values=jax.tree.map(jnp.copy, values),
            target_values=jax.tree.map(jnp.copy, values),
            optimizer=adam.init(values),
        )

    def update(self, learner: DqnState, batch: Batch, learning_rate: jax.Array) -> tuple[DqnState, jax.Array]:
        """One gradient update.  batch: its actions (batch,) int32.  Returns also the loss ()."""
        chosen = jnp.argmax(self.value(learner.values, batch.next_observation), axis=-1)
        next_values = _at(self.value(learner.target_values, batch.next_observation), chosen)
        target = batch.reward + batch.discount * next_values

        def objective(values: Params) -> jax.Array:
            error = _at(self.value(values, batch.observation), batch.action) - target
            return jnp.mean(0.5 * jnp.square(error))

        loss, gradient = jax.value_and_grad(objective)(learner.values)
        values, optimizer = descend(gradient, learner.optimizer, learner.values, learning_rate)
        return DqnState(
            values=values,
            averaged_values=towards(learner.averaged_values, values, self.average),
            target_values=towards(learner.target_values, values, self.soft_update),
            optimizer=optimizer,
        ), loss


def _at(values: jax.Array, actions: jax.Array) -> jax.Array:
    """Entries of values (n, actions) at actions (n,) int32.  Returns (n,)."""
    return jnp.take_along_axis(values, actions[:, None], axis=1)[:, 0]
