"""Put the agents of a finished run into the package: ``python -m koz_jax.ship RUN``.

Each agent is judged over 10,000 cases first, and keeps that table in its provenance.
"""

import argparse
import dataclasses
import sys
from pathlib import Path

from koz_jax import evaluation, runtime, storage
from koz_jax.agent import load_agent, shipped_folder
from koz_jax.errors import UserError, exit_status
from koz_jax.summary import summarise, table

_CASES = 10_000


def ship(run: Path, into: Path) -> int:
    """Judge every agent of a run and write it into a folder of agents.  Returns the exit status 0.

    Raises:
        UserError: the run has no finished agents.

    """
    folders = sorted(path for path in (run / "agents").glob("[!.]*") if storage.is_saved(path))
    if not folders:
        raise UserError(f"run: {run} has no agents")
    for folder in folders:
        agent = load_agent(folder)
        flown = evaluation.monte_carlo(agent, _CASES)
        summary = summarise(flown.results)
        print(table(summary, _CASES, folder.name), end="\n\n")
        report = {"cases": _CASES, "seed": flown.config.seed, **dataclasses.asdict(summary)}
        provenance = agent.provenance.model_copy(update={"table": report})
        dataclasses.replace(agent, provenance=provenance).save(into / folder.name)
    return 0


def main(argv: list[str]) -> int:
    """Ship the agents of the run named on the command line.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m koz_jax.ship", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a finished run")
    run = parser.parse_args(argv).run
    runtime.configure()
    return exit_status(lambda: ship(run, shipped_folder()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
