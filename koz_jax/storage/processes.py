"""Several processes that work together (``runtime.join``): what they must agree on, and which of them writes.

With one process everything here is plain: it is the primary one, and nothing is exchanged.
"""

import contextlib
import hashlib
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from koz_jax.errors import KozError, PeerProcessError, SettingsError

Result = TypeVar("Result")


def is_primary_process() -> bool:
    """Whether this process is number 0, which writes and prints for all."""
    return jax.process_index() == 0


def any_process(flag: bool) -> bool:
    """Whether the flag is up in any process; waits until all have said so."""
    return bool(_stack_of_all(np.bool_(flag)).any())


def broadcast_from_primary(tree: Any) -> Any:
    """Replace a pytree of arrays by that of process 0, in NumPy; all have the same shapes and types."""
    return jax.tree.map(lambda stacked: stacked[0], _stack_of_all(tree))


def _stack_of_all(tree: Any) -> Any:
    """Stack what every process has, leaf by leaf.  Waits for all of them."""
    mine = jax.tree.map(lambda leaf: np.asarray(leaf)[None], tree)
    if jax.process_count() == 1:
        return mine
    mesh = Mesh(np.array([jax.local_devices(process)[0] for process in range(jax.process_count())]), ("processes",))
    divided = NamedSharding(mesh, PartitionSpec("processes"))
    return gather(jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(divided, leaf), mine), mesh)


def connect(mesh: Mesh) -> None:
    """Connect the devices of a mesh now, while all processes are there.

    They would be connected in their first exchange, but for that a process on CPUs waits half a minute at most, and
    another may have to compile for longer.  Later exchanges wait for half an hour.
    """
    sharding = NamedSharding(mesh, PartitionSpec(mesh.axis_names))
    gather(jax.make_array_from_callback((mesh.size,), sharding, lambda index: np.zeros(mesh.size)[index]), mesh)


def gather(tree: Any, mesh: Mesh) -> Any:
    """Make a pytree whose leaves are divided among the devices of a mesh whole, as NumPy arrays, in every process."""
    with collective_errors():
        copies = wait_for_devices(jax.jit(_same, out_shardings=NamedSharding(mesh, PartitionSpec()))(tree))
    return jax.tree.map(lambda leaf: np.asarray(leaf.addressable_data(0)), copies)


def _same(tree: Any) -> Any:
    return tree


@contextlib.contextmanager
def collective_errors() -> Iterator[None]:
    """Say it in one line when another process does not take part in a collective operation.

    Raises:
        PeerProcessError: it has ended, or was waited for in vain.

    """
    try:
        yield
    except (ValueError, jax.errors.JaxRuntimeError) as error:
        if "Gloo" not in str(error):
            raise
        reason = str(error).splitlines()[0]
        raise PeerProcessError(f"processes: another process has ended, or does not answer: {reason}") from None


def wait_for_devices(tree: Any) -> Any:
    """Wait until all devices of this process have computed a pytree, and return it.

    A device that is ahead must not begin the next collective operation while its neighbour still has to begin this one:
    processes whose devices take them in different orders wait for each other for ever.
    """
    return jax.block_until_ready(tree)


def raise_in_all(error: KozError | None) -> None:
    """Raise the error of this process, or say that another process has one.

    Raises:
        KozError: there is an error in this process.
        PeerProcessError: there is one in another process.

    """
    if any_process(error is not None):
        error = error or PeerProcessError("processes: another process has failed, and says why; this one ends with it")
        error.ends_all_processes = True
        raise error


def assert_equal_across_processes(name: str, value: Any) -> None:
    """Refuse to work together on different things.

    Args:
        name: of the value, for the message.
        value: what must be the same in all processes; its text counts.

    Raises:
        SettingsError: it is not the same here as in process 0.
        PeerProcessError: it is not in another process.

    """
    digest = np.frombuffer(hashlib.sha256(repr(value).encode()).digest(), np.uint8)
    same = np.array_equal(digest, broadcast_from_primary(digest))
    this = f"process {jax.process_index()} has another than the first"
    raise_in_all(None if same else SettingsError(f"{name}: must be the same in all processes, but {this}"))


def all_or_none(work: Callable[[], Result]) -> Result:
    """Do something in every process; what fails in one fails in all.

    Raises:
        KozError: it failed here.
        PeerProcessError: it failed in another process.

    """
    try:
        result = work()
    except KozError as error:
        raise_in_all(error)
        raise
    raise_in_all(None)
    return result
