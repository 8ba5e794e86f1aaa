"""The training state and its one jitted transition: collect, sample, reward under the curriculum, learn."""

import functools

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax import devices
from koz_jax.config.training import TrainConfig
from koz_jax.control.shield.filter import under_shield
from koz_jax.learning import curriculum, finite_checks, learners
from koz_jax.learning.curriculum import Difficulty
from koz_jax.sac import replay_buffer
from koz_jax.sac.actor_critic import LearnerMetrics, LearnerState
from koz_jax.sac.losses import Batch
from koz_jax.sac.replay_buffer import ReplayBuffer, Transition
from koz_jax.task import reward
from koz_jax.task.any_spacecraft import spread, units
from koz_jax.task.environment import Reorientation
from koz_jax.task.observation_layout import ACTION_SIZE
from koz_jax.task.reward import RewardTerms
from koz_jax.task.scenario import SamplingRule
from koz_jax.task.state import EnvState, Truth

# Training draws scenarios all the time, also at angles where no zone fits; it soon takes what it can get.
MAX_DRAWS = 8

# Episodes start in so many groups, spread over an episode, so that the buffer holds all parts of a maneuver.
_START_GROUPS = 16

# Separates the keys of what an episode meets from those of what else is drawn for it.
_ERRORS = 0x455252


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
    fault: jax.Array  # () int32, the first term that was not finite (see ``finite_checks``)


def training_environment(config: TrainConfig) -> Reorientation:
    """Set up what is trained in; the curriculum sets the deviations, see ``at_difficulty``."""
    rule = SamplingRule(config.task.scenario.infeasible_zone, MAX_DRAWS, keep_angle=True)
    env = Reorientation.from_config(config.task, rule=rule, observed_zones=config.network.observed_zones)
    env = env.replace(episode_steps=config.training_episode_steps, scaled=config.network.scaled)
    if env.spread is not None:
        # What a step is worth must be the same for all: the time step is not spread here, only in refinement.
        own = env.model.dt / units.of(env.model).time
        env = env.replace(spread=env.spread.replace(step_shares=jnp.stack([own, own])))
    return env


def at_difficulty(env: Reorientation, at: Difficulty) -> Reorientation:
    """Draw scenarios as the curriculum says."""
    ranges = env.ranges.replace(min_angle=at.min_angle, max_angle=at.max_angle, angle_bias=at.angle_bias)
    return env.replace(ranges=ranges)


def _head_starts(config: TrainConfig) -> jax.Array:
    """Steps by which environments are ahead in their first episode.  Returns (num_envs,) int32."""
    group = jnp.arange(config.num_envs) * _START_GROUPS // config.num_envs
    return group * config.training_episode_steps // _START_GROUPS


class Episodes(struct.PyTreeNode):
    """What is drawn for the episode that each environment is in."""

    env: Reorientation  # a stack, or one where nothing is drawn for them
    truth: Truth | None  # leaves (num_envs, ...); None where the model flies
    noise: jax.Array | None  # (num_envs,) typed PRNG keys of what is measured; None where that is exact

    def measure(self, states: EnvState) -> EnvState:
        """What sensors make of the states, leaves (num_envs, ...)."""
        return states if self.noise is None else self.env.map(Reorientation.measure, states, self.noise)


def episodes_at(config: TrainConfig, env: Reorientation, step: jax.Array) -> Episodes:
    """The environments as they are in the episode that each is in.

    step: () int32, steps of all environments since the start of the run, the random ones included.
    """
    if env.spread is None and env.uncertainty is None:
        return Episodes(under_shield(env, config.shielding.in_force), None, None)
    episodes = (step + _head_starts(config)) // config.training_episode_steps
    base = jax.random.fold_in(jax.random.key(config.seed), spread.PURPOSE)

    def drawn(number: jax.Array, episode: jax.Array) -> Episodes:
        key = jax.random.fold_in(jax.random.fold_in(base, number), episode)
        own = under_shield(env.drawn(key), config.shielding.in_force)
        return Episodes(own, *flight_errors(own, key))

    return jax.vmap(drawn)(jnp.arange(config.num_envs), episodes)


def flight_errors(env: Reorientation, key: jax.Array) -> tuple[Truth | None, jax.Array | None]:
    """What an environment meets in one maneuver: the truth, and the key of its noise; None where it has no errors.

    key: () typed PRNG key of the maneuver.
    """
    if env.uncertainty is None:
        return None, None
    key_truth, key_noise = jax.random.split(jax.random.fold_in(key, _ERRORS))
    return env.sample_truth(key_truth), key_noise


def _advance(
    config: TrainConfig, at: Episodes, states: EnvState, observed: jax.Array, action: jax.Array, key: jax.Array
) -> tuple[EnvState, Transition]:
    """One step of all environments; those at the end of their episode start a new scenario."""
    met = {"measured": at.measure(states), "truth": at.truth, "noise": at.noise}
    stepped = at.env.step_autoreset(states, action, lambda: jax.random.split(key, config.num_envs), **met)
    return stepped.state, Transition(
        observation=observed,
        action=action,
        outcome=stepped.outcome,
        terminated=stepped.terminated,
        truncated=stepped.truncated,
        next_observation=stepped.final_observation,
    )


