"""What a controller is: a trained agent, a classical law, or an adversary that tries the shield."""

from typing import Any, Protocol

import jax
from flax import struct

from koz_jax.config.task import TaskConfig
from koz_jax.task.state import EnvState, Model

Memory = Any  # a pytree of fixed shapes: what a controller remembers from one step to the next


class Controller(Protocol):
    """What flies the spacecraft.  Implementations are pytrees, so that new weights do not mean a new compilation."""

    def begin(self, state: EnvState, model: Model, key: jax.Array) -> Memory:
        """Prepare for a maneuver.  key: () typed PRNG key, for controllers that draw at random."""
        ...

    def decide(self, state: EnvState, model: Model, memory: Memory) -> tuple[jax.Array, Memory]:
        """Action (3,) in [-1, 1] for the state as it is measured, and what to remember."""
        ...


class TaskController(Protocol):
    """A controller with a name, and the task that it was made for."""

    @property
    def name(self) -> str:
        """What to call it in tables."""
        ...

    @property
    def task(self) -> TaskConfig:
        """What it was made for."""
        ...

    @property
    def controller(self) -> Controller:
        """What flies."""
        ...


class Memoryless(struct.PyTreeNode):
    """Base of controllers that decide by the state alone."""

    def begin(self, state: EnvState, model: Model, key: jax.Array) -> None:
        """Nothing to prepare."""
        return
