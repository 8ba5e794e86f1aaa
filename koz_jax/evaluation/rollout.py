"""Flying maneuvers: one case at a time, either only measured or with its whole history."""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.control.base import Controller, Memory
from koz_jax.task import reward, rotations
from koz_jax.task.actuators import ActuatorState
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.environment import Reorientation
from koz_jax.task.reward import RewardTerms
from koz_jax.task.scenario import Scenario
from koz_jax.task.state import EnvState, Step, Truth, attitude_error, propagate


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
    unsafe_start: jax.Array  # () bool, in a zone at the start, or in a state from which the shield promises nothing
    infeasible_steps: jax.Array  # () int32 steps in which the filter found no torque that keeps what it guarantees
    peak_rate: jax.Array  # () [rad/s] largest norm of the body rate
    torque_variation: jax.Array  # () [N m] sum over steps and axes of how much the torque changes
    unrest: jax.Array  # () mean squared action over the last fifth of the maneuver

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
    attitude_error: jax.Array  # (steps + 1, 4) q_e
    torque_B: jax.Array  # (steps + 1, 3) [N m] applied from this instant on; the last row repeats
    zone_margin: jax.Array  # (steps + 1,) [rad] to the nearest zone
    pointing_error: jax.Array  # (steps + 1,) [rad] phi


class _Flight(struct.PyTreeNode):
    """A maneuver under way."""

    state: EnvState
    memory: Memory
    truth: Truth  # that is met: what is uncertain is drawn for the whole maneuver
    key: jax.Array  # () typed PRNG key of the measurement noise


class _Tally(struct.PyTreeNode):
    flight: _Flight
    reward_terms: RewardTerms
    control_effort: jax.Array
    min_margin: jax.Array
    last_unsettled: jax.Array  # () int32, last instant (in steps) at which phi was outside; -1 if none
    interventions: jax.Array  # () steps in which the shield changed the torque
    torque_change: jax.Array  # () [N m] sum of the norms of that change
    intervened: jax.Array  # () bool, in the last step
    infeasible_steps: jax.Array
    peak_rate: jax.Array
    torque_variation: jax.Array
    unrest: jax.Array


def _take_off(env: Reorientation, controller: Controller, drawn: Scenario, key: jax.Array | None) -> _Flight:
    key_controller, key_truth, key_noise = _split(jax.random.key(0) if key is None else key)
    state = env.reset(drawn)
    memory = controller.begin(state, env.model, key_controller)
    return _Flight(state, memory, env.sample_truth(key_truth), key_noise)


