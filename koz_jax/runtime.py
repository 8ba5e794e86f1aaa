"""Process-wide settings of jax for the command lines; libraries and notebooks are left alone."""

import os
import sys
from pathlib import Path
from types import TracebackType

import jax

from koz_jax.errors import UserError
from koz_jax.processes import any_of


def configure() -> None:
    """Use every CPU core as a device for evaluation, and keep compiled programs.

    Call before anything touches a device.
    """
    jax.config.update(
        "jax_num_cpu_devices", len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    )
    keep_programs()


def keep_programs() -> None:
    """Keep compiled programs from one run to the next, also for the processes that this one starts."""
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        root = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
        for name, value in {
            "jax_compilation_cache_dir": str(root / "koz_jax" / "compiled"),
            "jax_persistent_cache_min_compile_time_secs": 0.3,
        }.items():
            jax.config.update(name, value)
            os.environ[name.upper()] = str(value)


def join(coordinator: str, processes: int, process: int) -> None:
    """Make this process one of several that work together, on this machine or on many.

    Call after ``configure`` and before anything touches a device.  A process that ends waits up to five minutes for the
    others.  An exception that nobody catches ends it at once, and the others when they notice, within two minutes.

    Args:
        coordinator: address of the first process, as host:port.
        processes: how many there are.
        process: the number of this one.

    Raises:
        UserError: the others are not found.

    """
    try:
        jax.distributed.initialize(coordinator, processes, process)
    except (RuntimeError, ValueError) as error:
        raise UserError(f"coordinator: {coordinator} cannot be joined: {str(error).splitlines()[0]}") from None
    sys.excepthook = _leave
    any_of(False)  # connects them, see ``processes.connect``


def _leave(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Show an exception and end, without waiting for the others: they may be waiting for this process."""
    sys.__excepthook__(kind, error, trace)
    sys.stderr.flush()
    os._exit(1)