@functools.partial(jax.jit, static_argnames="config")
@devices.in_float32
def init(config: TrainConfig, key: jax.Array) -> TrainState:
    """Fresh networks, and a buffer filled with ``prefill_steps`` of random actions."""
    key_learner, key_envs, key_fill, key = jax.random.split(key, 4)
    at = curriculum.difficulty(config.curriculum, jnp.zeros((), jnp.int32))
    env = at_difficulty(training_environment(config), at)
    states = jax.vmap(env.reset)(jax.random.split(key_envs, config.num_envs))
    head_start = _head_starts(config)

    @jax.jit
    def random_step(states: EnvState, number: jax.Array, key_step: jax.Array) -> tuple[EnvState, Transition]:
        key_action, key_reset = jax.random.split(key_step)
        action = jax.random.uniform(key_action, (config.num_envs, ACTION_SIZE), minval=-1.0, maxval=1.0)
        at = episodes_at(config, env, number)
        return _advance(config, at, states, at.env.observe_each(at.measure(states)), action, key_reset)

    example = jax.eval_shape(random_step, states, jnp.int32(0), key_fill)[1]
    buffer = replay_buffer.init(example, config.buffer_steps)

    def fill(
        carry: tuple[EnvState, ReplayBuffer], row: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[EnvState, ReplayBuffer], None]:
        states, buffer = carry
        number, key_step = row
        states, transition = random_step(states, number, key_step)
        # After the first step, which the environment knows by its number.
        states = states.replace(steps=states.steps + jnp.where(number == 0, head_start, 0))
        return (states, replay_buffer.insert(buffer, transition)), None

    fill_keys = jax.random.split(key_fill, config.prefill_steps)
    (states, buffer), _ = jax.lax.scan(fill, (states, buffer), (jnp.arange(config.prefill_steps), fill_keys))
    return TrainState(
        learner=learners.make(config).init(key_learner),
        buffer=buffer,
        env_states=states,
        key=key,
        updates=jnp.zeros((), jnp.int32),
    )


def _rewarded_batch(
    config: TrainConfig, env: Reorientation, buffer: ReplayBuffer, at: Difficulty, key: jax.Array
) -> Batch:
    """Draw transitions and reward them as the curriculum stands now.  Leaves: (updates_per_step * batch, ...)."""
    count = config.updates_per_step * config.sac.batch_size
    priority = learners.priority(config, buffer.rows.outcome, at.phase)
    windows = replay_buffer.sample_windows(buffer, key, count, config.sac.n_step, priority)
    terms = reward.terms(windows.outcome, curriculum.reward_params(at, env.reward), env.nominal_limits)
    weights = curriculum.reward_weights(at).replace(intervention=config.shielding.intervention_cost)
    rewards = config.sac.reward_scale * reward.total(terms, weights)
    return replay_buffer.n_step_batch(windows, rewards, at.discount)


def train_step(config: TrainConfig, env: Reorientation, state: TrainState) -> tuple[TrainState, TrainMetrics]:
    """One step of all environments, then ``updates_per_step`` gradient updates."""
    algorithm = learners.make(config)
    at = curriculum.difficulty(config.curriculum, state.updates)
    key, key_action, key_reset, key_batch, key_updates = jax.random.split(state.key, 5)

    env = at_difficulty(env, at)
    step = config.prefill_steps + state.updates // config.updates_per_step
    episodes = episodes_at(config, env, step)
    observed = episodes.env.observe_each(episodes.measure(state.env_states))
    action = algorithm.explore(state.learner, observed, key_action)
    env_states, transition = _advance(config, episodes, state.env_states, observed, action, key_reset)
    buffer = replay_buffer.insert(state.buffer, transition)

    drawn = _rewarded_batch(config, env, buffer, at, key_batch)
    batches = jax.tree.map(lambda leaf: leaf.reshape(config.updates_per_step, -1, *leaf.shape[1:]), drawn)

    def learn(learner: LearnerState, inputs: tuple[Batch, jax.Array]) -> tuple[LearnerState, LearnerMetrics]:
        batch, key_update = inputs
        return algorithm.update(learner, batch, key_update, at.learning_rate)

    keys = jax.random.split(key_updates, config.updates_per_step)
    learner, learner_metrics = jax.lax.scan(learn, state.learner, (batches, keys))
    terms = reward.terms(transition.outcome, env.reward, env.nominal_limits)
    trained = state.learner.trained
    fault = finite_checks.first_fault(finite_checks.Watched(trained, observed, terms, drawn.reward, learner_metrics))
    state = TrainState(learner, buffer, env_states, key, state.updates + config.updates_per_step)
    learned, rewarded = jax.tree.map(jnp.mean, (learner_metrics, terms))
    return state, TrainMetrics(learned, rewarded, fault)


@functools.partial(jax.jit, static_argnames="config", donate_argnames="state")
@devices.in_float32
def train_chunk(config: TrainConfig, state: TrainState, steps: jax.Array) -> tuple[TrainState, TrainMetrics]:
    """Run ``steps`` training steps (traced: chunks of any length share one compilation) and average their metrics."""
    # A program within the program: traced once for its shapes and for the loop.
    step = jax.jit(functools.partial(train_step, config, training_environment(config)))

    def body(_: jax.Array, carry: tuple[TrainState, TrainMetrics]) -> tuple[TrainState, TrainMetrics]:
        state, sums = carry
        state, metrics = step(state)
        first = jnp.where(sums.fault == finite_checks.NO_FAULT, metrics.fault, sums.fault)
        return state, jax.tree.map(jnp.add, sums, metrics).replace(fault=first)

    shapes = jax.eval_shape(lambda s: step(s)[1], state)
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    zeros = zeros.replace(fault=jnp.int32(finite_checks.NO_FAULT))
    state, sums = jax.lax.fori_loop(0, steps, body, (state, zeros))
    return state, jax.tree.map(lambda total: total / steps, sums).replace(fault=sums.fault)
