"""How this program was begun, so that what it says about itself can be typed again."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

# Files at the top of the repository that stand for a sub-command each.
_SCRIPTS = {"train": "train.py", "evaluate": "eval_mc.py", "fly": "fly.py"}


def command(name: str) -> str:
    """What to type for a sub-command: ``koz NAME``, ``python -m koz_jax NAME``, or the script that stands for it."""
    begun = Path(sys.argv[0])
    if begun.name in _SCRIPTS.values():
        return shlex.join(["python", str(begun.with_name(_SCRIPTS[name]))]) if name in _SCRIPTS else _module(name)
    if begun.name == "__main__.py" and begun.parent.name == "koz_jax":
        return _module(name)
    return f"koz {name}"


def typed(name: str, argv: Sequence[str]) -> str:
    """A sub-command with its arguments."""
    return shlex.join([*shlex.split(command(name)), *argv])


def _module(name: str) -> str:
    return f"python -m koz_jax {name}"
