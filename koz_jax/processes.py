"""Several processes that work together (``runtime.join``): what they must agree on, and which of them writes.

With one process everything here is plain: it leads, and nothing is exchanged.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

from koz_jax.errors import UserError

Result = TypeVar("Result")


def leads() -> bool:
    """Whether this process is the first, which writes and prints for all."""
    return jax.process_index() == 0


def any_of(flag: bool) -> bool:
    """Whether the flag is up in any process; waits until all have said so."""
    if jax.process_count() == 1:
        return flag
    return bool(np.any(multihost_utils.process_allgather(np.bool_(flag))))


def from_first(value: float) -> float:
    """The first process's value, in float32, in every process."""
    if jax.process_count() == 1:
        return value
    return float(multihost_utils.broadcast_one_to_all(np.float32(value)))


def raise_together(error: UserError | None) -> None:
    """Raise the error of this process, or say that another process has one.

    Raises:
        UserError: there is an error in any process.

    """
    if any_of(error is not None):
        raise error or UserError("processes: another process has failed, and says why; this one ends with it")


def together(work: Callable[[], Result]) -> Result:
    """Do something in every process; what fails in one fails in all.

    Raises:
        UserError: it failed.

    """
    try:
        result = work()
    except UserError as error:
        raise_together(error)
        raise
    raise_together(None)
    return result
