"""Twin Delayed DDPG (Fujimoto et al. 2018, arXiv:1802.09477), and DDPG (Lillicrap et al. 2016), of which it is made.

The policy is deterministic: tanh of the mean that the network of Soft Actor-Critic gives.  The deviation beside it is
not used; so agents of all learners are alike.
"""

import dataclasses

import jax
import jax.numpy as jnp
import optax

from koz_jax.sac import losses
from koz_jax.sac.actor_critic import ActorCritic, LearnerMetrics, LearnerState, adam, descend, towards
from koz_jax.sac.losses import Batch
from koz_jax.sac.networks import Params


class Td3State(LearnerState):
    """Everything that learning changes."""

    target_policy: Params
    policy_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    updates: jax.Array  # () int32


@dataclasses.dataclass(frozen=True, kw_only=True)
class Td3(ActorCritic):
    """What an update needs besides its state; static.  DDPG has one critic, no target noise and no delay."""

    exploration_noise: float
    target_noise: float = 0.0
    target_noise_clip: float = 0.0
    policy_delay: int = 1

    def act(self, policy: Params, observation: jax.Array) -> jax.Array:
        """The policy's actions (..., actions).  observation: (..., n)."""
        return self.policy.apply(policy, observation).mode()  # pyright: ignore

    def explore(self, learner: Td3State, observation: jax.Array, key: jax.Array) -> jax.Array:
        """Actions (..., actions) in [-1, 1]: the policy's with Gaussian noise.  observation: (..., n)."""
        action = self.act(learner.policy, observation)
        return jnp.clip(action + self.exploration_noise * jax.random.normal(key, action.shape), -1.0, 1.0)

    def init(self, key: jax.Array) -> Td3State:
        """A fresh learner."""
        key_policy, key_critic = jax.random.split(key)
        observation = jnp.zeros(self.observation_size)
        policy = self.policy.init(key_policy, observation)
        critic = self.critic.init(key_critic, observation, jnp.zeros(self.action_size))
        return Td3State(
            policy=policy,
            averaged_policy=jax.tree.map(jnp.copy, policy),
            critic=critic,
            target_critic=jax.tree.map(jnp.copy, critic),
            target_policy=jax.tree.map(jnp.copy, policy),
            policy_optimizer=adam.init(policy),
            critic_optimizer=adam.init(critic),
            updates=jnp.zeros((), jnp.int32),
        )

    def update(
        self, learner: Td3State, batch: Batch, key: jax.Array, learning_rate: jax.Array
    ) -> tuple[Td3State, LearnerMetrics]:
        """Critics; in every ``policy_delay``-th update also the policy and the moving averages (Algorithm 1).

        In the others, ``actor_loss`` and ``policy_gradient`` of the metrics are 0.
        """
        target = self._target(learner, batch, key)

        def objective(critic: Params) -> tuple[jax.Array, jax.Array]:
            q = self.value(critic, batch.observation, batch.action)
            return losses.critic_loss(q, target), q

        (critic_loss, q), gradient = jax.value_and_grad(objective, has_aux=True)(learner.critic)
        critic, critic_optimizer = descend(gradient, learner.critic_optimizer, learner.critic, learning_rate)
        learner = learner.replace(critic=critic, critic_optimizer=critic_optimizer, updates=learner.updates + 1)

        def delayed() -> tuple[Td3State, jax.Array, jax.Array]:
            return self._improve(learner, batch, learning_rate)

        def skipped() -> tuple[Td3State, jax.Array, jax.Array]:
            return learner, jnp.zeros(()), jnp.zeros(())

        learner, actor_loss, policy_gradient = jax.lax.cond(learner.updates % self.policy_delay == 0, delayed, skipped)
        return learner, LearnerMetrics(
            alpha=jnp.zeros(()),
            q_mean=jnp.mean(q),
            critic_loss=critic_loss,
            critic_gradient=optax.tree.norm(gradient),
            entropy=jnp.zeros(()),
            actor_loss=actor_loss,
            policy_gradient=policy_gradient,
        )

    def _target(self, learner: Td3State, batch: Batch, key: jax.Array) -> jax.Array:
        """The smallest of the target critics at a smoothed action of the target policy (Eq. 14).  Returns (batch,)."""
        action = self.act(learner.target_policy, batch.next_observation)
        noise = self.target_noise * jax.random.normal(key, action.shape)
        noise = jnp.clip(noise, -self.target_noise_clip, self.target_noise_clip)
        smoothed = jnp.clip(action + noise, -1.0, 1.0)
        next_q = self.value(learner.target_critic, batch.next_observation, smoothed)
        return batch.reward + batch.discount * jnp.min(next_q, axis=0)

    def _improve(
        self, learner: Td3State, batch: Batch, learning_rate: jax.Array
    ) -> tuple[Td3State, jax.Array, jax.Array]:
        """Move the policy up the first critic, and the averages.  Returns also the loss and its gradient's norm."""

        def objective(policy: Params) -> jax.Array:
            action = self.act(policy, batch.observation)
            return -jnp.mean(self.value(learner.critic, batch.observation, action)[0])

        loss, gradient = jax.value_and_grad(objective)(learner.policy)
        policy, optimizer = descend(gradient, learner.policy_optimizer, learner.policy, learning_rate)
        learner = learner.replace(
            policy=policy,
            averaged_policy=towards(learner.averaged_policy, policy, self.policy_average),
            target_policy=towards(learner.target_policy, policy, self.soft_update),
            target_critic=towards(learner.target_critic, learner.critic, self.soft_update),
            policy_optimizer=optimizer,
        )
        return learner, loss, optax.tree.norm(gradient)
