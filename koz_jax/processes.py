"""Several processes that work together (``runtime.join``): what they must agree on, and which of them writes.

With one process everything here is plain: it leads, and nothing is exchanged.
"""

import contextlib
import hashlib
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from koz_jax.errors import UserError

Result = TypeVar("Result")


def leads() -> bool:
    """Whether this process is the first, which writes and prints for all."""
    return jax.process_index() == 0


def any_of(flag: bool) -> bool:
    """Whether the flag is up in any process; waits until all have said so."""
    return bool(_of_all(np.bool_(flag)).any())


def from_first(tree: Any) -> Any:
    """Replace a pytree of arrays by that of the first process, in NumPy; all have the same shapes and types."""
    return jax.tree.map(lambda stacked: stacked[0], _of_all(tree))


def _of_all(tree: Any) -> Any:
    """Stack what every process has, leaf by leaf.  Waits for all of them."""
    mine = jax.tree.map(lambda leaf: np.asarray(leaf)[None], tree)
    if jax.process_count() == 1:
        return mine
    mesh = Mesh(np.array([jax.local_devices(process)[0] for process in range(jax.process_count())]), ("processes",))
    divided = NamedSharding(mesh, PartitionSpec("processes"))
    return whole(jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(divided, leaf), mine), mesh)


def connect(mesh: Mesh) -> None:
    """Connect the devices of a mesh now, while all processes are there.

    They would be connected in their first exchange, but for that a process on CPUs waits half a minute at most, and
    another may have to compile for longer.  Later exchanges wait for half an hour.
    """
    sharding = NamedSharding(mesh, PartitionSpec(mesh.axis_names))
    whole(jax.make_array_from_callback((mesh.size,), sharding, lambda index: np.zeros(mesh.size)[index]), mesh)


def whole(tree: Any, mesh: Mesh) -> Any:
    """Make a pytree whose leaves are divided among the devices of a mesh whole, as NumPy arrays, in every process."""
    with exchange():
        copies = finished(jax.jit(_same, out_shardings=NamedSharding(mesh, PartitionSpec()))(tree))
    return jax.tree.map(lambda leaf: np.asarray(leaf.addressable_data(0)), copies)


def _same(tree: Any) -> Any:
    return tree


@contextlib.contextmanager
def exchange() -> Iterator[None]:
    """Say it in one line when another process does not take part in an exchange.

    Raises:
        UserError: it has ended, or was waited for in vain.

    """
    try:
        yield
    except (ValueError, jax.errors.JaxRuntimeError) as error:
        if "Gloo" not in str(error):
            raise
        reason = str(error).splitlines()[0]
        raise UserError(f"processes: another process has ended, or does not answer: {reason}") from None


def finished(tree: Any) -> Any:
    """Wait until all devices of this process have computed a pytree, and return it.

    A device that is ahead must not begin the next exchange while its neighbour still has to begin this one: processes
    whose devices take them in different orders wait for each other for ever.
    """
    return jax.block_until_ready(tree)


def raise_together(error: UserError | None) -> None:
    """Raise the error of this process, or say that another process has one.

    Raises:
        UserError: there is an error in any process.

    """
    if any_of(error is not None):
        error = error or UserError("processes: another process has failed, and says why; this one ends with it")
        error.agreed = True
        raise error


def require_same(name: str, value: Any) -> None:
    """Refuse to work together on different things.

    Args:
        name: of the value, for the message.
        value: what must be the same in all processes; its text counts.

    Raises:
        UserError: it is not.

    """
    digest = np.frombuffer(hashlib.sha256(repr(value).encode()).digest(), np.uint8)
    same = np.array_equal(digest, from_first(digest))
    this = f"process {jax.process_index()} has another than the first"
    raise_together(None if same else UserError(f"{name}: must be the same in all processes, but {this}"))


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
