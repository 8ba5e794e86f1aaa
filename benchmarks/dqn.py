"""Train the double DQN of the controller ``dqn``, and fly it.

    python benchmarks/dqn.py --out dqn_slews.npz

It learns on kinematics alone which slew to take next, see ``koz_jax.control.slews``.  A slew costs its angle, more
where it comes nearer to a zone than ``keep_deg``, and most where it enters one.  Without ``--out``, nothing is kept.
"""

import dataclasses
import functools
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from flax import struct
from flax.traverse_util import flatten_dict

from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.slews import slews
from koz_jax.control.slews.dqn_slews import ENCODING, HIDDEN_SIZES, DqnSlews
from koz_jax.evaluation.cases import fly_cases
from koz_jax.evaluation.summary import summarise
from koz_jax.learners.dqn import Dqn, DqnState
from koz_jax.sac import replay_buffer
from koz_jax.sac.losses import Batch
from koz_jax.sac.replay_buffer import ReplayBuffer, Transition
from koz_jax.storage import runtime
from koz_jax.task import observation_layout
from koz_jax.task.environment import Reorientation
from koz_jax.task.scenario import SamplingRule
from koz_jax.task.state import EnvState

DQN = Dqn(
    hidden_sizes=HIDDEN_SIZES,
    encoding=ENCODING,
    observation_size=observation_layout.SIZE,
    actions=slews.COUNT,
    soft_update=0.005,
    average=0.002,
)

MOST_SLEWS = 40  # of a maneuver
SHORTFALL_COST = 4.0  # of a slew that touches a zone, falling to nothing at the margin that should be kept
VIOLATION_COST = 10.0


@dataclasses.dataclass(frozen=True)
class Args:
    """Train the double DQN of the controller ``dqn``, and fly it."""

    updates: int = 40_000
    """Gradient updates."""
    num_envs: int = 64
    """Maneuvers in parallel."""
    updates_per_step: int = 4
    """Updates for each slew of all of them."""
    batch: int = 256
    """Slews per update."""
    buffer: int = 200_000
    """Slews that the replay buffer holds."""
    n_step: int = 1
    """Slews summed before the network's own estimate takes over."""
    discount: float = 0.98
    """gamma, per slew."""
    learning_rate: float = 1e-3
    """Learning rate at the start; it falls to zero."""
    exploration: tuple[float, float] = (1.0, 0.05)
    """Share of slews at random, at the start and from a third on."""
    keep_deg: float = 4.0
    """Margin below which a slew costs more [deg]."""
    seed: int = 0
    """Seed of the training."""
    cases: int = 1000
    """Monte Carlo cases at the end."""
    out: Path | None = None
    """File of the weights."""


class State(struct.PyTreeNode):
    """Everything that training changes."""

    learner: DqnState
    buffer: ReplayBuffer
    maneuvers: EnvState  # leaves (num_envs, ...)
    key: jax.Array  # () typed PRNG key
    updates: jax.Array  # () int32


def environment() -> Reorientation:
    """Maneuvers of all angles; a zone that does not fit is made smaller."""
    return Reorientation.from_config(TaskConfig(), 0.0, 180.0, rule=SamplingRule("shrink"))


def take(
    args: Args, env: Reorientation, maneuvers: EnvState, observed: jax.Array, choice: jax.Array, key: jax.Array
) -> tuple[EnvState, Transition]:
    """One slew of all maneuvers; those that are there, or took too many, begin anew."""
    found = jax.vmap(slews.slew)(maneuvers, choice)
    shortfall = jnp.clip(1.0 - found.margin / jnp.deg2rad(args.keep_deg), 0.0, 1.0)
    cost = found.angle / slews.SLEW_ANGLE + SHORTFALL_COST * shortfall + VIOLATION_COST * (found.margin <= 0.0)
    after = found.state.replace(steps=maneuvers.steps + 1)
    there = jax.vmap(slews.is_there)(after)
    over = there | (after.steps >= MOST_SLEWS)
    seen = env.observe_each(after)
    begun, _ = env.autoreset(over, after, seen, lambda: jax.random.split(key, args.num_envs))
    return begun, Transition(
        observation=observed, action=choice, outcome=-cost, terminated=there, truncated=over, next_observation=seen
    )


