"""Flying maneuvers: one case at a time, either only measured or with its whole history."""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax import env, keep_out, observation, reward, shield, uncertainty
from koz_jax.controllers.base import Controller, Memory
from koz_jax.env import EnvParams, EnvState
from koz_jax.reward import RewardTerms
from koz_jax.scenario import Scenario
from koz_jax.shield import Shield
from koz_jax.uncertainty import Uncertainty


class Conditions(struct.PyTreeNode):
    """Under what conditions a controller flies; None leaves a part out of the computation."""

    shield: Shield | None = None
    uncertainty: Uncertainty | None = None


NOMINAL = Conditions()


class CaseResult(struct.PyTreeNode):
    """What a maneuver is judged by (section 6 of the specification; Table 4 of the paper)."""

    initial_angle: jax.Array  # () [rad] full rotation angle at the start
    reward_terms: RewardTerms  # sum over the maneuver of each term
    settling_time: jax.Array  # () [s] time after which phi stays within the accuracy; nan if it does not
    control_effort: jax.Array  # () [N^2 m^2 s] integral of |tau|^2
    control_accuracy: jax.Array  # () [rad] phi at the end
    min_margin: jax.Array  # () [rad] smallest margin to any zone
    settled: jax.Array  # () bool
    violated: jax.Array  # () bool
    intervention_rate: jax.Array  # () share of the steps in which the shield changed the torque
    mean_torque_change: jax.Array  # () [N m] mean norm of that change over all steps
    deadlocked: jax.Array  # () bool, not settled and the shield changed the torque in the last step

    @property
    def reward(self) -> jax.Array:
        """Sum over the maneuver of the paper's own reward.  Returns ()."""
        return reward.total(self.reward_terms, reward.PAPER_WEIGHTS)

    @property
    def success(self) -> jax.Array:
        """Settled and never in a zone.  Returns () bool."""
        return self.settled & ~self.violated


class History(struct.PyTreeNode):
    """A maneuver step by step; leaves have a leading axis of steps + 1, the start first."""

    state: EnvState
    observation: jax.Array  # (steps + 1, 16)
    torque_B: jax.Array  # (steps + 1, 3) [N m] applied from this instant on; the last row repeats
    zone_margin: jax.Array  # (steps + 1,) [rad] to the nearest zone
    pointing_error: jax.Array  # (steps + 1,) [rad] phi


class _Flight(struct.PyTreeNode):
    """A maneuver under way."""

    state: EnvState
    memory: Memory
    key: jax.Array  # () typed PRNG key of the measurement noise


class _Command(struct.PyTreeNode):
    """What is asked of the actuators in a step, in units of the torque limit."""

    requested: jax.Array  # (3,) by the controller, within the box
    applied: jax.Array  # (3,) after the shield


class _Tally(struct.PyTreeNode):
    flight: _Flight
    reward_terms: RewardTerms
    control_effort: jax.Array
    min_margin: jax.Array
    last_unsettled: jax.Array  # () int32, last instant (in steps) at which phi was outside; -1 if none
    interventions: jax.Array  # () steps in which the shield changed the torque
    torque_change: jax.Array  # () [N m] sum of the norms of that change
    intervened: jax.Array  # () bool, in the last step


def _margin(state: EnvState, params: EnvParams) -> jax.Array:
    return keep_out.smallest_margin(env.boresight_N(state.body, params.spacecraft), state.scenario.zones)


def _margin_between(state: EnvState, torque_B: jax.Array, params: EnvParams, substeps: int) -> jax.Array:
    """Smallest margin at ``substeps - 1`` instants inside the step that starts in ``state``.  Returns () [rad]."""
    margins = [jnp.float32(jnp.inf)]
    for i in range(1, substeps):
        body = env.push(state.body, torque_B, params, params.dt * (i / substeps))
        margins.append(_margin(state.replace(body=body), params))
    return jnp.min(jnp.stack(margins))


def _take_off(
    controller: Controller, scenario: Scenario, params: EnvParams, conditions: Conditions, key: jax.Array
) -> tuple[_Flight, EnvParams]:
    """The flight at its start, and the truth that it meets: what is uncertain is drawn for the whole maneuver.

    A start that the shield does not call safe is slowed down until it is.
    """
    key_controller, key_truth, key_noise = jax.random.split(key, 3)
    state = env.reset(shield.safe_start(conditions.shield, scenario, params))
    truth = params
    if conditions.uncertainty is not None:
        truth = uncertainty.draw_truth(conditions.uncertainty, params, key_truth)
    return _Flight(state, controller.begin(state, params, key_controller), key_noise), truth


