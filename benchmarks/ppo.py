"""brax's own PPO, given what our training has: encoding, curriculum, shorter episodes, many environments.

    python benchmarks/ppo.py

Prints what the Monte Carlo says of the policy as it learns.  Rewards are the paper's, but the penalty of the zone is
absent from the first two stages and twice as high in the last, where the entropy weighs more: a policy that has become
sure of the direct way does not find another.
"""

import dataclasses
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import tyro
from brax_training import controller, replication
from flax import linen
from mlp import MlpController, evaluate

from koz_jax.adapters.brax_env import ReorientationEnv, wrap_for_training
from koz_jax.config.task import TaskConfig
from koz_jax.config.training import NetworkConfig
from koz_jax.control import encoding
from koz_jax.sac.networks import encode
from koz_jax.storage import runtime
from koz_jax.task import observation_layout

# brax is imported after brax_env, which keeps it from printing.
from brax.training.agents.ppo import networks as ppo_networks  # isort: skip
from brax.training.agents.ppo import train as ppo  # isort: skip

ENCODING = encoding.views(NetworkConfig())


class Stage(NamedTuple):
    """A part of the curriculum."""

    name: str
    share: float  # of all steps
    angles_deg: tuple[float, float]  # smallest and largest initial deviation [deg]
    zone_height: float  # of the reward
    entropy_cost: float  # weight of the entropy


STAGES = (
    Stage("near", 0.2, (0.0, 60.0), 0.0, 1e-3),
    Stage("far", 0.25, (0.0, 180.0), 0.0, 1e-3),
    Stage("zone", 0.55, (60.0, 180.0), 20.0, 1e-2),
)


@dataclasses.dataclass(frozen=True)
class Args:
    """Train brax's own PPO on the environment, with our encoding and curriculum."""

    steps: int = 40_000_000
    """Environment steps."""
    num_envs: int = 2048
    """Environments in parallel."""
    hidden_sizes: tuple[int, ...] = (128, 128)
    """Units of each hidden layer."""
    unroll: int = 32
    """Steps of an unroll."""
    batch: int = 256
    """Unrolls of a minibatch."""
    minibatches: int = 16
    """Minibatches of an epoch."""
    epochs: int = 4
    """Epochs over what was gathered."""
    learning_rate: float = 3e-4
    """Learning rate."""
    discount: float = 0.99
    """gamma, per environment step."""
    reward_scale: float = 0.01
    """Factor on the reward."""
    seconds: float = 40.0
    """Length of a training episode [s]."""
    reports: int = 5
    """Evaluations of each stage."""
    cases: int = 1000
    """Monte Carlo cases (80 to 180 deg) of each evaluation."""
    seed: int = 0
    """Seed of the training."""


def with_views(observation: Any, preprocessor_params: Any) -> jax.Array:
    """The observation and its finer views."""
    return encode(observation, ENCODING)


def networks(args: Args) -> Callable[..., ppo_networks.PPONetworks]:
    """Make policy and value, which see the observation and its finer views."""

    def make(observation_size: Any, action_size: int, **_: Any) -> ppo_networks.PPONetworks:
        width = jax.eval_shape(lambda: with_views(jnp.zeros(observation_size), None)).shape[0]
        return ppo_networks.make_ppo_networks(
            width,
            action_size,
            preprocess_observations_fn=with_views,  # pyright: ignore[reportArgumentType]
            policy_hidden_layer_sizes=args.hidden_sizes,
            value_hidden_layer_sizes=args.hidden_sizes,
        )

    return make


def environment(args: Args, stage: Stage) -> ReorientationEnv:
    """The environment of a stage; a zone that does not fit is made smaller."""
    task = TaskConfig.model_validate(
        {
            "episode_seconds": args.seconds,
            "reward": {"zone_height": stage.zone_height},
            "scenario": {"infeasible_zone": "shrink"},
        }
    )
    return ReorientationEnv(task, *stage.angles_deg)


def learn(args: Args, stage: Stage, params: Any, report: Any) -> Any:
    """Train through a stage.  params: those of the stage before, or None.  Returns new ones."""
    env = environment(args, stage)
    with replication():
        return ppo.train(
            env,
            num_timesteps=int(stage.share * args.steps),
            episode_length=env.episode_steps,
            wrap_env_fn=wrap_for_training,
            num_envs=args.num_envs,
            learning_rate=args.learning_rate,
            entropy_cost=stage.entropy_cost,
            discounting=args.discount,
            unroll_length=args.unroll,
            batch_size=args.batch,
            num_minibatches=args.minibatches,
            num_updates_per_batch=args.epochs,
            reward_scaling=args.reward_scale,
            max_grad_norm=1.0,
            network_factory=networks(args),
            restore_params=params,
            seed=args.seed,
            num_evals=args.reports + 1,
            run_evals=False,
            policy_params_fn=report,
            max_devices_per_host=1,
        )[1]


def as_controller(params: Any) -> MlpController:
    """The deterministic policy."""
    zeros = jnp.zeros(observation_layout.SIZE)
    unchanged = SimpleNamespace(mean=zeros, std=zeros + 1.0)
    return controller(unchanged, params[1], linen.swish).replace(encoding=ENCODING)


def main(args: Args) -> None:
    """Train and print."""
    runtime.configure()
    start, params = time.perf_counter(), None
    for stage in STAGES:

        def report(step: int, _: Any, params: Any, stage: Stage = stage) -> None:
            found = evaluate(as_controller(jax.device_get(params)), TaskConfig(), args.cases)
            print(
                f"{stage.name}: {step:>10} steps, {time.perf_counter() - start:5.0f} s: not settled"
                f" {found.non_settled_rate:.1%}, violated {found.violation_rate:.1%}, success {found.success_rate:.1%},"
                f" settled after {found.settling_time_mean:.1f} s, reward {found.mean_reward:.0f}",
                flush=True,
            )

        params = learn(args, stage, params, report)


if __name__ == "__main__":
    main(tyro.cli(Args))
