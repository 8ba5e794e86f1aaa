"""Cross-check: brax's own trainers on the same environment.

    python benchmarks/brax_training.py --algorithm ppo --steps 2000000

Prints what the Monte Carlo says of the policy as it learns.
"""

import contextlib
import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import tyro
from flax import linen
from mlp import MlpController, evaluate

from koz_jax.adapters.brax_env import ENV_NAME, wrap_for_training
from koz_jax.config.task import TaskConfig

# brax is imported after brax_env, which keeps it from printing.
from brax import envs  # isort: skip
from brax.training.agents.ppo import networks as ppo_networks  # isort: skip
from brax.training.agents.ppo import train as ppo  # isort: skip
from brax.training.agents.sac import checkpoint as sac_checkpoint  # isort: skip
from brax.training.agents.sac import train as sac  # isort: skip

# Called after every epoch with the environment steps and the gradient updates so far, and the policy.
Watch = Callable[[int, int, MlpController], None]

SAC_ENVS, SAC_UPDATES = 64, 8  # environments, and updates per step of all of them
PPO_ENVS, PPO_UNROLL, PPO_MINIBATCHES, PPO_BATCH, PPO_EPOCHS = 2048, 20, 16, 512, 4


@dataclasses.dataclass(frozen=True)
class Args:
    """Train brax's own PPO or SAC on the environment."""

    algorithm: Literal["ppo", "sac"] = "ppo"
    """Which of brax's trainers."""
    steps: int = 2_000_000
    """Environment steps."""
    reports: int = 10
    """How often the policy is evaluated."""
    seed: int = 0
    """Seed of the training."""
    min_angle_deg: float = 80.0
    """Smallest initial deviation in training [deg]."""
    cases: int = 1000
    """Monte Carlo cases (80 to 180 deg) of each evaluation."""


@contextlib.contextmanager
def replication() -> Iterator[None]:
    """Lend jax the function ``device_put_replicated``, which brax 0.14.2 calls and jax 0.10 no longer has."""
    if hasattr(jax, "device_put_replicated"):
        yield
        return

    def replicate(tree: Any, devices: list[Any]) -> Any:
        return jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * len(devices)), tree)

    jax.device_put_replicated = replicate  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield
    finally:
        del jax.device_put_replicated  # pyright: ignore[reportAttributeAccessIssue]


def controller(normalizer: Any, policy: Any, activation: Callable[[jax.Array], jax.Array]) -> MlpController:
    """Make a controller of brax's parameters; the last layer's first half is the mean of the action."""
    layers = [policy["params"][f"hidden_{i}"] for i in range(len(policy["params"]))]
    return MlpController(
        mean=normalizer.mean,
        std=normalizer.std,
        weights=tuple(layer["kernel"] for layer in layers),
        biases=tuple(layer["bias"] for layer in layers),
        activation=activation,
    )


def train_ppo(steps: int, reports: int, seed: int, watch: Watch, min_angle_deg: float = 80.0) -> None:
    """brax's PPO: normalised observations, 256-256 networks, 2048 environments."""
    environment: Any = envs.get_environment(ENV_NAME, min_angle_deg=min_angle_deg)
    per_update = PPO_BATCH * PPO_UNROLL / PPO_EPOCHS  # environment steps

    def seen(step: int, _: Any, params: Any) -> None:
        watch(step, int(step / per_update), controller(params[0], params[1], linen.swish))

    with replication():
        ppo.train(
            environment,
            num_timesteps=steps,
            episode_length=environment.episode_steps,
            wrap_env_fn=wrap_for_training,
            num_envs=PPO_ENVS,
            learning_rate=3e-4,
            entropy_cost=1e-3,
            discounting=0.99,
            unroll_length=PPO_UNROLL,
            batch_size=PPO_BATCH,
            num_minibatches=PPO_MINIBATCHES,
            num_updates_per_batch=PPO_EPOCHS,
            normalize_observations=True,
            reward_scaling=0.1,
            max_grad_norm=1.0,
            network_factory=_ppo_network,
            seed=seed,
            num_evals=reports + 1,
            run_evals=False,
            policy_params_fn=seen,
            max_devices_per_host=1,
        )


def _ppo_network(*args: Any, **kwargs: Any) -> ppo_networks.PPONetworks:
    sizes = (256, 256)
    return ppo_networks.make_ppo_networks(
        *args, policy_hidden_layer_sizes=sizes, value_hidden_layer_sizes=sizes, **kwargs
    )


def train_sac(steps: int, reports: int, seed: int, watch: Watch, min_angle_deg: float = 80.0) -> None:
    """brax's SAC: normalised observations, 256-256 networks, batch 256, 64 environments to 8 updates."""
    environment: Any = envs.get_environment(ENV_NAME, min_angle_deg=min_angle_deg)
    with tempfile.TemporaryDirectory() as folder, replication():

        def seen(step: int, _: Any) -> None:
            # This trainer shows its parameters to nobody before the end, but it saves them.
            saved = sorted(path for path in Path(folder).iterdir() if path.name.isdigit())
            if saved:
                normalizer, policy = sac_checkpoint.load(str(saved[-1]))[:2]
                updates = (step - min_replay) // SAC_ENVS * SAC_UPDATES
                watch(step, updates, controller(_struct(normalizer), policy, linen.relu))

        min_replay = 8192
        sac.train(
            environment,
            num_timesteps=steps,
            episode_length=environment.episode_steps,
            wrap_env_fn=wrap_for_training,
            num_envs=SAC_ENVS,
            num_eval_envs=1,
            learning_rate=3e-4,
            discounting=0.99,
            seed=seed,
            batch_size=256,
            num_evals=reports + 1,
            normalize_observations=True,
            tau=0.005,
            min_replay_size=min_replay,
            max_replay_size=min(steps, 1_000_000),
            grad_updates_per_step=SAC_UPDATES,
            progress_fn=seen,
            checkpoint_logdir=folder,
            max_devices_per_host=1,
        )


def _struct(saved: Any) -> Any:
    """Make a normaliser of what the checkpoint gives, a dict or a struct."""
    return dataclasses.make_dataclass("Normalizer", saved)(**saved) if isinstance(saved, dict) else saved


TRAINERS = {"ppo": train_ppo, "sac": train_sac}


def main(args: Args) -> None:
    """Train and print."""
    start = time.perf_counter()

    def report(step: int, updates: int, policy: MlpController) -> None:
        summary = evaluate(policy, TaskConfig(), args.cases)
        print(
            f"{step:>9} steps, {updates:>6} updates, {time.perf_counter() - start:5.0f} s: reward"
            f" {summary.mean_reward:8.1f}, success {summary.success_rate:.1%}, not settled"
            f" {summary.non_settled_rate:.1%}, violated {summary.violation_rate:.1%}",
            flush=True,
        )

    TRAINERS[args.algorithm](args.steps, args.reports, args.seed, report, args.min_angle_deg)


if __name__ == "__main__":
    main(tyro.cli(Args))