def _split(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Keys of what is random in the controller, in the truth, and in what is measured."""
    key_controller, key_truth, key_noise = jax.random.split(key, 3)
    return key_controller, key_truth, key_noise


def _step(env: Reorientation, controller: Controller, flight: _Flight) -> tuple[_Flight, Step]:
    """Fly one step; the controller and the shield know the state as it is measured."""
    measured = env.measure(flight.state, flight.key)
    action, memory = controller.decide(measured, env.model, flight.memory)
    stepped = env.step(flight.state, action, measured=measured, truth=flight.truth)
    return flight.replace(state=stepped.state, memory=memory), stepped


def _smallest_margin(env: Reorientation, before: _Flight, stepped: Step, substeps: int) -> jax.Array:
    """Smallest margin of a step: at its end, and at ``substeps - 1`` instants inside it.  Returns () [rad]."""
    margins = [stepped.outcome.zone_margin]
    held_B = env.model.actuators.stored_momentum(before.state.actuators)
    for i in range(1, substeps):
        seconds = env.model.dt * (i / substeps)
        body = propagate(before.state.body, stepped.state.torque_B, before.truth, seconds, held_B)
        margins.append(env.margin(before.state.replace(body=body, scenario=before.state.scenario.after(seconds))))
    return jnp.min(jnp.stack(margins))


def _last_unsettled(env: Reorientation, state: EnvState, before: jax.Array) -> jax.Array:
    """Last instant at which phi was outside, given that before this state.  Returns () int32."""
    return jnp.where(reward.is_settled(state.angle, env.reward), before, state.steps)


def _first_tally(env: Reorientation, start: _Flight) -> _Tally:
    """What is known at the start."""
    return _Tally(
        flight=start,
        reward_terms=jax.tree.map(lambda _: jnp.zeros(()), reward.PAPER_WEIGHTS),
        control_effort=jnp.zeros(()),
        min_margin=env.margin(start.state),
        last_unsettled=_last_unsettled(env, start.state, jnp.int32(-1)),
        interventions=jnp.int32(0),
        torque_change=jnp.zeros(()),
        intervened=jnp.array(False),
        infeasible_steps=jnp.int32(0),
        peak_rate=rotations.norm(start.state.body.omega_BN_B),
        torque_variation=jnp.zeros(()),
        unrest=jnp.zeros(()),
    )


def run_case(
    env: Reorientation, controller: Controller, drawn: Scenario, substeps: int = 1, key: jax.Array | None = None
) -> CaseResult:
    """Fly one maneuver and judge it.

    Args:
        env: what is flown, for its ``episode_steps``.
        controller: who flies.
        drawn: the maneuver.
        substeps: the zone is checked at so many instants per step; 1 checks at the steps only.
        key: () typed PRNG key of what is random in the controller and in the truth.
    """
    start = _take_off(env, controller, drawn, key)

    def advance(tally: _Tally, _: None) -> tuple[_Tally, None]:
        return _add_step(env, controller, substeps, tally), None

    end, _ = jax.lax.scan(advance, _first_tally(env, start), None, length=env.episode_steps)
    return _judge(env, start.state, end)


def fly_and_judge(
    env: Reorientation, controller: Controller, drawn: Scenario, substeps: int = 1, key: jax.Array | None = None
) -> tuple[History, CaseResult]:
    """Fly one maneuver as ``run_case`` does, judge it, and keep everything."""
    start = _take_off(env, controller, drawn, key)

    def advance(tally: _Tally, _: None) -> tuple[_Tally, EnvState]:
        return _add_step(env, controller, substeps, tally), tally.flight.state

    end, before = jax.lax.scan(advance, _first_tally(env, start), None, length=env.episode_steps)
    return _history(env, before, end.flight.state), _judge(env, start.state, end)


def fly(env: Reorientation, controller: Controller, drawn: Scenario, key: jax.Array | None = None) -> History:
    """Fly one maneuver as ``run_case`` does, and keep everything."""
    return fly_and_judge(env, controller, drawn, key=key)[0]


def _add_step(env: Reorientation, controller: Controller, substeps: int, tally: _Tally) -> _Tally:
    """Fly one more step, and count it."""
    flight, stepped = _step(env, controller, tally.flight)
    margin = _smallest_margin(env, tally.flight, stepped, substeps)
    return _Tally(
        flight=flight,
        reward_terms=jax.tree.map(jnp.add, tally.reward_terms, stepped.terms),
        control_effort=tally.control_effort + stepped.outcome.torque**2 * env.model.dt,
        min_margin=jnp.minimum(tally.min_margin, margin),
        last_unsettled=_last_unsettled(env, stepped.state, tally.last_unsettled),
        **_interventions(env, tally, stepped),
        **_agility(env, tally, stepped),
    )


def _judge(env: Reorientation, start: EnvState, end: _Tally) -> CaseResult:
    # What is not finite is never a success: a comparison with nan is false.
    settled = (end.last_unsettled < env.episode_steps) & jnp.isfinite(end.min_margin)
    return CaseResult(
        initial_angle=start.angle,
        reward_terms=end.reward_terms,
        settling_time=jnp.where(settled, (end.last_unsettled + 1) * env.model.dt, jnp.nan),
        control_effort=end.control_effort,
        control_accuracy=reward.pointing_error(end.flight.state.angle, env.reward),
        min_margin=end.min_margin,
        settled=settled,
        violated=~(end.min_margin > 0.0),
        intervention_rate=end.interventions / env.episode_steps,
        mean_torque_change=end.torque_change / env.episode_steps,
        deadlocked=~settled & end.intervened,
        unsafe_start=~(env.covers(start) & (env.margin(start) > 0.0)),
        infeasible_steps=end.infeasible_steps,
        peak_rate=end.peak_rate,
        torque_variation=end.torque_variation,
        unrest=end.unrest,
    )


def _interventions(env: Reorientation, tally: _Tally, stepped: Step) -> dict[str, jax.Array]:
    """How often and how much the filter changed torques, after one more step."""
    if env.action_filter is None:
        names = ("interventions", "torque_change", "intervened", "infeasible_steps")
        return {name: getattr(tally, name) for name in names}
    changed = stepped.command.intervened
    return {
        "interventions": tally.interventions + changed,
        "torque_change": tally.torque_change + jnp.linalg.norm(env.nominal_limits.box_B * stepped.command.change),
        "intervened": changed,
        "infeasible_steps": tally.infeasible_steps + ~stepped.command.feasible,
    }


def _agility(env: Reorientation, tally: _Tally, stepped: Step) -> dict[str, jax.Array]:
    """How fast the body turns, and how much the torque changes and is used at the end, after one more step."""
    after, before = stepped.state, tally.flight.state
    change_B = jnp.where(before.steps == 0, 0.0, jnp.abs(after.torque_B - before.torque_B))
    last_fifth = after.steps > env.episode_steps - _last_steps(env)
    return {
        "peak_rate": jnp.maximum(tally.peak_rate, rotations.norm(after.body.omega_BN_B)),
        "torque_variation": tally.torque_variation + jnp.sum(change_B),
        "unrest": tally.unrest + jnp.where(last_fifth, jnp.mean(stepped.command.applied**2), 0.0) / _last_steps(env),
    }


def _last_steps(env: Reorientation) -> int:
    """Steps of the last fifth of a maneuver."""
    return max(env.episode_steps // 5, 1)


def _history(env: Reorientation, before: EnvState, end: EnvState) -> History:
    """before: leaves (steps, ...), the state before each step; end: the state after the last."""
    states = jax.tree.map(lambda rows, last: jnp.concatenate([rows, last[None]]), before, end)
    # A state holds the torque that led to it, so the torque applied from an instant on is that of the next state.
    applied_B = jnp.concatenate([states.torque_B[1:], states.torque_B[-1:]])
    return History(
        state=states,
        attitude_error=jax.vmap(attitude_error)(states),
        torque_B=applied_B,
        zone_margin=jax.vmap(env.margin)(states),
        pointing_error=reward.pointing_error(states.angle, env.reward),
    )


def within_steps(env: Reorientation, history: History, substeps: int, key: jax.Array | None = None) -> RigidBodyState:
    """Where the body was also between the steps of a maneuver that ``fly`` flew with the same key.

    substeps: instants of each step, its start among them.  Returns leaves (steps * substeps + 1, ...).
    """
    truth = env.sample_truth(_split(jax.random.key(0) if key is None else key)[1])
    bodies = history.state.body

    def of_a_step(body: RigidBodyState, torque_B: jax.Array, actuators: ActuatorState) -> RigidBodyState:
        seconds = env.model.dt * jnp.arange(substeps) / substeps
        held_B = env.model.actuators.stored_momentum(actuators)
        return jax.vmap(propagate, in_axes=(None, None, None, 0, None))(body, torque_B, truth, seconds, held_B)

    before, actuators = jax.tree.map(lambda leaf: leaf[:-1], (bodies, history.state.actuators))
    inside = jax.vmap(of_a_step)(before, history.torque_B[:-1], actuators)
    return jax.tree.map(
        lambda rows, whole: jnp.concatenate([rows.reshape(-1, *rows.shape[2:]), whole[-1:]]), inside, bodies
    )
