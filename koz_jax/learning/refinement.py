"""Refinement: polish a trained policy by first-order gradients through the differentiable dynamics.

Soft Actor-Critic finds the maneuver from rewards alone, but its critic cannot resolve the last degree of pointing nor
the last Newton metre of effort.  The environment is differentiable, so the policy can then be improved by the exact
gradient of what a whole maneuver costs (an analytic policy gradient: back-propagation through time).  The paper's
reward has steps (settled or not, progress or not) that have no gradient; the cost here is a smooth stand-in.
"""

import functools
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optax.contrib
from flax import struct

from koz_jax import devices
from koz_jax.config.learners.refinement import RefineConfig
from koz_jax.config.training import TrainConfig
from koz_jax.control.policy import PolicyController
from koz_jax.control.shield.filter import under_shield
from koz_jax.learning.train_step import MAX_DRAWS, flight_errors
from koz_jax.sac.networks import Params
from koz_jax.task import rotations
from koz_jax.task.any_spacecraft import spread
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.environment import Reorientation
from koz_jax.task.observation_layout import ACTION_SIZE
from koz_jax.task.reward import Outcome
from koz_jax.task.scenario import SamplingRule
from koz_jax.task.state import EnvState, largest_rate

Tree = TypeVar("Tree")

# Maneuvers whose gradients in the weights are taken at once on a GPU; on a CPU, one after the other fits its cache.
_TOGETHER_ON_GPU = 256

# Share of the rate limit from which a rate costs something, and how fast that grows.
_RATE_KEPT = 0.95
_RATE_WIDTH = 0.02


class RefineState(struct.PyTreeNode):
    """Everything that refinement changes."""

    policy: Params
    optimizer: optax.OptState
    key: jax.Array  # () typed PRNG key
    iterations: jax.Array  # () int32, gradient steps done


def _optimizer(config: RefineConfig) -> optax.GradientTransformation:
    schedule = optax.cosine_decay_schedule(config.learning_rate, max(config.iterations, 1))
    take = optax.contrib.muon if config.optimizer == "muon" else optax.adam
    return optax.chain(optax.clip_by_global_norm(config.max_gradient_norm), take(schedule))


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


def effort_weight(env: Reorientation, config: RefineConfig) -> jax.Array:
    """Cost per step of the squared action at the urgency of an environment.  Returns ()."""
    return config.effort_weight * config.urgency_factor ** (1.0 - 2.0 * env.urgency)


def rate_cost(rate: jax.Array, limit: jax.Array) -> jax.Array:
    """Cost of a rate near its limit: small up to 0.9 of it, 1 at the limit, then linear.  rate, limit: () [rad/s]."""
    return jax.nn.softplus((rate / limit - _RATE_KEPT) / _RATE_WIDTH) / np.log1p(
        np.exp((1.0 - _RATE_KEPT) / _RATE_WIDTH)
    )


def step_cost(outcome: Outcome, env: Reorientation, config: RefineConfig) -> jax.Array:
    """Smooth cost of one step: pointing at several resolutions, effort, its change, and the zone.  Returns ()."""
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
    cost = pointing + effort_weight(env, config) * squared_action + config.zone_weight * env.reward.zone_height * zone
    if config.change_weight:
        cost = cost + config.change_weight * (outcome.torque_change / env.nominal_limits.scale) ** 2
    return cost


def maneuver_environment(config: TrainConfig) -> Reorientation:
    """Set up what whole maneuvers are flown in."""
    rule = SamplingRule(config.task.scenario.infeasible_zone, MAX_DRAWS, keep_angle=True)
    angles = (config.refine.min_angle_deg, config.refine.max_angle_deg)
    env = Reorientation.from_config(config.task, *angles, rule=rule, observed_zones=config.network.observed_zones)
    return env.replace(scaled=config.network.scaled)


class ManeuverCost(NamedTuple):
    """What a maneuver costs, and what its gradient in the weights is taken at."""

    mean: jax.Array  # () per step
    entered: jax.Array  # () bool, whether a zone was entered
    observed: jax.Array  # (steps, entries) what the policy saw


def fly_maneuver(
    controller: PolicyController,
    env: Reorientation,
    key: jax.Array,
    config: TrainConfig,
    reach: jax.Array | None = None,
    nudges: jax.Array | None = None,
) -> ManeuverCost:
    """Fly one random maneuver over the horizon; its cost is differentiable in the controller and in the nudges.

    reach: () largest norm of the gradient that passes back from step to step, None for any; nudges: (steps, 3) added
    to the actions.
    """
    env = under_shield(env.drawn(jax.random.fold_in(key, spread.PURPOSE)), config.shielding.in_force)
    truth, noise = flight_errors(env, key)

    # To fly a step again on the way back is cheaper than to store everything that its gradient needs.
    @functools.partial(jax.checkpoint, prevent_cse=False)
    def advance(state: EnvState, nudge: jax.Array) -> tuple[EnvState, tuple[jax.Array, jax.Array, jax.Array]]:
        state = state if reach is None else state.replace(body=_limit_gradient(state.body, reach))
        measured = state if noise is None else env.measure(state, noise)
        observed = env.observe(measured)
        stepped = env.step(state, controller.act(observed) + nudge, measured=measured, truth=truth)
        cost = step_cost(stepped.outcome, env, config.refine)
        largest = largest_rate(stepped.state, env.model)
        if largest is not None:
            rate = rotations.norm(stepped.state.body.omega_BN_B)
            cost = cost + config.refine.rate_weight * rate_cost(rate, largest)
        return stepped.state, (cost, stepped.outcome.zone_margin, observed)

    nudges = jnp.zeros((config.refine_steps, ACTION_SIZE)) if nudges is None else nudges
    _, (costs, margins, observed) = jax.lax.scan(advance, env.reset(key), nudges)
    entered = jnp.min(margins) < 0.0
    return ManeuverCost(jnp.mean(costs) * (env.model.dt / config.task.step_seconds), entered, observed)


