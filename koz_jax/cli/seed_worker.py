"""Train one of several seeds, as told on the standard input: ``runs.seeds`` begins one such process per core."""

import os
import signal
import sys
import threading
from pathlib import Path

from koz_jax.cli.exit_status import exit_status
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.seeds import STOPPED, Job
from koz_jax.runs.trainer import train
from koz_jax.storage import runtime


def work() -> int:
    """Train the run of a ``Job``.  Returns the exit status, ``STOPPED`` where the run was told to stop."""
    job = Job.model_validate_json(sys.stdin.read())
    threading.Thread(target=_stop_with, args=(job.parent,), daemon=True).start()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {job.core})
    runtime.configure()  # only now: the number of devices is that of the cores
    folder = RunFolder(Path(job.run))
    begun = folder.config.exists()
    agent = train(
        job.config,
        folder.path,
        resume=begun,
        start_from=None if begun else job.start_from,
        progress=False,
        command=job.command,
    )
    return 0 if agent is not None else STOPPED


def _stop_with(parent: int) -> None:
    """Wait for the end of the process that began this one, and then stop as if told to.  parent: end of a pipe."""
    os.read(parent, 1)
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    sys.exit(exit_status(work))