def _command(
    controller: Controller, flight: _Flight, params: EnvParams, conditions: Conditions
) -> tuple[_Command, Memory]:
    """What the controller asks for, and what the shield makes of it; both know the state as it is measured."""
    measured = flight.state
    if conditions.uncertainty is not None:
        key = jax.random.fold_in(flight.key, flight.state.steps)
        measured = uncertainty.measure(conditions.uncertainty, flight.state, key)
    action, memory = controller.decide(measured, params, flight.memory)
    applied = shield.guard(conditions.shield, measured, action, params)
    return _Command(jnp.clip(action, -1.0, 1.0), applied), memory


def run_case(
    controller: Controller,
    scenario: Scenario,
    params: EnvParams,
    steps: int,
    substeps: int = 1,
    conditions: Conditions = NOMINAL,
    key: jax.Array | None = None,
) -> CaseResult:
    """Fly one maneuver and judge it.

    substeps: the zone is checked at so many instants per step; 1 checks at the steps only.
    key: () typed PRNG key of what is random in the controller and in the conditions.
    """
    key = jax.random.key(0) if key is None else key
    flight, truth = _take_off(controller, scenario, params, conditions, key)
    start = flight.state

    def unsettled_at(state: EnvState, before: jax.Array) -> jax.Array:
        return jnp.where(reward.is_settled(state.angle, params.reward), before, state.steps)

    def advance(tally: _Tally, _: None) -> tuple[_Tally, None]:
        before = tally.flight.state
        command, memory = _command(controller, tally.flight, params, conditions)
        state, outcome = env.step(before, command.applied, truth)
        terms = reward.terms(outcome, params.reward, params.spacecraft.torque_limit)
        margin = outcome.zone_margin
        if substeps > 1:
            margin = jnp.minimum(margin, _margin_between(before, state.torque_B, truth, substeps))
        intervened = jnp.any(command.applied != command.requested)
        change = params.spacecraft.torque_limit * jnp.linalg.norm(command.applied - command.requested)
        return _Tally(
            flight=_Flight(state, memory, tally.flight.key),
            reward_terms=jax.tree.map(jnp.add, tally.reward_terms, terms),
            control_effort=tally.control_effort + outcome.torque**2 * params.dt,
            min_margin=jnp.minimum(tally.min_margin, margin),
            last_unsettled=unsettled_at(state, tally.last_unsettled),
            interventions=tally.interventions + intervened,
            torque_change=tally.torque_change + change,
            intervened=intervened,
        ), None

    tally = _Tally(
        flight=flight,
        reward_terms=jax.tree.map(lambda _: jnp.zeros(()), reward.PAPER_WEIGHTS),
        control_effort=jnp.zeros(()),
        min_margin=_margin(start, params),
        last_unsettled=unsettled_at(start, jnp.int32(-1)),
        interventions=jnp.int32(0),
        torque_change=jnp.zeros(()),
        intervened=jnp.array(False),
    )
    end, _ = jax.lax.scan(advance, tally, None, length=steps)
    settled = end.last_unsettled < steps
    return CaseResult(
        initial_angle=start.angle,
        reward_terms=end.reward_terms,
        settling_time=jnp.where(settled, (end.last_unsettled + 1) * params.dt, jnp.nan),
        control_effort=end.control_effort,
        control_accuracy=reward.pointing_error(end.flight.state.angle, params.reward),
        min_margin=end.min_margin,
        settled=settled,
        violated=end.min_margin <= 0.0,
        intervention_rate=end.interventions / steps,
        mean_torque_change=end.torque_change / steps,
        deadlocked=~settled & end.intervened,
    )


def fly(
    controller: Controller,
    scenario: Scenario,
    params: EnvParams,
    steps: int,
    conditions: Conditions = NOMINAL,
    key: jax.Array | None = None,
) -> History:
    """Fly one maneuver, the same as ``run_case`` does with the same key, and keep everything."""
    key = jax.random.key(0) if key is None else key
    start, truth = _take_off(controller, scenario, params, conditions, key)

    def advance(flight: _Flight, _: None) -> tuple[_Flight, EnvState]:
        command, memory = _command(controller, flight, params, conditions)
        state = env.step(flight.state, command.applied, truth)[0]
        return _Flight(state, memory, flight.key), flight.state

    end, before = jax.lax.scan(advance, start, None, length=steps)
    states = jax.tree.map(lambda rows, last: jnp.concatenate([rows, last[None]]), before, end.state)
    # A state holds the torque that led to it, so the torque applied from an instant on is that of the next state.
    applied = jnp.concatenate([states.torque_B[1:], states.torque_B[-1:]])
    return History(
        state=states,
        observation=jax.vmap(observation.observe, in_axes=(0, None))(states, params),
        torque_B=applied,
        zone_margin=jax.vmap(_margin, in_axes=(0, None))(states, params),
        pointing_error=reward.pointing_error(states.angle, params.reward),
    )
