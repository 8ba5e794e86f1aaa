"""The training state and its one jitted transition: collect, sample, reward under the curriculum, learn."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax import curriculum, encoding, env, observation, reward, scenario, shield, task, watch
from koz_jax.config import TrainConfig
from koz_jax.curriculum import Difficulty
from koz_jax.env import EnvParams, EnvState
from koz_jax.layout import ACTION_SIZE
from koz_jax.reward import Outcome, RewardTerms
from koz_jax.sac import learner as sac_learner
from koz_jax.sac import replay
from koz_jax.sac.learner import LearnerMetrics, LearnerState, Sac
from koz_jax.sac.losses import Batch
from koz_jax.sac.replay import ReplayBuffer, Transition
from koz_jax.shield import Shield

# Training draws scenarios all the time, also at angles where no zone fits; it soon takes what it can get.
MAX_DRAWS = 8

# Episodes start in so many groups, spread over an episode, so that the buffer holds all parts of a maneuver.
_START_GROUPS = 16


class TrainState(struct.PyTreeNode):
    """Everything that a resume needs."""

    learner: LearnerState
    buffer: ReplayBuffer
    env_states: EnvState  # leading axis: environments
    key: jax.Array  # () typed PRNG key
    updates: jax.Array  # () int32, gradient updates done


class TrainMetrics(struct.PyTreeNode):
    """Means over a chunk of training."""

    learner: LearnerMetrics
    reward: RewardTerms  # per environment step, unweighted
    fault: jax.Array  # () int32, the first term that was not finite (see ``watch``)


def make_sac(config: TrainConfig) -> Sac:
    """The learner's static settings."""
    return Sac(
        hidden_sizes=config.network.hidden_sizes,
        encoding=encoding.views(config.network),
        observation_size=observation.size(config.network.observed_zones),
        action_size=ACTION_SIZE,
        target_entropy=config.sac.target_entropy,
        soft_update=config.sac.soft_update,
        policy_average=config.sac.policy_average,
        initial_entropy_coefficient=config.sac.initial_entropy_coefficient,
    )


def _reset_envs(config: TrainConfig, params: EnvParams, at: Difficulty, key: jax.Array) -> EnvState:
    """Fresh maneuvers in all environments, drawn at the present difficulty."""
    ranges = task.scenario_ranges(config.task.scenario, 0.0, 0.0).replace(
        min_angle=at.min_angle, max_angle=at.max_angle, angle_bias=at.angle_bias
    )

    guard = make_shield(config, params)

    def fresh(key_case: jax.Array) -> EnvState:
        drawn = scenario.sample(
            key_case,
            ranges,
            params.spacecraft.boresight_B,
            config.task.scenario.infeasible_zone,
            max_draws=MAX_DRAWS,
            keep_angle=True,
        )
        return env.reset(shield.safe_start(guard, drawn, params))

    return jax.vmap(fresh)(jax.random.split(key, config.num_envs))


def make_shield(config: TrainConfig, params: EnvParams) -> Shield | None:
    """The shield to train under, if there is one."""
    made = config.shielding.in_force
    return shield.for_spacecraft(made, params.spacecraft, params.dt) if made else None


def _observer(config: TrainConfig, params: EnvParams) -> Callable[[EnvState], jax.Array]:
    """Observations (environments, entries) of all environments."""
    return jax.vmap(lambda state: observation.observe(state, params, config.network.observed_zones))


def _advance(
    config: TrainConfig, params: EnvParams, states: EnvState, action: jax.Array, at: Difficulty, key: jax.Array
) -> tuple[EnvState, Transition]:
    """One step of all environments; those at the end of their episode start a new scenario."""
    observe = _observer(config, params)
    guard = make_shield(config, params)

    def step(state: EnvState, action: jax.Array) -> tuple[EnvState, Outcome]:
        applied = shield.guard(guard, state, action, params)
        next_state, outcome = env.step(state, applied, params)
        return next_state, outcome.replace(intervention=jnp.linalg.norm(applied - jnp.clip(action, -1.0, 1.0)))

    next_states, outcome = jax.vmap(step)(states, action)
    truncated = next_states.steps >= config.training_episode_steps
    transition = Transition(
        observation=observe(states),
        action=action,
        outcome=outcome,
        terminated=jnp.zeros_like(truncated),
        truncated=truncated,
        next_observation=observe(next_states),
    )

    def restart() -> EnvState:
        return env.choose(truncated, _reset_envs(config, params, at, key), next_states)

    return jax.lax.cond(jnp.any(truncated), restart, lambda: next_states), transition


