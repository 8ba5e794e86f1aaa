"""Flying maneuvers: one case at a time, either only measured or with its whole history."""

from typing import Protocol

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax import dynamics, env, keep_out, observation, reward
from koz_jax.env import EnvParams, EnvState
from koz_jax.reward import RewardTerms
from koz_jax.scenario import Scenario


class Controller(Protocol):
    """What flies the spacecraft.  Implementations are pytrees, so that new weights do not mean a new compilation."""

    def act(self, observed: jax.Array) -> jax.Array:
        """Action (3,) in [-1, 1] for an observation (16,)."""
        ...


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


class _Tally(struct.PyTreeNode):
    state: EnvState
    reward_terms: RewardTerms
    control_effort: jax.Array
    min_margin: jax.Array
    last_unsettled: jax.Array  # () int32, last instant (in steps) at which phi was outside; -1 if none


def _margin(state: EnvState, params: EnvParams) -> jax.Array:
    return keep_out.smallest_margin(env.boresight_N(state.body, params.spacecraft), state.scenario.zones)


def _margin_between(state: EnvState, torque_B: jax.Array, params: EnvParams, substeps: int) -> jax.Array:
    """Smallest margin at ``substeps - 1`` instants inside the step that starts in ``state``.  Returns () [rad]."""
    margins = [jnp.float32(jnp.inf)]
    for i in range(1, substeps):
        body = dynamics.step(state.body, torque_B, params.spacecraft, params.dt * (i / substeps))
        margins.append(_margin(state.replace(body=body), params))
    return jnp.min(jnp.stack(margins))


def run_case(
    controller: Controller, scenario: Scenario, params: EnvParams, steps: int, substeps: int = 1
) -> CaseResult:
    """Fly one maneuver and judge it.

    substeps: the zone is checked at so many instants per step; 1 checks at the steps only.
    """
    start = env.reset(scenario)

    def unsettled_at(state: EnvState, before: jax.Array) -> jax.Array:
        return jnp.where(reward.is_settled(state.angle, params.reward), before, state.steps)

    def advance(tally: _Tally, _: None) -> tuple[_Tally, None]:
        action = controller.act(observation.observe(tally.state, params))
        state, outcome = env.step(tally.state, action, params)
        terms = reward.terms(outcome, params.reward, params.spacecraft.torque_limit)
        margin = outcome.zone_margin
        if substeps > 1:
            margin = jnp.minimum(margin, _margin_between(tally.state, state.torque_B, params, substeps))
        return _Tally(
            state=state,
            reward_terms=jax.tree.map(jnp.add, tally.reward_terms, terms),
            control_effort=tally.control_effort + outcome.torque**2 * params.dt,
            min_margin=jnp.minimum(tally.min_margin, margin),
            last_unsettled=unsettled_at(state, tally.last_unsettled),
        ), None

    tally = _Tally(
        state=start,
        reward_terms=jax.tree.map(lambda _: jnp.zeros(()), reward.PAPER_WEIGHTS),
        control_effort=jnp.zeros(()),
        min_margin=_margin(start, params),
        last_unsettled=unsettled_at(start, jnp.int32(-1)),
    )
    end, _ = jax.lax.scan(advance, tally, None, length=steps)
    settled = end.last_unsettled < steps
    return CaseResult(
        initial_angle=start.angle,
        reward_terms=end.reward_terms,
        settling_time=jnp.where(settled, (end.last_unsettled + 1) * params.dt, jnp.nan),
        control_effort=end.control_effort,
        control_accuracy=reward.pointing_error(end.state.angle, params.reward),
        min_margin=end.min_margin,
        settled=settled,
        violated=end.min_margin <= 0.0,
    )


def fly(controller: Controller, scenario: Scenario, params: EnvParams, steps: int) -> History:
    """Fly one maneuver and keep everything."""

    def advance(state: EnvState, _: None) -> tuple[EnvState, EnvState]:
        action = controller.act(observation.observe(state, params))
        return env.step(state, action, params)[0], state

    end, before = jax.lax.scan(advance, env.reset(scenario), None, length=steps)
    states = jax.tree.map(lambda rows, last: jnp.concatenate([rows, last[None]]), before, end)
    # A state holds the torque that led to it, so the torque applied from an instant on is that of the next state.
    applied = jnp.concatenate([states.torque_B[1:], states.torque_B[-1:]])
    return History(
        state=states,
        observation=jax.vmap(observation.observe, in_axes=(0, None))(states, params),
        torque_B=applied,
        zone_margin=jax.vmap(_margin, in_axes=(0, None))(states, params),
        pointing_error=reward.pointing_error(states.angle, params.reward),
    )
