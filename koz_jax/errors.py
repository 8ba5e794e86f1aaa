"""Errors that a user can act on, and how the command lines show them: a line each, without a traceback."""

import os
import reprlib
import sys
from collections.abc import Callable

from pydantic import ValidationError


class UserError(ValueError):
    """Something the user gave cannot be used; the message names it, its value, and what is allowed."""

    agreed = False  # whether all of several processes end with it (see ``processes.raise_together``)


def warn(text: str) -> None:
    """Say on stderr what went wrong without ending the work."""
    print(f"warning: {text}", file=sys.stderr, flush=True)


def explain(error: ValidationError) -> str:
    """One line per bad setting: its name, what is wrong, and the value given."""
    lines = []
    for problem in error.errors():
        name = ".".join(str(part) for part in problem["loc"])
        message = problem["msg"].removeprefix("Value error, ")
        # Checks over several fields carry the whole section as input, and name the values in their message.
        value = "" if isinstance(problem["input"], dict) or not name else f" (got {reprlib.repr(problem['input'])})"
        lines.append(f"{name}: {message}{value}" if name else message)
    return "\n".join(lines)


def exit_status(command: Callable[[], int]) -> int:
    """Run a command line.  Returns its exit status; as in a shell, 130 after Ctrl-C and 141 when nobody reads on."""
    try:
        return command()
    except (ValidationError, UserError) as error:
        message = explain(error) if isinstance(error, ValidationError) else str(error)
        print("\n".join(f"error: {line}" for line in message.splitlines()), file=sys.stderr)
        if isinstance(error, UserError) and error.agreed:
            return 2
        return _alone(2)
    except BrokenPipeError:
        # The reader of the output has left (``train.py --help | head``); nor may Python's last flush complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _alone(141)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return _alone(130)


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
