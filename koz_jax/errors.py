"""Errors that a user can act on.  The command lines print them without a traceback."""

from pydantic import ValidationError


class UserError(ValueError):
    """Something the user gave cannot be used; the message names it, its value, and what is allowed."""


def explain(error: ValidationError) -> str:
    """One line per bad setting: its name, what is wrong, and the value given."""
    lines = []
    for problem in error.errors():
        name = ".".join(str(part) for part in problem["loc"])
        message = problem["msg"].removeprefix("Value error, ")
        # Checks over several fields carry the whole section as input, and name the values in their message.
        value = "" if isinstance(problem["input"], dict) or not name else f" (got {problem['input']!r})"
        lines.append(f"{name}: {message}{value}" if name else message)
    return "\n".join(lines)
