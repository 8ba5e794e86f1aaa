"""Errors that a user can act on: the message names what was given, its value, and what is allowed."""

import reprlib

from pydantic import ValidationError


class KozError(Exception):
    """Base of all errors of this package that a user can act on."""

    ends_all_processes = False  # whether all of several processes end with it, see ``storage.processes.raise_in_all``


class SettingsError(KozError, ValueError):
    """A setting, an argument or an input cannot be used."""


class StorageError(KozError, OSError):
    """A file cannot be found, read or written."""


class DamagedFileError(StorageError):
    """A file is there, but does not hold what was once written."""


class MissingExtraError(KozError, ImportError):
    """An optional package is not installed."""


class PeerProcessError(KozError, RuntimeError):
    """Another one of several processes has failed, has ended, or does not answer."""


class DivergenceError(KozError, ArithmeticError):
    """Training came to numbers that are not finite."""


def missing_extra(error: ImportError, package: str, extra: str) -> MissingExtraError:
    """Say what to install when the import of an optional package failed.  extra: the one that brings the package."""
    found = (error.name or package).split(".")[0]
    return MissingExtraError(f"{found}: cannot be imported; install it with: pip install 'koz_jax[{extra}]' ({error})")


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
