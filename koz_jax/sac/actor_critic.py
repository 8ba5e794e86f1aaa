"""What Soft Actor-Critic shares with other off-policy learners: networks, what a state holds, steps of an optimizer."""

import dataclasses
from typing import Any, Protocol

import jax
import optax
from flax import struct

from koz_jax.sac.dials import Dials
from koz_jax.sac.losses import Batch
from koz_jax.sac.networks import Critics, Encoding, Params, Policy


class LearnerState(struct.PyTreeNode):
    """Everything that learning changes; each learner adds what else it has."""

    policy: Params
    averaged_policy: Params  # exponential moving average, the one that is evaluated and shipped
    critic: Params
    target_critic: Params

    @property
    def trained(self) -> tuple[Any, ...]:
        """What gradients move."""
        return self.policy, self.critic


class LearnerMetrics(struct.PyTreeNode):
    """What an update reports, in the order in which it is computed."""

    alpha: jax.Array  # () entropy coefficient; 0 of a deterministic policy
    q_mean: jax.Array  # () of the critics on the batch
    critic_loss: jax.Array  # ()
    critic_gradient: jax.Array  # () norm
    entropy: jax.Array  # () of the policy, estimated on the batch; 0 of a deterministic policy
    actor_loss: jax.Array  # ()
    policy_gradient: jax.Array  # () norm


class Learner(Protocol):
    """The socket of training: static settings with three methods."""

    def init(self, key: jax.Array) -> Any:
        """A fresh state, of a class of its own that is a ``LearnerState``.  key: () typed PRNG key."""
        ...

    def explore(self, learner: Any, observation: jax.Array, key: jax.Array) -> jax.Array:
        """Actions (..., actions) in [-1, 1] to gather experience with.  observation: (..., n)."""
        ...

    def update(
        self, learner: Any, batch: Batch, key: jax.Array, learning_rate: jax.Array
    ) -> tuple[Any, LearnerMetrics]:
        """One gradient update."""
        ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActorCritic:
    """Sizes of the networks and of their averages; static."""

    hidden_sizes: tuple[int, ...]
    encoding: Encoding
    observation_size: int
    action_size: int
    soft_update: float
    policy_average: float
    dials: Dials = ()
    critics: int = 2

    @property
    def policy(self) -> Policy:
        """The policy network."""
        return Policy(self.hidden_sizes, self.encoding, self.action_size, self.dials)

    @property
    def critic(self) -> Critics:
        """The critic networks."""
        return Critics(self.hidden_sizes, self.encoding, self.critics)

    def value(self, critic: Params, observation: jax.Array, action: jax.Array) -> jax.Array:
        """All critics.  Returns (critics, ...)."""
        return self.critic.apply(critic, observation, action)  # pyright: ignore[reportReturnType]


# The learning rate is left out here: the curriculum gives it, update by update.
adam = optax.scale_by_adam()


def descend(
    gradient: Params, optimizer: optax.OptState, params: Params, learning_rate: jax.Array
) -> tuple[Params, optax.OptState]:
    """One step of Adam.  Returns parameters and state of the optimizer."""
    direction, optimizer = adam.update(gradient, optimizer)
    return jax.tree.map(lambda p, d: p - learning_rate * d, params, direction), optimizer


def towards(average: Params, new: Params, share: float) -> Params:
    """Exponential moving average, one step."""
    return optax.incremental_update(new, average, share)
