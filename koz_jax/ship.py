"""Put the agents of a finished run into the package: ``python -m koz_jax.ship RUN``.

Each agent is judged over 10,000 cases first, and keeps that table in its provenance.  With ``--name NAME`` only the
run's result is taken, under that name.
"""

import argparse
import dataclasses
import sys
from pathlib import Path

from koz_jax import evaluation, runtime, storage
from koz_jax.agent import find_agent, load_agent, shipped_folder
from koz_jax.errors import UserError, exit_status
from koz_jax.summary import summarise, table

_CASES = 10_000


def ship(run: Path, into: Path, name: str | None = None) -> int:
    """Judge every agent of a run, or only its result, and write it into a folder of agents.  Returns the exit status 0.

    name: of the result; without it all agents keep their own.

    Raises:
        UserError: the run has no finished agents.

    """
    folders = {path.name: path for path in sorted((run / "agents").glob("[!.]*")) if storage.is_saved(path)}
    if not folders:
        raise UserError(f"run: {run} has no agents")
    for shipped, folder in ({name: find_agent(run)} if name else folders).items():
        agent = load_agent(folder)
        flown = evaluation.monte_carlo(agent, _CASES)
        summary = summarise(flown.results)
        print(table(summary, _CASES, shipped), end="\n\n")
        report = {"cases": _CASES, "seed": flown.config.seed, **dataclasses.asdict(summary)}
        provenance = agent.provenance.model_copy(update={"table": report})
        dataclasses.replace(agent, provenance=provenance).save(into / shipped)
    return 0


def main(argv: list[str]) -> int:
    """Ship the agents of the run named on the command line.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m koz_jax.ship", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument("--name", help="take the run's result only, under this name")
    args = parser.parse_args(argv)
    runtime.configure()
    return exit_status(lambda: ship(args.run, shipped_folder(), args.name))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
