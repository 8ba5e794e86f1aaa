"""How far an agent for any spacecraft is from the best flight of each maneuver, by the cost of preset universal.

    python benchmarks/optimum.py [--agent NAME] [--cases N] [--iterations N] [--random] [--markdown FILE]

A correction of every action of a maneuver is found by gradient descent, on top of the agent's closed loop: a local
optimum of that maneuver alone.  Times and efforts are in the units of the paper's spacecraft.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import stamp

from koz_jax.agents.agent import Agent, load_agent
from koz_jax.cli.exit_status import exit_status
from koz_jax.config.presets.named import preset
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import TaskConfig
from koz_jax.config.training import TrainConfig
from koz_jax.control.base import Memoryless
from koz_jax.control.policy import PolicyController
from koz_jax.evaluation.rollout import CaseResult, run_case
from koz_jax.learning import refinement
from koz_jax.storage import runtime
from koz_jax.task.any_spacecraft import nondimensional, spread
from koz_jax.task.environment import Reorientation
from koz_jax.task.observation_layout import ACTION_SIZE
from koz_jax.task.state import EnvState, Model

URGENCIES = (0.0, 0.25, 0.5, 0.75, 1.0)
COLUMNS = ("urgency", "cost above the optimum, mean", "at worst", "settling time [s]", "at the optimum")
COLUMNS += ("effort [N² m² s]", "at the optimum", "variation of torque per axis, times the optimum's")

# Step size of the corrections at the start, as a share of the largest action; it falls to zero along a cosine.
_LEARNING_RATE = 0.02


class Corrected(Memoryless):
    """A policy whose actions are corrected at every step of one maneuver."""

    policy: PolicyController
    corrections: jax.Array  # (steps, 3)

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """Action (3,) in [-1, 1] for the state."""
        seen = nondimensional.observe(state, model, self.policy.urgency, self.policy.network.observed_zones)
        action = jnp.clip(self.policy.act(seen) + self.corrections[state.steps], -1.0, 1.0)
        return nondimensional.command(action, state, model), memory


def settings(agent: Agent, random: bool) -> TrainConfig:
    """What the cost is of: the paper's spacecraft, or another one in every maneuver; without errors."""
    made_for = preset("universal")
    task = TaskConfig(spread=SpreadConfig(spacecraft=True, step_shares=(0.016, 0.05))) if random else TaskConfig()
    refine = made_for.refine.model_copy(update={"min_angle_deg": 80.0})
    assert isinstance(agent.controller, PolicyController)
    return made_for.model_copy(update={"task": task, "network": agent.controller.network, "refine": refine})


def improve(
    config: TrainConfig, policy: PolicyController, keys: jax.Array, iterations: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Costs (n,) as the policy flies, the least that were found (n,), and the corrections for them (n, steps, 3)."""
    env = refinement.maneuver_environment(config).replace(urgency=policy.urgency)
    schedule = optax.adam(optax.cosine_decay_schedule(_LEARNING_RATE, iterations))

    def cost_of(corrections: jax.Array, key: jax.Array) -> jax.Array:
        # The urgency is the policy's in the maneuvers of any spacecraft too.
        own = env.drawn(jax.random.fold_in(key, spread.PURPOSE)).replace(urgency=policy.urgency)
        return refinement.fly_maneuver(policy, own, key, config, nudges=corrections).mean

    def descend(
        carry: tuple[jax.Array, optax.OptState, jax.Array, jax.Array], _: None
    ) -> tuple[tuple[jax.Array, optax.OptState, jax.Array, jax.Array], jax.Array]:
        corrections, optimizer, least, best = carry
        costs, slopes = jax.vmap(jax.value_and_grad(cost_of))(corrections, keys)
        better = costs < least
        best = jnp.where(better[:, None, None], corrections, best)
        change, optimizer = schedule.update(jnp.nan_to_num(slopes), optimizer)
        corrections = jnp.asarray(optax.apply_updates(corrections, change))
        return (corrections, optimizer, jnp.minimum(least, costs), best), costs

    none = jnp.zeros((len(keys), config.refine_steps, ACTION_SIZE))
    begin = (none, schedule.init(none), jnp.full(len(keys), jnp.inf), none)
    (_, _, least, best), costs = jax.lax.scan(descend, begin, None, length=iterations)
    return costs[0], least, best


def fly(config: TrainConfig, policy: PolicyController, keys: jax.Array, corrections: jax.Array) -> CaseResult:
    """Fly the corrected maneuvers.  Returns leaves (n, ...)."""
    env = refinement.maneuver_environment(config)
    env = env.replace(scaled=False, episode_steps=config.refine_steps)

    def one(key: jax.Array, own: jax.Array) -> CaseResult:
        drawn: Reorientation = env.drawn(jax.random.fold_in(key, spread.PURPOSE))
        return run_case(drawn, Corrected(policy, own), drawn.sample(key), key=key)

    return jax.vmap(one)(keys, corrections)


def cells(urgency: float, costs: np.ndarray, least: np.ndarray, flown: CaseResult, best: CaseResult) -> list[str]:
    """A row of the table."""
    above = costs / least - 1.0
    return [
        f"{urgency:g}",
        f"{100 * above.mean():.1f} %",
        f"{100 * above.max():.1f} %",
        *(f"{np.nanmean(np.asarray(found.settling_time)):.2f}" for found in (flown, best)),
        *(f"{np.mean(np.asarray(found.control_effort)):.1f}" for found in (flown, best)),
        f"{np.mean(np.asarray(flown.torque_variation)) / np.mean(np.asarray(best.torque_variation)):.2f}",
    ]


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/optimum.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--agent", default="universal", help="name or folder of an agent for any spacecraft")
    parser.add_argument("--cases", type=int, default=64, help="maneuvers of each row")
    parser.add_argument("--iterations", type=int, default=400, help="steps of gradient descent")
    parser.add_argument("--random", action="store_true", help="fly another spacecraft in every maneuver")
    parser.add_argument("--markdown", type=Path, help="write the table with its origin, for docs/results/")
    args = parser.parse_args(argv)
    return exit_status(lambda: _compare(args, argv))


def _compare(args: argparse.Namespace, argv: list[str]) -> int:
    runtime.configure()
    agent = load_agent(args.agent)
    config = settings(agent, args.random)
    keys = jax.random.split(jax.random.key(1), args.cases)
    improved = jax.jit(improve, static_argnums=(0, 3))
    flown = jax.jit(fly, static_argnums=0)
    lines = [stamp.row(list(COLUMNS)), stamp.row(["---"] * len(COLUMNS))]
    print("\n".join(lines))
    for urgency in URGENCIES:
        policy = agent.with_urgency(urgency).controller
        assert isinstance(policy, PolicyController)
        policy = policy.replace(urgency=jnp.float32(urgency))
        costs, least, best = improved(config, policy, keys, args.iterations)
        both = (flown(config, policy, keys, corrections) for corrections in (jnp.zeros_like(best), best))
        lines.append(stamp.row(cells(urgency, np.asarray(costs), np.asarray(least), *both)))
        print(lines[-1], flush=True)
    if args.markdown:
        stamp.write_table(args.markdown, ["benchmarks/optimum.py", *argv], "\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
