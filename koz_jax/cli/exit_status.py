"""How command lines end: errors that a user can act on as a line each, without a traceback."""

import contextlib
import logging
import os
import sys
from collections.abc import Callable, Iterator

from pydantic import ValidationError

from koz_jax.errors import KozError, explain


class _ToStderr(logging.Handler):
    """Warnings of the package, each in a line."""

    def emit(self, record: logging.LogRecord) -> None:
        print(f"warning: {record.getMessage()}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def _warnings_shown() -> Iterator[None]:
    logger, handler = logging.getLogger("koz_jax"), _ToStderr(logging.WARNING)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def exit_status(command: Callable[[], int]) -> int:
    """Run a command line.  Returns its exit status; as in a shell, 130 after Ctrl-C and 141 when nobody reads on."""
    try:
        with _warnings_shown():
            return command()
    except (ValidationError, KozError) as error:
        message = explain(error) if isinstance(error, ValidationError) else str(error)
        print("\n".join(f"error: {line}" for line in message.splitlines()), file=sys.stderr)
        if isinstance(error, KozError) and error.ends_all_processes:
            return 2
        return _alone(2)
    except (AssertionError, RuntimeError):
        missing = _missing_platform()
        if missing is None:
            raise
        print(f"error: {missing}", file=sys.stderr)
        return _alone(2)
    except BrokenPipeError:
        # The reader of the output has left (``koz train --help | head``); nor may Python's last flush complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _alone(141)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return _alone(130)


def _missing_platform() -> str | None:
    """Say in a line that jax finds nothing of the kind of device that JAX_PLATFORMS asks for; None if it does."""
    jax = sys.modules.get("jax")
    asked = None if jax is None else jax.config.jax_platforms
    if jax is None or not asked:
        return None
    try:
        jax.devices()
    except (AssertionError, RuntimeError) as error:  # the former where the plugin of the platform is not installed
        reason = (str(error).splitlines() or ["no plugin for it is installed; for GPUs: pip install 'koz_jax[cuda]'"])[
            0
        ]
        return f"JAX_PLATFORMS: {asked!r} cannot be used ({reason}); unset it to run on what there is"
    return None


def _alone(status: int) -> int:
    """Return a status that this process ends with alone; if it is one of several (``runtime.join``), end at once.

    The others may be waiting for it, and at the end of Python it would wait for them.
    """
    jax = sys.modules.get("jax")
    if jax is not None and jax.distributed.is_initialized():
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status
