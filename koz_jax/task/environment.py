"""The one environment: training, refinement, Monte Carlo and all adapters fly maneuvers through it.

    env = Reorientation.from_config(TaskConfig())
    state = env.reset(key)
    step = env.step(state, action)  # step.state, step.observation, step.terms, step.truncated, ...

Everything is a pure function of one sample; batch it with ``vmap``.  Only ``autoreset``, ``step_autoreset`` and
``observe_each`` are of many environments, which share one draw of new scenarios, and may be a stack of different ones.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.config.task import TaskConfig, check_deviations, check_feasible
from koz_jax.config.uncertainty import CERTAIN
from koz_jax.task import actuators, maneuver, observation, pointing_constraints, reward, rotations, scenario, state
from koz_jax.task import uncertainty as errors
from koz_jax.task.actuators import TorqueLimits
from koz_jax.task.any_spacecraft import nondimensional, spread
from koz_jax.task.any_spacecraft.spread import Spread
from koz_jax.task.reward import Outcome, RewardParams
from koz_jax.task.scenario import SamplingRule, Scenario, ScenarioRanges
from koz_jax.task.state import ActionFilter, Command, EnvState, Model, Step, Truth, attitude_error, select_envs
from koz_jax.task.uncertainty import Uncertainty


class Reorientation(struct.PyTreeNode):
    """Maneuvers of one task; its numbers are traced, so that other ones do not mean another compilation."""

    model: Model
    reward: RewardParams
    ranges: ScenarioRanges
    action_filter: ActionFilter | None = None  # None lets every action through
    uncertainty: Uncertainty | None = None  # None flies the model itself, measured exactly
    spread: Spread | None = None  # None flies every maneuver with the same spacecraft
    urgency: jax.Array | float = 0.5  # () in [0, 1], for policies that see it
    rule: SamplingRule = struct.field(pytree_node=False, default=SamplingRule())
    observed_zones: int = struct.field(pytree_node=False, default=1)
    scaled: bool = struct.field(pytree_node=False, default=False)  # sees and acts as of ``nondimensional``
    episode_steps: int = struct.field(pytree_node=False, default=1000)

    @classmethod
    def from_config(
        cls,
        task: TaskConfig | None = None,
        min_angle_deg: float = 80.0,
        max_angle_deg: float = 180.0,
        *,
        rule: SamplingRule | None = None,
        observed_zones: int | None = None,
        action_filter: ActionFilter | None = None,
        uncertainty: Uncertainty | None = None,
    ) -> "Reorientation":
        """Make the environment of a task.

        Args:
            task: by default the paper's.
            min_angle_deg: initial deviations are uniform from this angle [deg]
            max_angle_deg: to this one [deg].
            rule: how scenarios are drawn; by default until one is feasible.
            observed_zones: zones in the observation; by default all that a scenario can have.
            action_filter: what stands between controller and actuators, such as the shield.
            uncertainty: how far the truth may be from the model; by default as the task's spread says.

        Raises:
            SettingsError: the angles are not in [0, 180], not in order, or leave no room for a zone.

        """
        task = task or TaskConfig()
        check_deviations(min_angle_deg, max_angle_deg)
        if rule is None:
            check_feasible(task, max_angle_deg)
        return cls(
            model=model_from_config(task),
            reward=reward.from_config(task.reward, task.angle_convention),
            ranges=scenario.from_config(task, min_angle_deg, max_angle_deg),
            action_filter=action_filter,
            uncertainty=uncertainty or errors_of(task),
            spread=spread.from_config(task),
            rule=rule or SamplingRule(task.scenario.infeasible_zone),
            observed_zones=observed_zones or task.zones[1],
            episode_steps=task.episode_steps,
        )

    def drawn(self, key: jax.Array) -> "Reorientation":
        """The environment of one maneuver, in which all that is spread is drawn.  key: () typed PRNG key."""
        if self.spread is None:
            return self
        found = spread.draw(self.spread, self.model, self.ranges, key)
        uncertainty = self.uncertainty
        if uncertainty is not None:
            late = uncertainty if found.delay is None else uncertainty.replace(delay=found.delay)
            uncertainty = late.without_errors(found.nominal)
        return self.replace(
            model=found.model, ranges=found.ranges, urgency=found.urgency, uncertainty=uncertainty, spread=None
        )

    @property
    def nominal_limits(self) -> TorqueLimits:
        """Torques that can be asked for at the start of a maneuver; rewards count torques in shares of them."""
        return state.nominal_limits(self.model)

    def sample(self, key: jax.Array) -> Scenario:
        """Draw a scenario.  key: () typed PRNG key."""
        return scenario.sample(key, self.ranges, self.rule)

    def reset(self, start: jax.Array | Scenario) -> EnvState:
        """Begin a maneuver: a given scenario, or one drawn with a typed PRNG key ().

        A scenario is checked, see ``maneuver.checked``, where it is not being traced.
        """
        drawn = maneuver.checked(start) if isinstance(start, Scenario) else self.sample(start)
        late = self.uncertainty is not None and self.uncertainty.delay is not None
        return state.begin(drawn, self.model, late)

    def covers(self, at: EnvState) -> jax.Array:
        """Whether what the filter guarantees holds from this state on; also where there is none.  Returns () bool."""
        return jnp.array(True) if self.action_filter is None else self.action_filter.covers(at, self.model)

    def observe(self, measured: EnvState) -> jax.Array:
        """What a controller sees of a state.

        Returns (16,), 5 more for each observed zone above one; where the environment is ``scaled``, what
        ``nondimensional.observe`` gives.
        """
        if self.scaled:
            return nondimensional.observe(measured, self.model, self.urgency, self.observed_zones)
        return observation.observe(measured, self.observed_zones)

    def sample_truth(self, key: jax.Array) -> Truth:
        """Draw the spacecraft that really flies, for a whole maneuver.  key: () typed PRNG key."""
        if self.uncertainty is None:
            return state.nominal(self.model)
        return errors.sample_truth(self.uncertainty, self.model, key)

    def measure(self, at: EnvState, key: jax.Array) -> EnvState:
        """What sensors make of a state.  key: () typed PRNG key of the maneuver's noise."""
        if self.uncertainty is None:
            return at
        return errors.add_sensor_errors(self.uncertainty, at, key)

    def filter(self, measured: EnvState, action: jax.Array) -> Command:
        """Clip an action (3,) to [-1, 1], and pass it through the filter.

        The gradient passes the filter as if it were not there: it branches, and has none of its own.
        """
        requested = jnp.clip(action, -1.0, 1.0)
        if self.action_filter is None:
            return Command(requested, requested, jnp.array(True))
        held, asked = jax.lax.stop_gradient((measured, requested))
        allowed = self.action_filter.allow(held, asked, self.model)
        return Command(requested, _straight_through(requested, allowed.action), allowed.feasible)

    def step(
        self,
        before: EnvState,
        action: jax.Array,
        *,
        measured: EnvState | None = None,
        truth: Truth | None = None,
        noise: jax.Array | None = None,
    ) -> Step:
        """Fly one time step.

        Args:
            before: where the maneuver is.
            action: (3,) in [-1, 1] (clipped), share of the torque limits; where the environment is ``scaled``, as
                of ``nondimensional.command``.
            measured: what the filter knows of the state; by default the state itself.
            truth: what flies; by default the model.
            noise: () typed PRNG key of the maneuver's noise, to observe what is measured; by default the state itself
                is observed.
        """
        known = before if measured is None else measured
        if self.scaled:
            action = nondimensional.command(jnp.clip(action, -1.0, 1.0), known, self.model)
        command = self.filter(known, action)
        flown = state.nominal(self.model) if truth is None else truth
        after, outcome = self._advance(before, known, command, flown)
        observed = self.observe(after if noise is None else self.measure(after, noise))
        return Step(
            state=after,
            observation=observed,
            final_observation=observed,
            command=command,
            outcome=outcome,
            terms=reward.terms(outcome, self.reward, self.nominal_limits),
            terminated=jnp.array(False),
            truncated=after.steps >= self.episode_steps,
        )

    def _advance(self, before: EnvState, known: EnvState, command: Command, truth: Truth) -> tuple[EnvState, Outcome]:
        now, on_the_way = state.delayed(command.applied, before.on_the_way, truth.delay)
        actuators, inertia_B, dt = self.model.actuators, self.model.inertia_B, self.model.dt
        torque_B, actuator_state = actuators.apply(now, before.actuators, known.body.omega_BN_B, inertia_B, dt)
        held_B = actuators.stored_momentum(before.actuators)
        after = before.replace(
            body=state.propagate(before.body, torque_B, truth, dt, held_B),
            scenario=before.scenario.after(dt),
            q_e0_previous=attitude_error(before)[0],
            torque_B=torque_B,
            steps=before.steps + 1,
            actuators=actuator_state,
            on_the_way=on_the_way,
        )
        after = after.replace(angle=rotations.rotation_angle(attitude_error(after)))
        change = jnp.where(before.steps == 0, 0.0, rotations.norm(torque_B - before.torque_B))
        return after, Outcome(
            angle=after.angle,
            angle_previous=before.angle,
            torque=rotations.norm(torque_B),
            torque_change=change,
            zone_margin=self.margin(after),
            intervention=rotations.norm(command.change),
        )

    def margin(self, at: EnvState) -> jax.Array:
        """Margin of the constraint that is nearest to being violated.  Returns () [rad]."""
        return pointing_constraints.smallest_margin(at.body.q_BN, at.scenario.constraints)

    def autoreset(
        self, over: jax.Array, states: EnvState, observed: jax.Array, keys: Callable[[], jax.Array]
    ) -> tuple[EnvState, jax.Array]:
        """Begin the next maneuver of every environment whose last one is over.

        Args:
            over: (n,) bool.
            states: leaves (n, ...).
            observed: (n, entries) observations of the states.
            keys: makes the typed keys (n,) of the next maneuvers.

        Returns:
            States, and their observations.

        """

        def restart() -> tuple[EnvState, jax.Array]:
            fresh = self.map(Reorientation.reset, keys())
            return select_envs(over, (fresh, self.observe_each(fresh)), (states, observed))

        # Drawing scenarios costs more than a step, and most steps end no maneuver.
        return jax.lax.cond(jnp.any(over), restart, lambda: (states, observed))

    def observe_each(self, states: EnvState) -> jax.Array:
        """What a controller sees of each of many states, leaves (n, ...).  Returns (n, entries)."""
        return self.map(Reorientation.observe, states)

    def map(self, method: Callable[..., Any], *arguments: Any) -> Any:
        """Map a method over many environments: those of a stack, as ``drawn`` makes them, or all the same."""
        own = 0 if self.model.dt.ndim else None
        return jax.vmap(method, in_axes=(own, *(0 for _ in arguments)))(self, *arguments)

    def step_autoreset(self, states: EnvState, actions: jax.Array, keys: Callable[[], jax.Array], **met: Any) -> Step:
        """Step many environments; where that ends a maneuver, the next one begins within the same step.

        states: leaves (n, ...); actions: (n, 3); keys: as of ``autoreset``; met: what else ``step`` takes, leaves
        (n, ...).  Returns leaves (n, ...).
        """

        def step(env: Reorientation, state: EnvState, action: jax.Array, met: dict[str, Any]) -> Step:
            return env.step(state, action, **met)

        stepped = self.map(step, states, actions, met)
        next_states, observed = self.autoreset(stepped.truncated, stepped.state, stepped.final_observation, keys)
        return stepped.replace(state=next_states, observation=observed)


@jax.custom_jvp
def _straight_through(requested: jax.Array, applied: jax.Array) -> jax.Array:
    """Return what is applied, with the gradient of what was requested."""
    return applied


@_straight_through.defjvp
def _straight_through_jvp(
    values: tuple[jax.Array, jax.Array], slopes: tuple[jax.Array, jax.Array]
) -> tuple[jax.Array, jax.Array]:
    return values[1], slopes[0]


def errors_of(task: TaskConfig) -> Uncertainty | None:
    """Errors that every maneuver of a task is flown with; a delay that is spread is drawn with what else is."""
    if task.spread.delay_steps is not None:
        return errors.from_config(task.spread.errors).replace(delay=jnp.int32(0))
    return None if task.spread.errors == CERTAIN else errors.from_config(task.spread.errors)


def model_from_config(task: TaskConfig) -> Model:
    """The spacecraft as the settings say, float32."""
    max_rate_deg = task.spacecraft.max_rate_deg
    return Model(
        inertia_B=jnp.array(task.spacecraft.inertia),
        actuators=actuators.from_config(task.spacecraft),
        dt=jnp.float32(task.step_seconds),
        max_rate=None if max_rate_deg is None else jnp.deg2rad(jnp.float32(max_rate_deg)),
    )
