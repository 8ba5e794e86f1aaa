"""Process-wide settings of jax for the command lines; libraries and notebooks are left alone."""

import os
import socket
import sys
import time
from pathlib import Path
from types import TracebackType

import jax

from koz_jax.errors import SettingsError
from koz_jax.storage.processes import any_process

# [s] in which processes must find each other
_WAIT_S = 300.0


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
    if not keeps_programs():
        root = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
        for name, value in {
            "jax_compilation_cache_dir": str(root / "koz_jax" / "compiled"),
            "jax_persistent_cache_min_compile_time_secs": 0.3,
        }.items():
            jax.config.update(name, value)
            os.environ[name.upper()] = str(value)


def keeps_programs() -> bool:
    """Whether compiled programs are kept."""
    return jax.config.jax_compilation_cache_dir is not None  # pyright: ignore[reportAttributeAccessIssue]


def join(coordinator: str, processes: int, process: int) -> None:
    """Make this process one of several that work together, on this machine or on many.

    Call after ``configure`` and before anything touches a device.  A process that ends waits up to five minutes for the
    others.  An exception that nobody catches ends it at once (as does ``cli.exit_status`` where processes have not
    agreed to end), and the others at their next exchange.

    Args:
        coordinator: address of the first process, as host:port.
        processes: how many there are.
        process: the number of this one.

    Raises:
        SettingsError: the others are not found.

    """
    host, _, port = coordinator.rpartition(":")
    if process == 0:
        _check_free(int(port))
    else:
        _await(host, int(port))
    # It would take SIGTERM, and do nothing.
    jax.config.update("jax_enable_preemption_service", False)
    try:
        jax.distributed.initialize(coordinator, processes, process)
    except (RuntimeError, ValueError) as error:
        raise SettingsError(f"coordinator: {coordinator} cannot be joined: {str(error).splitlines()[0]}") from None
    sys.excepthook = _leave
    any_process(False)  # connects them, see ``processes.connect``


def _check_free(port: int) -> None:
    """Refuse a port that the first process cannot listen on: jax would crash."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("", port))
        except OSError as error:
            raise SettingsError(f"coordinator: port {port} cannot be listened on: {error.strerror}") from None


def _await(host: str, port: int) -> None:
    """Wait until the first process listens, for as long as jax would before it aborts."""
    deadline = time.monotonic() + _WAIT_S
    while True:
        try:
            socket.create_connection((host, port), timeout=5.0).close()
            return
        except socket.gaierror:
            raise SettingsError(f"coordinator: there is no host {host!r}") from None
        except OSError as error:
            if time.monotonic() > deadline:
                reason = error.strerror or str(error)
                raise SettingsError(
                    f"coordinator: nobody answers at {host}:{port} for {_WAIT_S:g} s: {reason}"
                ) from None
            time.sleep(0.2)


def _leave(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Show an exception and end, without waiting for the others: they may be waiting for this process."""
    sys.__excepthook__(kind, error, trace)
    sys.stderr.flush()
    os._exit(1)
