"""A number that is none, put into reward, observation, parameters and gradients of a run: it must be named."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp

from koz_jax.config.training import TrainConfig
from koz_jax.errors import DivergenceError
from koz_jax.learning import train_step
from koz_jax.learning.train_step import TrainState
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.trainer import train
from koz_jax.sac import losses

_AT = 64  # updates


def _parameters(state: TrainState) -> TrainState:
    leaves, structure = jax.tree.flatten(state.learner.policy)
    leaves[0] = leaves[0].at[0].set(math.nan)
    return state.replace(learner=state.learner.replace(policy=jax.tree.unflatten(structure, leaves)))


def _observation(state: TrainState) -> TrainState:
    body = state.env_states.body
    body = body.replace(omega_BN_B=body.omega_BN_B.at[0, 0].set(math.nan))
    return state.replace(env_states=state.env_states.replace(body=body))


def _in_state(change: Callable[[TrainState], TrainState]) -> Any:
    train_chunk = train_step.train_chunk

    def changed(config: TrainConfig, state: TrainState, steps: jax.Array) -> Any:
        return train_chunk(config, change(state) if int(state.updates) == _AT else state, steps)

    return mock.patch.object(train_step, "train_chunk", changed)


def _in_reward() -> Any:
    terms = train_step.reward.terms

    def changed(*args: Any) -> Any:
        found = terms(*args)
        return found.replace(attitude=jnp.where(found.attitude > -1.0, math.nan, 0.0))

    return mock.patch.object(train_step.reward, "terms", changed)


def _in_gradient() -> Any:
    critic_loss = losses.critic_loss

    def changed(q: jax.Array, target: jax.Array) -> jax.Array:
        return critic_loss(q, target) + jnp.sqrt(jnp.sum(0.0 * q))  # the square root has no slope at zero

    return mock.patch.object(losses, "critic_loss", changed)


FAULTS: dict[str, tuple[Callable[[], Any], str]] = {
    "parameters": (lambda: _in_state(_parameters), "parameters"),
    "observation": (lambda: _in_state(_observation), "observation"),
    "reward": (_in_reward, "reward/attitude"),
    "gradients": (_in_gradient, "train/critic_gradient"),
}


def faults(config: TrainConfig, work: Path) -> tuple[str, bool]:
    """Train with each fault.  Returns a line of text, and whether all were named and none was saved."""
    found, sound = [], True
    for seed, (name, (fault, expected)) in enumerate(FAULTS.items(), start=9000):
        folder = RunFolder(work / f"fault-{name}")
        # Another seed is another program, compiled with the fault in it.
        chosen = config.model_copy(update={"seed": seed})
        message = "not noticed"
        with fault():
            try:
                train(chosen, folder.path, progress=False)
            except DivergenceError as error:
                message = str(error).split(":")[0]
        newest = int(folder.checkpoints()[0].name)
        found.append(f"{name}: {message!r}, newest checkpoint {newest}")
        sound &= message == expected and newest <= _AT
    return "; ".join(found), sound