@functools.partial(jax.jit, static_argnames="config")
def init(config: TrainConfig, key: jax.Array) -> TrainState:
    """Fresh networks, and a buffer filled with ``prefill_steps`` of random actions."""
    params = task.env_params(config.task)
    key_learner, key_envs, key_fill, key = jax.random.split(key, 4)
    at = curriculum.difficulty(config.curriculum, jnp.zeros((), jnp.int32))
    states = _reset_envs(config, params, at, key_envs)
    group = jnp.arange(config.num_envs) * _START_GROUPS // config.num_envs
    head_start = group * config.training_episode_steps // _START_GROUPS

    def random_step(states: EnvState, key_step: jax.Array) -> tuple[EnvState, Transition]:
        key_action, key_reset = jax.random.split(key_step)
        action = jax.random.uniform(key_action, (config.num_envs, ACTION_SIZE), minval=-1.0, maxval=1.0)
        return _advance(config, params, states, action, at, key_reset)

    example = jax.eval_shape(random_step, states, key_fill)[1]
    buffer = replay.init(example, config.buffer_steps)

    def fill(
        carry: tuple[EnvState, ReplayBuffer], row: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[EnvState, ReplayBuffer], None]:
        states, buffer = carry
        number, key_step = row
        states, transition = random_step(states, key_step)
        # After the first step, which the environment knows by its number.
        states = states.replace(steps=states.steps + jnp.where(number == 0, head_start, 0))
        return (states, replay.insert(buffer, transition)), None

    fill_keys = jax.random.split(key_fill, config.prefill_steps)
    (states, buffer), _ = jax.lax.scan(fill, (states, buffer), (jnp.arange(config.prefill_steps), fill_keys))
    return TrainState(
        learner=sac_learner.init(make_sac(config), key_learner),
        buffer=buffer,
        env_states=states,
        key=key,
        updates=jnp.zeros((), jnp.int32),
    )


def _rewarded_batch(
    config: TrainConfig, params: EnvParams, buffer: ReplayBuffer, at: Difficulty, key: jax.Array
) -> Batch:
    """Draw transitions and reward them as the curriculum stands now.  Leaves: (updates_per_step * batch, ...)."""
    count = config.updates_per_step * config.sac.batch_size
    windows = replay.sample_windows(buffer, key, count, config.sac.n_step)
    reward_params = curriculum.reward_params(at, params.reward)
    terms = reward.terms(windows.outcome, reward_params, params.spacecraft.torque_limit)
    weights = curriculum.reward_weights(at).replace(intervention=config.shielding.intervention_cost)
    rewards = config.sac.reward_scale * reward.total(terms, weights)
    return replay.n_step_batch(windows, rewards, at.discount)


def train_step(config: TrainConfig, params: EnvParams, state: TrainState) -> tuple[TrainState, TrainMetrics]:
    """One step of all environments, then ``updates_per_step`` gradient updates."""
    sac = make_sac(config)
    at = curriculum.difficulty(config.curriculum, state.updates)
    key, key_action, key_reset, key_batch, key_updates = jax.random.split(state.key, 5)

    observed = _observer(config, params)(state.env_states)
    action, _ = sac.act(state.learner.policy, observed).sample(key_action)
    env_states, transition = _advance(config, params, state.env_states, action, at, key_reset)
    buffer = replay.insert(state.buffer, transition)

    drawn = _rewarded_batch(config, params, buffer, at, key_batch)
    batches = jax.tree.map(lambda leaf: leaf.reshape(config.updates_per_step, -1, *leaf.shape[1:]), drawn)

    def learn(learner: LearnerState, inputs: tuple[Batch, jax.Array]) -> tuple[LearnerState, LearnerMetrics]:
        batch, key_update = inputs
        return sac_learner.update(sac, learner, batch, key_update, at.learning_rate)

    keys = jax.random.split(key_updates, config.updates_per_step)
    learner, learner_metrics = jax.lax.scan(learn, state.learner, (batches, keys))
    terms = reward.terms(transition.outcome, params.reward, params.spacecraft.torque_limit)
    networks = (state.learner.policy, state.learner.critic, state.learner.log_alpha)
    fault = watch.first_fault(watch.Watched(networks, observed, terms, drawn.reward, learner_metrics))
    state = TrainState(learner, buffer, env_states, key, state.updates + config.updates_per_step)
    learned, rewarded = jax.tree.map(jnp.mean, (learner_metrics, terms))
    return state, TrainMetrics(learned, rewarded, fault)


@functools.partial(jax.jit, static_argnames="config", donate_argnames="state")
def train_chunk(config: TrainConfig, state: TrainState, steps: jax.Array) -> tuple[TrainState, TrainMetrics]:
    """Run ``steps`` training steps (traced: chunks of any length share one compilation) and average their metrics."""
    params = task.env_params(config.task)

    def body(_: jax.Array, carry: tuple[TrainState, TrainMetrics]) -> tuple[TrainState, TrainMetrics]:
        state, sums = carry
        state, metrics = train_step(config, params, state)
        first = jnp.where(sums.fault == watch.SOUND, metrics.fault, sums.fault)
        return state, jax.tree.map(jnp.add, sums, metrics).replace(fault=first)

    shapes = jax.eval_shape(lambda s: train_step(config, params, s)[1], state)
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    zeros = zeros.replace(fault=jnp.int32(watch.SOUND))
    state, sums = jax.lax.fori_loop(0, steps, body, (state, zeros))
    return state, jax.tree.map(lambda total: total / steps, sums).replace(fault=sums.fault)
