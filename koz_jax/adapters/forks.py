"""jax does not live through a fork: after one, its first computation waits for ever for threads that are gone.

A process that was forked before jax had begun to compute is as good as any other.
"""

import os

from jax._src import xla_bridge

from koz_jax.errors import SettingsError

_LEFT_BEHIND = False  # whether jax had begun to compute in the process that this one was forked from


def refuse_in_fork() -> None:
    """Refuse to compute where jax would hang.

    Raises:
        SettingsError: this process was forked from one in which jax had computed.

    """
    if _LEFT_BEHIND:
        raise SettingsError(
            "processes: must be spawned, not forked, because jax hangs after a fork; for Gymnasium:"
            ' make_vec(..., vectorization_mode="async", vector_kwargs={"context": "spawn"}), for Stable-Baselines3:'
            ' SubprocVecEnv(..., start_method="spawn")'
        )


def _after_fork() -> None:
    global _LEFT_BEHIND
    _LEFT_BEHIND = _LEFT_BEHIND or xla_bridge.backends_are_initialized()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
