"""Environment steps per second through every adapter.

python benchmarks/adapter_rates.py
"""

import time
from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from koz_jax.adapters import vector_env
from koz_jax.adapters.brax_env import ReorientationEnv, wrap_for_training
from koz_jax.adapters.gym_env import ENV_ID
from koz_jax.adapters.sb3_env import ReorientationVecEnv
from koz_jax.task.environment import Reorientation

ENVS = 1024


def steps_per_second(step: Callable[[], Any], envs: int, calls: int = 1100, repeats: int = 3) -> float:
    """Best of several runs, each with at least one reset of all environments."""
    step()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        for _ in range(calls):
            step()
        seconds.append(time.perf_counter() - start)
    return envs * calls / min(seconds)


def in_jax(envs: int, calls: int = 1100) -> float:
    """The core in one jitted loop, with no NumPy between the steps."""
    env = Reorientation.from_config()
    state, _ = vector_env.reset(env, jax.random.split(jax.random.key(0), envs), jnp.zeros(envs, jnp.int32))
    action = jnp.full((envs, 3), 0.1)

    def advance(carry: vector_env.VectorState, _: None) -> tuple[vector_env.VectorState, jax.Array]:
        after, stepped = vector_env.step(env, carry, action)
        return after, stepped.reward.sum() + stepped.observation.sum()

    loop = jax.jit(lambda state: jax.lax.scan(advance, state, None, length=calls))
    return calls * steps_per_second(lambda: jax.block_until_ready(loop(state)), envs, calls=1)


def by_brax(envs: int, calls: int = 1100) -> float:
    """brax's contract, wrapped for training, in one jitted loop."""
    wrapped = wrap_for_training(ReorientationEnv(), 1000)
    state = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), envs))
    action = jnp.full((envs, 3), 0.1)

    def advance(carry: Any, _: None) -> tuple[Any, jax.Array]:
        after: Any = wrapped.step(carry, action)
        return after, after.reward.sum() + after.obs.sum()

    loop = jax.jit(lambda state: jax.lax.scan(advance, state, None, length=calls))
    return calls * steps_per_second(lambda: jax.block_until_ready(loop(state)), envs, calls=1)


def rates() -> dict[str, float]:
    """Environment steps per second by adapter, at ``ENVS`` environments but for the single one."""
    single = gymnasium.make("koz_jax.adapters.gym_env:koz_jax/Reorientation-v0")
    vector, sb3 = gymnasium.make_vec(ENV_ID, num_envs=ENVS), ReorientationVecEnv(ENVS)
    single.reset(seed=0)
    vector.reset(seed=0)
    sb3.reset()
    action = np.full((ENVS, 3), 0.1, np.float32)

    def step_single() -> None:
        if single.step(action[0])[3]:
            single.reset()

    return {
        "core, jitted loop": in_jax(ENVS),
        "brax, jitted loop": by_brax(ENVS),
        "Gymnasium vector": steps_per_second(lambda: vector.step(action), ENVS),
        "Stable-Baselines3 VecEnv": steps_per_second(lambda: sb3.step(action), ENVS),
        "Gymnasium single": steps_per_second(step_single, 1),
    }


def main() -> None:
    """Print the rates."""
    for name, rate in rates().items():
        print(f"{name}: {rate:,.0f} environment steps/s")


if __name__ == "__main__":
    main()
