"""One gradient update of Soft Actor-Critic."""

import dataclasses

import jax
import jax.numpy as jnp
import optax
from flax import struct

from koz_jax.sac import losses
from koz_jax.sac.dials import Dials
from koz_jax.sac.losses import Batch
from koz_jax.sac.networks import Encoding, Params, Policy, SquashedGaussian, TwinCritic


@dataclasses.dataclass(frozen=True)
class Sac:
    """What an update needs besides its state; static."""

    hidden_sizes: tuple[int, ...]
    encoding: Encoding
    observation_size: int
    action_size: int
    target_entropy: float
    soft_update: float
    policy_average: float
    initial_entropy_coefficient: float
    dials: Dials = ()

    @property
    def policy(self) -> Policy:
        """The policy network."""
        return Policy(self.hidden_sizes, self.encoding, self.action_size, self.dials)

    @property
    def critic(self) -> TwinCritic:
        """The pair of critic networks."""
        return TwinCritic(self.hidden_sizes, self.encoding)

    def act(self, policy: Params, observation: jax.Array) -> SquashedGaussian:
        """Distribution of actions.  observation: (..., n)."""
        return self.policy.apply(policy, observation)  # pyright: ignore[reportReturnType]

    def value(self, critic: Params, observation: jax.Array, action: jax.Array) -> jax.Array:
        """Both critics.  Returns (2, ...)."""
        return self.critic.apply(critic, observation, action)  # pyright: ignore[reportReturnType]


# The learning rate is left out here: the curriculum gives it, update by update.
_adam = optax.scale_by_adam()


class LearnerState(struct.PyTreeNode):
    """Everything that learning changes."""

    policy: Params
    averaged_policy: Params  # exponential moving average, the one that is evaluated and shipped
    critic: Params
    target_critic: Params
    log_alpha: jax.Array  # () log of the entropy coefficient
    policy_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    alpha_optimizer: optax.OptState


class LearnerMetrics(struct.PyTreeNode):
    """What an update reports, in the order in which it is computed."""

    alpha: jax.Array  # () entropy coefficient
    q_mean: jax.Array  # () of the critics on the batch
    critic_loss: jax.Array  # ()
    critic_gradient: jax.Array  # () norm
    entropy: jax.Array  # () of the policy, estimated on the batch
    actor_loss: jax.Array  # ()
    policy_gradient: jax.Array  # () norm


def init(sac: Sac, key: jax.Array) -> LearnerState:
    """A fresh learner."""
    key_policy, key_critic = jax.random.split(key)
    observation = jnp.zeros(sac.observation_size)
    policy = sac.policy.init(key_policy, observation)
    critic = sac.critic.init(key_critic, observation, jnp.zeros(sac.action_size))
    log_alpha = jnp.log(jnp.float32(sac.initial_entropy_coefficient))
    return LearnerState(
        policy=policy,
        averaged_policy=jax.tree.map(jnp.copy, policy),
        critic=critic,
        target_critic=jax.tree.map(jnp.copy, critic),
        log_alpha=log_alpha,
        policy_optimizer=_adam.init(policy),
        critic_optimizer=_adam.init(critic),
        alpha_optimizer=_adam.init(log_alpha),
    )


def _descend(
    gradient: Params, optimizer: optax.OptState, params: Params, learning_rate: jax.Array
) -> tuple[Params, optax.OptState]:
    direction, optimizer = _adam.update(gradient, optimizer)
    return jax.tree.map(lambda p, d: p - learning_rate * d, params, direction), optimizer


def _towards(average: Params, new: Params, share: float) -> Params:
    """Exponential moving average, one step."""
    return optax.incremental_update(new, average, share)


def update(
    sac: Sac, learner: LearnerState, batch: Batch, key: jax.Array, learning_rate: jax.Array
) -> tuple[LearnerState, LearnerMetrics]:
    """Entropy coefficient, critics, policy, then the moving averages, in the order of Stable-Baselines3."""
    key_policy, key_next = jax.random.split(key)
    alpha = jnp.exp(learner.log_alpha)

    next_action, next_log_prob = sac.act(learner.policy, batch.next_observation).sample(key_next)
    next_q = sac.value(learner.target_critic, batch.next_observation, next_action)
    target = losses.critic_target(next_q, next_log_prob, alpha, batch)

    def critic_objective(critic: Params) -> tuple[jax.Array, jax.Array]:
        q = sac.value(critic, batch.observation, batch.action)
        return losses.critic_loss(q, target), q

    (critic_loss, q), critic_gradient = jax.value_and_grad(critic_objective, has_aux=True)(learner.critic)
    critic, critic_optimizer = _descend(critic_gradient, learner.critic_optimizer, learner.critic, learning_rate)

    def actor_objective(policy: Params) -> tuple[jax.Array, jax.Array]:
        action, log_prob = sac.act(policy, batch.observation).sample(key_policy)
        return losses.actor_loss(sac.value(critic, batch.observation, action), log_prob, alpha), log_prob

    (actor_loss, log_prob), policy_gradient = jax.value_and_grad(actor_objective, has_aux=True)(learner.policy)
    policy, policy_optimizer = _descend(policy_gradient, learner.policy_optimizer, learner.policy, learning_rate)

    gradient = jax.grad(losses.alpha_loss)(learner.log_alpha, log_prob, sac.target_entropy)
    log_alpha, alpha_optimizer = _descend(gradient, learner.alpha_optimizer, learner.log_alpha, learning_rate)

    learner = LearnerState(
        policy=policy,
        averaged_policy=_towards(learner.averaged_policy, policy, sac.policy_average),
        critic=critic,
        target_critic=_towards(learner.target_critic, critic, sac.soft_update),
        log_alpha=log_alpha,
        policy_optimizer=policy_optimizer,
        critic_optimizer=critic_optimizer,
        alpha_optimizer=alpha_optimizer,
    )
    metrics = LearnerMetrics(
        alpha=alpha,
        q_mean=jnp.mean(q),
        critic_loss=critic_loss,
        critic_gradient=optax.tree.norm(critic_gradient),
        entropy=-jnp.mean(log_prob),
        actor_loss=actor_loss,
        policy_gradient=optax.tree.norm(policy_gradient),
    )
    return learner, metrics