@jax.custom_vjp
def _limit_gradient(body: RigidBodyState, limit: jax.Array) -> RigidBodyState:
    """Return the state as it is, but scale the gradient that comes back down to a norm; 0 where it is not finite."""
    return body


def _limit_gradient_forward(body: RigidBodyState, limit: jax.Array) -> tuple[RigidBodyState, jax.Array]:
    return body, limit


def _limit_gradient_backward(limit: jax.Array, gradient: RigidBodyState) -> tuple[RigidBodyState, jax.Array]:
    return _clipped(gradient, limit), jnp.zeros_like(limit)


_limit_gradient.defvjp(_limit_gradient_forward, _limit_gradient_backward)


def _clipped(gradient: Tree, limit: jax.Array | float) -> Tree:
    """A gradient scaled down to a norm; 0 where it is not finite."""
    size = optax.tree.norm(gradient)
    share = jnp.where(size < limit, 1.0, limit / jnp.where(size > 0.0, size, 1.0))
    return jax.tree.map(lambda leaf: jnp.where(jnp.isfinite(size), share * leaf, 0.0), gradient)


def _reach(config: RefineConfig, iteration: jax.Array) -> jax.Array | None:
    """How large a gradient passes back from step to step at an iteration.  Returns ()."""
    if config.state_gradient is None:
        return None
    first, last = config.state_gradient
    return first * (last / first) ** jnp.minimum(4.0 * iteration / max(config.iterations, 1), 1.0)


def _mean_gradient(
    config: TrainConfig, env: Reorientation, policy: Params, keys: jax.Array, reach: jax.Array | None
) -> tuple[jax.Array, Params]:
    """Mean over maneuvers of the cost and of its gradient."""

    def mean_cost(policy: Params) -> jax.Array:
        controller = PolicyController(policy, config.network)
        return jnp.mean(jax.vmap(lambda key: fly_maneuver(controller, env, key, config, reach).mean)(keys))

    return jax.value_and_grad(mean_cost)(policy)


def _clipped_gradient(
    config: TrainConfig, env: Reorientation, policy: Params, keys: jax.Array, reach: jax.Array | None
) -> tuple[jax.Array, Params]:
    """The same, each maneuver's gradient clipped by itself.

    First what each action is worth, for all maneuvers at once, then of one maneuver after the other how the weights
    change its actions: a sum over the steps as products of matrices, where the gradient of each maneuver along the
    steps would be as many copies of all weights, read and written at every step.
    """

    def action_slopes(key: jax.Array) -> tuple[ManeuverCost, jax.Array]:
        def flown(nudges: jax.Array) -> tuple[jax.Array, ManeuverCost]:
            cost = fly_maneuver(PolicyController(policy, config.network), env, key, config, reach, nudges)
            return cost.mean, cost

        nudges = jnp.zeros((config.refine_steps, ACTION_SIZE))
        (_, cost), slopes = jax.value_and_grad(flown, has_aux=True)(nudges)
        return cost, slopes

    def weight_gradient(maneuver: tuple[ManeuverCost, jax.Array]) -> Params:
        cost, slopes = maneuver
        _, pull = jax.vjp(lambda policy: PolicyController(policy, config.network).act(cost.observed), policy)
        say = jnp.where(cost.entered, config.refine.violator_weight, 1.0)
        return _clipped(pull(slopes)[0], say * config.refine.max_maneuver_gradient)

    costs, slopes = jax.vmap(action_slopes)(keys)
    together = _TOGETHER_ON_GPU if devices.on_gpu() else None
    gradients = jax.lax.map(weight_gradient, (costs, slopes), batch_size=together)
    return jnp.mean(costs.mean), jax.tree.map(lambda leaf: jnp.mean(leaf, axis=0), gradients)


@functools.partial(jax.jit, static_argnames="config", donate_argnames="state")
@devices.in_float32
def refine_chunk(config: TrainConfig, state: RefineState, iterations: jax.Array) -> tuple[RefineState, jax.Array]:
    """Take ``iterations`` gradient steps (traced).  Returns the new state and the mean cost ()."""
    env = maneuver_environment(config)

    def body(_: jax.Array, carry: tuple[RefineState, jax.Array]) -> tuple[RefineState, jax.Array]:
        state, total = carry
        key, key_cases = jax.random.split(state.key)
        keys, reach = jax.random.split(key_cases, config.refine.scenarios), _reach(config.refine, state.iterations)

        find = _clipped_gradient if config.refine.max_maneuver_gradient else _mean_gradient
        cost, gradient = find(config, env, state.policy, keys, reach)
        change, optimizer = _optimizer(config.refine).update(gradient, state.optimizer, state.policy)
        policy = optax.apply_updates(state.policy, change)
        return RefineState(policy, optimizer, key, state.iterations + 1), total + cost

    state, total = jax.lax.fori_loop(0, iterations, body, (state, jnp.zeros(())))
    return state, total / iterations