def init(args: Args, key: jax.Array) -> State:
    """Fresh networks, and a buffer with the first slews, all at random."""
    key_learner, key_envs, key_choice, key_reset, key = jax.random.split(key, 5)
    env = environment()
    maneuvers = jax.vmap(lambda key: at_rest(env.reset(key)))(jax.random.split(key_envs, args.num_envs))
    choice = jax.random.randint(key_choice, (args.num_envs,), 0, slews.COUNT)
    maneuvers, row = take(args, env, maneuvers, env.observe_each(maneuvers), choice, key_reset)
    buffer = replay_buffer.insert(replay_buffer.init(row, args.buffer // args.num_envs), row)
    return State(DQN.init(key_learner), buffer, maneuvers, key, jnp.int32(0))


def at_rest(state: EnvState) -> EnvState:
    """The same maneuver, at rest."""
    return slews.at_rest(state, state.body.q_BN)


def step(args: Args, env: Reorientation, state: State) -> tuple[State, jax.Array]:
    """One slew of all maneuvers, then ``updates_per_step`` gradient updates.  Returns also their mean loss ()."""
    key, key_explore, key_reset, key_batch = jax.random.split(state.key, 4)
    done = state.updates / args.updates
    first, last = args.exploration
    share = last + (first - last) * jnp.clip(1.0 - 3.0 * done, 0.0, 1.0)
    observed = env.observe_each(state.maneuvers)
    choice = DQN.explore(state.learner, observed, key_explore, share)
    maneuvers, row = take(args, env, state.maneuvers, observed, choice, key_reset)
    buffer = replay_buffer.insert(state.buffer, row)
    windows = replay_buffer.sample_windows(buffer, key_batch, args.updates_per_step * args.batch, args.n_step)
    drawn = replay_buffer.n_step_batch(windows, windows.outcome, args.discount)
    batches = jax.tree.map(lambda leaf: leaf.reshape(args.updates_per_step, -1, *leaf.shape[1:]), drawn)

    def learn(learner: DqnState, batch: Batch) -> tuple[DqnState, jax.Array]:
        return DQN.update(learner, batch, args.learning_rate * (1.0 - done))

    learner, losses = jax.lax.scan(learn, state.learner, batches)
    return State(learner, buffer, maneuvers, key, state.updates + args.updates_per_step), jnp.mean(losses)


@functools.partial(jax.jit, static_argnums=(0, 2), donate_argnums=1)
def train(args: Args, state: State, steps: int) -> tuple[State, jax.Array, jax.Array]:
    """Take steps.  Returns also the mean loss (), and the mean reward () of a slew."""
    env = environment()

    def body(state: State, _: None) -> tuple[State, tuple[jax.Array, jax.Array]]:
        state, loss = step(args, env, state)
        newest = state.buffer.rows.outcome[state.buffer.head - 1]
        return state, (loss, jnp.mean(newest))

    state, (losses, rewards) = jax.lax.scan(body, state, length=steps)
    return state, jnp.mean(losses), jnp.mean(rewards)


def main(args: Args) -> None:
    """Train, save, fly."""
    runtime.configure()
    start = time.perf_counter()
    state = jax.jit(init, static_argnums=0)(args, jax.random.key(args.seed))
    reports = 10
    for _ in range(reports):
        state, loss, reward = train(args, state, args.updates // args.updates_per_step // reports)
        print(
            f"{int(state.updates):>7} updates, {time.perf_counter() - start:4.0f} s: loss {float(loss):.3f}, reward of"
            f" a slew {float(reward):.3f}",
            flush=True,
        )
    values = jax.device_get(state.learner.averaged_values)
    if args.out:
        with open(args.out, "wb") as file:
            np.savez(
                file,
                allow_pickle=False,
                **{name: np.asarray(leaf) for name, leaf in flatten_dict(values, sep="/").items()},
            )
    flown = fly_cases(DqnSlews(values), TaskConfig(), MonteCarloConfig(cases=args.cases))
    found = summarise(flown)
    print(
        f"{args.cases} cases: success {found.success_rate:.2%}, not settled {found.non_settled_rate:.2%}, violated"
        f" {found.violation_rate:.2%}, settled after {found.settling_time_mean:.2f} s, effort"
        f" {found.control_effort_mean:.1f}, smallest margin {found.min_margin_deg:.2f} deg"
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
