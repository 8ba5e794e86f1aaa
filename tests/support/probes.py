"""Toy problems with known answers, each a stack of batches that the learner goes through in one jitted scan.

All have the same shapes, so that all share one compilation.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp

from koz_jax.sac import replay_buffer
from koz_jax.sac.actor_critic import Learner, LearnerMetrics, LearnerState
from koz_jax.sac.learner import Sac, SacState
from koz_jax.sac.losses import Batch
from koz_jax.sac.replay_buffer import Transition

GAMMA = 0.9
UPDATES = 4000
BATCH = 64
SHAPE = (UPDATES, BATCH)

SAC = Sac(
    hidden_sizes=(32, 32),
    encoding=((0, 1, 0.5),),
    observation_size=2,
    action_size=1,
    target_entropy=-1.0,
    soft_update=0.05,
    policy_average=0.02,
    initial_entropy_coefficient=1.0,
)
GREEDY = 1e-8  # an entropy coefficient that does not matter, and stays so over a probe


# Thousands of updates, so that here it pays to optimise what is compiled; see ``conftest.py``.
@functools.partial(jax.jit, static_argnums=0, compiler_options={"xla_backend_optimization_level": 2})
def _learn(algorithm: Learner, batches: Batch, key: jax.Array, **begin: jax.Array) -> tuple[Any, LearnerMetrics]:
    key_init, key_updates = jax.random.split(key)
    rates = jnp.linspace(5e-3, 0.0, UPDATES)

    def body(learner, inputs):
        batch, key_update, rate = inputs
        return algorithm.update(learner, batch, key_update, rate)

    learner = algorithm.init(key_init).replace(**begin)
    return jax.lax.scan(body, learner, (batches, jax.random.split(key_updates, UPDATES), rates))


def learn(batches: Batch, alpha: float = GREEDY) -> tuple[SacState, LearnerMetrics]:
    """The learner after all batches, and the metrics of every update."""
    return _learn(SAC, batches, jax.random.key(0), log_alpha=jnp.log(jnp.float32(alpha)))


def learn_with(algorithm: Learner, batches: Batch) -> Any:
    """The state of a learner after all batches."""
    return _learn(algorithm, batches, jax.random.key(0))[0]


@jax.jit
def value(learner: SacState, observation: jax.Array, action: jax.Array) -> jax.Array:
    """Both critics.  observation: (n, 2), action: (n, 1).  Returns (2, n)."""
    return SAC.value(learner.critic, observation, action)


@jax.jit
def mode(learner: LearnerState, observation: jax.Array) -> jax.Array:
    """Deterministic action of the averaged policy.  observation: (n, 2).  Returns (n,)."""
    return SAC.act(learner.averaged_policy, observation).mode()[:, 0]


def _random(seed: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Observations, next observations and actions, uniform in [-1, 1]."""
    uniform = jax.random.uniform(jax.random.key(seed), (*SHAPE, 5), minval=-1.0, maxval=1.0)
    return uniform[..., :2], uniform[..., 2:4], uniform[..., 4:]


def _unless(ended: jax.Array) -> jax.Array:
    return jnp.where(ended, 0.0, jnp.float32(GAMMA))


def constant_reward() -> Batch:
    """Reward 1 for ever: Q = 1 / (1 - gamma) = 10 everywhere."""
    observation, next_observation, action = _random(0)
    return Batch(observation, action, jnp.ones(SHAPE), jnp.full(SHAPE, GAMMA, jnp.float32), next_observation)


def constant_reward_in_windows(length: int, ends_by: str) -> Batch:
    """Reward 1, learned from windows of which some hold the end of an episode.

    Where episodes are ``truncated`` the value is still 1 / (1 - gamma).  Where they are ``terminated`` with probability
    p in each step it is 1 / (1 - gamma (1 - p)); p is 0.2.
    """
    observation, next_observation, action = _random(1)

    def along(leaf: jax.Array) -> jax.Array:
        return jnp.broadcast_to(leaf, (length, *leaf.shape))

    end = jax.random.bernoulli(jax.random.key(2), 0.2, (length, *SHAPE))
    window = Transition(
        observation=along(observation),
        action=along(action),
        outcome=None,
        terminated=end & (ends_by == "terminated"),
        truncated=end & (ends_by == "truncated"),
        next_observation=along(next_observation),
    )
    batch = functools.partial(replay_buffer.n_step_batch, discount=jnp.float32(GAMMA))
    return jax.jit(jax.vmap(batch, in_axes=(1, 1)))(window, jnp.ones((length, *SHAPE)))


def one_step_reward_by_observation() -> Batch:
    """Each step ends the episode: Q = reward = 2 x_0 - x_1, whatever the action."""
    observation, next_observation, action = _random(3)
    reward = observation @ jnp.array([2.0, -1.0])
    return Batch(observation, action, reward, jnp.zeros(SHAPE), next_observation)


def one_step_bandit(slope: float) -> Batch:
    """One step, reward -10 (a - best)^2 with best = 0.5 + slope x_0: the policy's mode must become that."""
    observation, next_observation, action = _random(4)
    best = 0.5 + slope * observation[..., 0]
    return Batch(observation, action, -10.0 * (action[..., 0] - best) ** 2, jnp.zeros(SHAPE), next_observation)


def two_steps() -> Batch:
    """x_0 = -1 leads to x_0 = 1 without reward; x_0 = 1 ends the episode with reward 1: Q is gamma, then 1."""
    observation, _, action = _random(5)
    second = observation[..., 0] > 0.0
    observation = observation.at[..., 0].set(jnp.where(second, 1.0, -1.0))
    next_observation = observation.at[..., 0].set(1.0)
    return Batch(observation, action, second.astype(jnp.float32), _unless(second), next_observation)


def delayed_choice() -> Batch:
    """The reward comes a step after the action that earned it: x_0 = -1, then x_0 = 1 with x_1 = the action before.

    In the second step the reward is x_1 and the episode ends, so in the first Q = gamma a and the best action is 1.
    """
    observation, _, action = _random(6)
    second = observation[..., 0] > 0.0
    observation = observation.at[..., 0].set(jnp.where(second, 1.0, -1.0))
    next_observation = jnp.concatenate([jnp.ones_like(action), action], axis=-1)
    reward = jnp.where(second, observation[..., 1], 0.0)
    return Batch(observation, action, reward, _unless(second), next_observation)


def endless_bandit() -> Batch:
    """The same reward, -10 (a - 0.5)^2, in every step of a problem without end.

    The soft optimum is exp(Q / alpha), here a Gaussian of variance alpha / 20 (cut at |a| = 1, five deviations away).
    Its entropy log(2 pi e alpha / 20) / 2 is the target -1 at alpha = 10 / (pi e^3).  The reward then costs alpha / 2
    on average, the entropy alpha more, so the value is -1.5 alpha / (1 - gamma).
    """
    return one_step_bandit(0.0).replace(discount=jnp.full(SHAPE, GAMMA, jnp.float32))


def grid() -> tuple[jax.Array, jax.Array]:
    """Observations (n, 2) and actions (n, 1) over the inner part of what is learned from."""
    x = jnp.linspace(-0.8, 0.8, 5)
    points = jnp.stack(jnp.meshgrid(x, x, x), axis=-1).reshape(-1, 3)
    return points[:, :2], points[:, 2:]
