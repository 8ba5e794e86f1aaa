"""Refinement: polish a trained policy by first-order gradients through the differentiable dynamics.

Soft Actor-Critic finds the maneuver from rewards alone, but its critic cannot resolve the last degree of pointing nor
the last Newton metre of effort.  The environment is differentiable, so the policy can then be improved by the exact
gradient of what a whole maneuver costs (an analytic policy gradient: back-propagation through time).  The paper's
reward has steps (settled or not, progress or not) that have no gradient; the cost here is a smooth stand-in.
"""

import functools

import jax
import jax.numpy as jnp
import optax
from flax import struct

from koz_jax.config.training import RefineConfig, TrainConfig
from koz_jax.control.policy import PolicyController
from koz_jax.control.shield.filter import under_shield
from koz_jax.learning.train_step import MAX_DRAWS
from koz_jax.sac.networks import Params
from koz_jax.task.environment import Reorientation
from koz_jax.task.reward import Outcome
from koz_jax.task.scenario import SamplingRule
from koz_jax.task.state import EnvState


class RefineState(struct.PyTreeNode):
    """Everything that refinement changes."""

    policy: Params
    optimizer: optax.OptState
    key: jax.Array  # () typed PRNG key
    iterations: jax.Array  # () int32, gradient steps done


def _optimizer(config: RefineConfig) -> optax.GradientTransformation:
    schedule = optax.cosine_decay_schedule(config.learning_rate, max(config.iterations, 1))
    return optax.chain(optax.clip_by_global_norm(config.max_gradient_norm), optax.adam(schedule))


def init(config: TrainConfig, policy: Params) -> RefineState:
    """Begin with a policy as it is."""
    return RefineState(
        policy=policy,
        optimizer=_optimizer(config.refine).init(policy),
        key=jax.random.fold_in(jax.random.key(config.seed), 1),
        iterations=jnp.zeros((), jnp.int32),
    )


def zone_cost(margin: jax.Array, decay: jax.Array, tightening: jax.Array) -> jax.Array:
    """The zone penalty of the paper per unit of beta, continued linearly inside so that it still points outwards.

    margin, tightening: () [rad]; decay: () [1 / rad].  Returns (), 1 at the tightened edge.
    """
    outside = margin - tightening
    return jnp.exp(-decay * jnp.maximum(outside, 0.0)) + decay * jnp.maximum(-outside, 0.0)


def step_cost(outcome: Outcome, env: Reorientation, config: RefineConfig) -> jax.Array:
    """Smooth cost of one step: pointing at several resolutions, effort, and the zone.  Returns ()."""
    phi = env.reward.angle_factor * outcome.angle
    pointing = sum(
        weight * jnp.tanh(phi / jnp.deg2rad(scale))
        for weight, scale in zip(config.pointing_weights, config.pointing_scales_deg, strict=True)
    )
    squared_action = (outcome.torque / env.nominal_limits.scale) ** 2
    zone = zone_cost(
        outcome.zone_margin,
        env.reward.zone_decay * config.zone_steepness,
        jnp.deg2rad(config.zone_tightening_deg),
    )
    return pointing + config.effort_weight * squared_action + config.zone_weight * env.reward.zone_height * zone


def maneuver_environment(config: TrainConfig) -> Reorientation:
    """Set up what whole maneuvers are flown in."""
    rule = SamplingRule(config.task.scenario.infeasible_zone, MAX_DRAWS, keep_angle=True)
    angles = (config.refine.min_angle_deg, config.refine.max_angle_deg)
    env = Reorientation.from_config(config.task, *angles, rule=rule, observed_zones=config.network.observed_zones)
    return under_shield(env, config.shielding.in_force)


def maneuver_cost(controller: PolicyController, env: Reorientation, key: jax.Array, config: TrainConfig) -> jax.Array:
    """Mean cost per step of one random maneuver over the horizon; differentiable in the controller.  Returns ()."""

    def advance(state: EnvState, _: None) -> tuple[EnvState, jax.Array]:
        stepped = env.step(state, controller.act(env.observe(state)))
        return stepped.state, step_cost(stepped.outcome, env, config.refine)

    _, costs = jax.lax.scan(advance, env.reset(key), None, length=config.refine_steps)
    return jnp.mean(costs)


@functools.partial(jax.jit, static_argnames="config", donate_argnames="state")
def refine_chunk(config: TrainConfig, state: RefineState, iterations: jax.Array) -> tuple[RefineState, jax.Array]:
    """Take ``iterations`` gradient steps (traced).  Returns the new state and the mean cost ()."""
    env = maneuver_environment(config)

    def mean_cost(policy: Params, keys: jax.Array) -> jax.Array:
        controller = PolicyController(policy, config.network)
        return jnp.mean(jax.vmap(lambda key: maneuver_cost(controller, env, key, config))(keys))

    def body(_: jax.Array, carry: tuple[RefineState, jax.Array]) -> tuple[RefineState, jax.Array]:
        state, total = carry
        key, key_cases = jax.random.split(state.key)
        cost, gradient = jax.value_and_grad(mean_cost)(
            state.policy, jax.random.split(key_cases, config.refine.scenarios)
        )
        change, optimizer = _optimizer(config.refine).update(gradient, state.optimizer)
        policy = optax.apply_updates(state.policy, change)
        return RefineState(policy, optimizer, key, state.iterations + 1), total + cost

    state, total = jax.lax.fori_loop(0, iterations, body, (state, jnp.zeros(())))
    return state, total / iterations
