"""One gradient update of Soft Actor-Critic."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax

from koz_jax.sac import losses
from koz_jax.sac.actor_critic import ActorCritic, LearnerMetrics, LearnerState, adam, descend, towards
from koz_jax.sac.losses import Batch
from koz_jax.sac.networks import Params, SquashedGaussian


class SacState(LearnerState):
    """Everything that learning changes."""

    log_alpha: jax.Array  # () log of the entropy coefficient
    policy_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    alpha_optimizer: optax.OptState

    @property
    def trained(self) -> tuple[Any, ...]:
        """What gradients move."""
        return self.policy, self.critic, self.log_alpha


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sac(ActorCritic):
    """What an update needs besides its state; static."""

    target_entropy: float
    initial_entropy_coefficient: float

    def act(self, policy: Params, observation: jax.Array) -> SquashedGaussian:
        """Distribution of actions.  observation: (..., n)."""
        return self.policy.apply(policy, observation)  # pyright: ignore[reportReturnType]

    def explore(self, learner: SacState, observation: jax.Array, key: jax.Array) -> jax.Array:
        """Actions (..., actions) in (-1, 1), drawn from the policy.  observation: (..., n)."""
        return self.act(learner.policy, observation).sample(key)[0]

    def init(self, key: jax.Array) -> SacState:
        """A fresh learner."""
        key_policy, key_critic = jax.random.split(key)
        observation = jnp.zeros(self.observation_size)
        policy = self.policy.init(key_policy, observation)
        critic = self.critic.init(key_critic, observation, jnp.zeros(self.action_size))
        log_alpha = jnp.log(jnp.float32(self.initial_entropy_coefficient))
        return SacState(
            policy=policy,
            averaged_policy=jax.tree.map(jnp.copy, policy),
            critic=critic,
            target_critic=jax.tree.map(jnp.copy, critic),
            log_alpha=log_alpha,
            policy_optimizer=adam.init(policy),
            critic_optimizer=adam.init(critic),
            alpha_optimizer=adam.init(log_alpha),
        )

    def update(
        self, learner: SacState, batch: Batch, key: jax.Array, learning_rate: jax.Array
    ) -> tuple[SacState, LearnerMetrics]:
        """Entropy coefficient, critics, policy, then the moving averages, in the order of Stable-Baselines3."""
        key_policy, key_next = jax.random.split(key)
        alpha = jnp.exp(learner.log_alpha)

        next_action, next_log_prob = self.act(learner.policy, batch.next_observation).sample(key_next)
        next_q = self.value(learner.target_critic, batch.next_observation, next_action)
        target = losses.critic_target(next_q, next_log_prob, alpha, batch)

        def critic_objective(critic: Params) -> tuple[jax.Array, jax.Array]:
            q = self.value(critic, batch.observation, batch.action)
            return losses.critic_loss(q, target), q

        (critic_loss, q), critic_gradient = jax.value_and_grad(critic_objective, has_aux=True)(learner.critic)
        critic, critic_optimizer = descend(critic_gradient, learner.critic_optimizer, learner.critic, learning_rate)

        def actor_objective(policy: Params) -> tuple[jax.Array, jax.Array]:
            action, log_prob = self.act(policy, batch.observation).sample(key_policy)
            return losses.actor_loss(self.value(critic, batch.observation, action), log_prob, alpha), log_prob

        (actor_loss, log_prob), policy_gradient = jax.value_and_grad(actor_objective, has_aux=True)(learner.policy)
        policy, policy_optimizer = descend(policy_gradient, learner.policy_optimizer, learner.policy, learning_rate)

        gradient = jax.grad(losses.alpha_loss)(learner.log_alpha, log_prob, self.target_entropy)
        log_alpha, alpha_optimizer = descend(gradient, learner.alpha_optimizer, learner.log_alpha, learning_rate)

        learner = SacState(
            policy=policy,
            averaged_policy=towards(learner.averaged_policy, policy, self.policy_average),
            critic=critic,
            target_critic=towards(learner.target_critic, critic, self.soft_update),
            log_alpha=log_alpha,
            policy_optimizer=policy_optimizer,
            critic_optimizer=critic_optimizer,
            alpha_optimizer=alpha_optimizer,
        )
        return learner, LearnerMetrics(
            alpha=alpha,
            q_mean=jnp.mean(q),
            critic_loss=critic_loss,
            critic_gradient=optax.tree.norm(critic_gradient),
            entropy=-jnp.mean(log_prob),
            actor_loss=actor_loss,
            policy_gradient=optax.tree.norm(policy_gradient),
        )
