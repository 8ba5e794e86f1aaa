"""Training on several devices, of one process or of several: environments and replay buffer are divided among them,
networks are on each.

XLA makes the exchange between devices out of where the arrays lie; the training step itself knows nothing of it.  The
results are those of one device up to rounding, since sums over a batch are taken in another order.
"""

from itertools import groupby
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from koz_jax.config import TrainConfig
from koz_jax.errors import UserError
from koz_jax.training import TrainState

_AXIS = "environments"


def check(config: TrainConfig, devices: int) -> None:
    """Refuse a number of devices that there are not, or among which the environments cannot be divided.

    Raises:
        UserError: it cannot be.

    """
    present = len(jax.local_devices())
    if not 1 <= devices <= present:
        raise UserError(f"devices: must be from 1 to {present}, the devices that there are; got {devices}")
    processes = jax.process_count()
    if config.num_envs % (processes * devices):
        of_all = f" on each of {processes} processes" if processes > 1 else ""
        raise UserError(f"devices: must divide num_envs = {config.num_envs}; got {devices}{of_all}")


def _mesh(devices: int) -> Mesh:
    """The first devices of every process."""
    ordered = sorted(jax.devices(), key=lambda device: (device.process_index, device.id))
    by_process = groupby(ordered, lambda device: device.process_index)
    chosen = [device for _, its_own in by_process for device in list(its_own)[:devices]]
    return Mesh(np.array(chosen), (_AXIS,))


def _put(leaf: jax.Array, sharding: NamedSharding) -> jax.Array:
    """Put an array where it belongs; typed keys, which cannot be divided among processes, as their data."""
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jax.device_put(jax.random.key_data(leaf), sharding))
    return jax.device_put(leaf, sharding)


def place(state: TrainState, devices: int) -> TrainState:
    """Divide a training state among the first ``devices`` devices of every process; on a single one it stays as it is.

    The state is whole and the same in every process, or was placed before.
    """
    if devices * jax.process_count() == 1:
        return state
    mesh = _mesh(devices)

    def put(tree: Any, *axes: str | None) -> Any:
        return jax.tree.map(lambda leaf: _put(leaf, NamedSharding(mesh, PartitionSpec(*axes))), tree)

    return TrainState(
        learner=put(state.learner),
        buffer=put(state.buffer).replace(rows=put(state.buffer.rows, None, _AXIS)),
        env_states=put(state.env_states, _AXIS),
        key=put(state.key),
        updates=put(state.updates),
    )


def whole(tree: Any, devices: int) -> Any:
    """Bring something that ``place`` put on every device back to one, where evaluation can place it anew."""
    return tree if devices * jax.process_count() == 1 else jax.tree.map(jnp.asarray, jax.device_get(tree))


def gather(tree: Any) -> Any:
    """Make what is divided among processes whole in each of them, on one device.  All processes call it together."""

    def local(leaf: jax.Array) -> jax.Array:
        if leaf.is_fully_addressable:
            return leaf
        everywhere = NamedSharding(leaf.sharding.mesh, PartitionSpec())  # pyright: ignore[reportAttributeAccessIssue]
        return _put(leaf, everywhere).addressable_data(0)

    return jax.tree.map(local, tree)
