"""The console command ``koz``: finds the sub-command, and imports nothing but that."""

import importlib
import os
import sys
from collections.abc import Sequence

from koz_jax.cli import invocation

# Sub-commands: what each does.  The module of the same name in this folder has its ``main``.
COMMANDS = {
    "train": "train an agent, or go on with a run",
    "evaluate": "fly an agent or another controller over many random cases; print the paper's table beside its own",
    "fly": "fly one maneuver and draw it",
    "view": "fly one maneuver with several agents, and write it as a 3-D page that opens offline",
    "export": "write an agent as C, ONNX or StableHLO",
    "tune": "tune the gains of a classical controller",
    "agents": "list the agents inside the package",
    "curves": "draw the learning curves of runs",
    "trim": "remove from finished runs what only a resume needs, which is most of their size",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a sub-command.  argv: by default what was typed.  Returns the exit status."""
    name, *others = [*(sys.argv[1:] if argv is None else argv)] or ["--help"]
    if name in COMMANDS:
        return importlib.import_module(f"koz_jax.cli.{name}").main(others)
    if name in ("-h", "--help"):
        return _tell(_usage())
    if name == "--version":
        from koz_jax.config.version import version

        return _tell(f"koz_jax {version()}")
    print(f"error: command: must be one of {', '.join(COMMANDS)}; got {name!r}", file=sys.stderr)
    return 2


def _tell(text: str) -> int:
    """Print a text.  Returns the exit status: 141 where nobody reads on, as in a shell."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        # Nor may Python's last flush complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return 0


def _usage() -> str:
    koz = invocation.command("").strip()
    width = max(map(len, COMMANDS))
    return "\n".join(
        [
            f"usage: {koz} COMMAND [OPTIONS]",
            "",
            "Keep-out-zone attitude control of a spacecraft, learned end to end.",
            "",
            *(f"  {name:{width}}  {text}" for name, text in COMMANDS.items()),
            "",
            f"{koz} COMMAND --help describes the options of a command.",
        ]
    )
