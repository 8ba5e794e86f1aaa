"""Put the agents of a finished run into the package, for maintainers: ``python tools/ship.py RUN``.

Each agent is evaluated over 10,000 cases first, and keeps that table in its provenance.  With ``--name NAME`` only the
run's result is taken, under that name.
"""

import argparse
import dataclasses
import re
import sys
from pathlib import Path

from koz_jax.agents.agent import load_agent
from koz_jax.agents.record import find_agent, shipped_folder
from koz_jax.cli.exit_status import exit_status
from koz_jax.errors import SettingsError
from koz_jax.evaluation.monte_carlo import monte_carlo
from koz_jax.evaluation.summary import summarise, table
from koz_jax.storage import archive, runtime

_CASES = 10_000

# Where a run was on the machine that made it is nobody's business.
_RUN_FOLDER = re.compile(r"(--run[ =])(\S+)")


def ship(run: Path, into: Path, name: str | None = None) -> int:
    """Evaluate every agent of a run, or only its result, and write it into a folder of agents.  Returns 0.

    name: of the result; without it all agents keep their own.

    Raises:
        SettingsError: the run has no finished agents.

    """
    folders = {path.name: path for path in sorted((run / "agents").glob("[!.]*")) if archive.is_saved(path)}
    if not folders:
        raise SettingsError(f"run: {run} has no agents")
    for shipped, folder in ({name: find_agent(run)} if name else folders).items():
        agent = load_agent(folder)
        flown = monte_carlo(agent, _CASES)
        summary = summarise(flown.results)
        print(table(flown, name=shipped), end="\n\n")
        report = {"cases": _CASES, "seed": flown.config.seed, **dataclasses.asdict(summary)}
        command = _RUN_FOLDER.sub(rf"\g<1>runs/{run.name}", agent.provenance.command)
        provenance = agent.provenance.model_copy(update={"table": report, "command": command})
        dataclasses.replace(agent, provenance=provenance).save(into / shipped)
    return 0


def main(argv: list[str]) -> int:
    """Ship the agents of the run named on the command line.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="python tools/ship.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--name", help="take the run's result only, under this name")
    args = parser.parse_args(argv)
    runtime.configure()
    return exit_status(lambda: ship(args.run, shipped_folder(), args.name))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
