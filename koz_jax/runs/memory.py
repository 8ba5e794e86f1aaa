"""What a training run needs of the host's memory, against what is free: refused before XLA runs out of it."""

import contextlib
import dataclasses
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

from koz_jax.config.training import TrainConfig
from koz_jax.errors import SettingsError
from koz_jax.storage import pytrees

# While a checkpoint is written, the state exists a second time.
_COPIES = 2
_FLOAT = 4  # bytes

_CGROUP_FILES = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


@dataclasses.dataclass(frozen=True)
class MemoryEstimate:
    """Memory that grows with one setting."""

    field: str
    size: int  # [bytes]


def available() -> int | None:
    """Free memory of the host, or of the container that this process runs in [bytes]; None where it is not told."""
    free = [limit - used for limit, used in map(_cgroup, _CGROUP_FILES) if limit is not None and used is not None]
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                free.append(1024 * int(line.split()[1]))
    except (OSError, ValueError):
        if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
            free.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return min(free, default=None)


def _cgroup(files: tuple[str, str]) -> tuple[int | None, int | None]:
    try:
        limit, used = (int(Path(file).read_text(encoding="ascii")) for file in files)
    except (OSError, ValueError):  # there is none, or it is "max"
        return None, None
    return limit, used


def size_of(tree: Any) -> int:
    """Memory of a pytree of arrays or shape structs [bytes]."""
    shapes = jax.eval_shape(pytrees.key_data, tree)
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))


def needs(config: TrainConfig, buffer: Any, state: Any) -> list[MemoryEstimate]:
    """Estimate what a run takes, largest parts only.  buffer, state: the replay buffer, the whole state; or shapes."""
    held = size_of(buffer)
    row = held / (config.buffer_steps * config.num_envs)
    drawn = config.updates_per_step * config.sac.batch_size
    units = sum(config.network.hidden_sizes)
    needed = [
        MemoryEstimate("sac.buffer_size", _COPIES * held),
        MemoryEstimate("network.hidden_sizes", _COPIES * (size_of(state) - held)),
        MemoryEstimate("num_envs", int(4 * row * config.num_envs) + _FLOAT * units * config.num_envs),
        MemoryEstimate(
            "sac.batch_size", int(2 * row * drawn * config.sac.n_step) + 8 * _FLOAT * units * config.sac.batch_size
        ),
        MemoryEstimate("prefill_steps", 3 * _FLOAT * config.prefill_steps),
        MemoryEstimate("eval_cases", 32 * _FLOAT * config.eval_cases),
    ]
    if config.refine.iterations:
        # Back-propagation keeps every layer's output at every step.
        flown = config.refine.scenarios * config.refine_steps
        needed.append(MemoryEstimate("refine.scenarios", 2 * _FLOAT * units * flown))
    return needed


def check(config: TrainConfig, buffer: Any, state: Any) -> None:
    """Refuse a run that does not fit into memory.

    Raises:
        SettingsError: it does not; the message names the setting that takes most.

    """
    free = available()
    needed = needs(config, buffer, state)
    total = sum(need.size for need in needed)
    if free is not None and total > free:
        worst = max(needed, key=lambda need: need.size)
        value = _setting(config, worst.field)
        raise SettingsError(
            f"{worst.field}: must be smaller, got {value}; it takes about {_gib(worst.size)} of the {_gib(total)} of"
            f" memory that the run needs, and {_gib(free)} are free (a checkpoint being written is a second copy)"
        )


@contextlib.contextmanager
def exhaustion_in_one_line() -> Iterator[None]:
    """Say in one line that a device ran out of memory.

    Raises:
        SettingsError: it did; the message names the settings that take most.

    """
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error) and "Out of memory" not in str(error):
            raise
        raise SettingsError(
            "out of memory: make num_envs, sac.buffer_size, sac.batch_size, network.hidden_sizes, eval_cases or"
            f" refine.scenarios smaller; {str(error).splitlines()[0]}"
        ) from None


def _setting(config: TrainConfig, field: str) -> Any:
    """Value of a setting by its full name, such as ``sac.buffer_size``."""
    value: Any = config
    for name in field.split("."):
        value = getattr(value, name)
    return value


def _gib(size: int) -> str:
    return f"{size / 2**30:.3g} GiB"
