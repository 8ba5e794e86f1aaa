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

from koz_jax.config.training import TrainConfig
from koz_jax.errors import SettingsError
from koz_jax.learning.train_step import TrainState
from koz_jax.sac.replay_buffer import ReplayBuffer
from koz_jax.storage import processes, pytrees

_AXIS = "environments"


def check(config: TrainConfig, devices: int) -> None:
    """Refuse a number of devices that there are not, or among which the environments cannot be divided.

    Raises:
        SettingsError: it cannot be.

    """
    present = len(jax.local_devices())
    if not 1 <= devices <= present:
        raise SettingsError(f"devices: must be from 1 to {present}, the devices that there are; got {devices}")
    count = jax.process_count()
    if config.num_envs % (count * devices):
        of_all = f" on each of {count} processes" if count > 1 else ""
        raise SettingsError(f"devices: must divide num_envs = {config.num_envs}; got {devices}{of_all}")


def _mesh(devices: int) -> Mesh:
    """The first devices of every process."""
    ordered = sorted(jax.devices(), key=lambda device: (device.process_index, device.id))
    by_process = groupby(ordered, lambda device: device.process_index)
    chosen = [device for _, its_own in by_process for device in list(its_own)[:devices]]
    return Mesh(np.array(chosen), (_AXIS,))


def _put(tree: Any, sharding: NamedSharding) -> Any:
    """Put a pytree that every process has where it belongs; each keeps its own share."""

    def put(leaf: jax.Array | np.ndarray) -> jax.Array:
        if isinstance(leaf, jax.Array) and leaf.sharding == sharding:
            return leaf
        data = np.asarray(leaf)
        return jax.make_array_from_callback(data.shape, sharding, lambda index: data[index])

    return jax.tree.map(put, tree)


def place(state: TrainState, devices: int) -> TrainState:
    """Divide a training state among the first ``devices`` devices of every process; on a single one it stays as it is.

    The state is whole in every process, or was placed before.  What all devices have alike is that of the first process
    again: machines of other kinds round in other ways.
    """
    if devices * jax.process_count() == 1:
        return state
    mesh = _mesh(devices)
    everywhere, by_row, by_column = (
        NamedSharding(mesh, PartitionSpec(*axes)) for axes in ((), (_AXIS,), (None, _AXIS))
    )
    shared = (state.learner, state.buffer.head, state.buffer.size, state.updates, state.key)
    placed = all(leaf.sharding == everywhere for leaf in jax.tree.leaves(shared))
    if not placed or jax.process_count() > 1:
        *others, key_data = processes.broadcast_from_primary(pytrees.key_data(shared))
        if not placed:
            processes.connect(mesh)
        # Spelled as a training step spells it, which would be compiled for another spelling once more.
        key = jax.random.wrap_key_data(_put(key_data, NamedSharding(mesh, PartitionSpec(None))))
        shared = (*_put(others, everywhere), key)
    learner, head, size, updates, key = shared
    return TrainState(
        learner=learner,
        buffer=ReplayBuffer(rows=_put(state.buffer.rows, by_column), head=head, size=size),
        env_states=_put(state.env_states, by_row),
        key=key,
        updates=updates,
    )


def on_one_device(tree: Any, devices: int) -> Any:
    """Bring something that ``place`` put on every device back to one, where evaluation can place it anew."""
    return tree if devices * jax.process_count() == 1 else jax.tree.map(jnp.asarray, jax.device_get(tree))


def gather(tree: Any) -> Any:
    """Make what is divided among processes whole in each of them, typed keys as their data.  All call it together."""
    leaves, structure = jax.tree.flatten(pytrees.key_data(tree))
    divided = [leaf for leaf in leaves if not leaf.is_fully_addressable]
    gathered = iter(processes.gather(divided, divided[0].sharding.mesh) if divided else ())
    return structure.unflatten([leaf if leaf.is_fully_addressable else next(gathered) for leaf in leaves])
