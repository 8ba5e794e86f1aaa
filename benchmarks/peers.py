"""The same task, the same machine, other libraries: who learns it in how long.

    python benchmarks/peers.py --minutes 5

Trains every peer for so many minutes, one after another, and writes ``docs/peers.json`` and the tables of
``docs/peers.md``.  Results of peers that are not asked for are kept from the JSON of before.  Needs extra ``peers``.
"""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import adapter_rates
import tyro
from peer_record import PeerResult, rows
from peer_report import Report, markdown

from koz_jax.storage import files

NAMES = ("koz_jax", "SB3 SAC", "SBX SAC", "brax SAC", "brax PPO", "SB3 TD3", "SB3 DDPG")


@dataclasses.dataclass(frozen=True)
class Args:
    """Train every peer for the same time on the same environment, and write the tables."""

    minutes: float = 5.0
    """Training time of each peer."""
    peers: tuple[str, ...] = NAMES
    """Which peers to train now; with none, only the tables are written anew."""
    cases: int = 10_000
    """Cases of the final Monte Carlo."""
    out: Path = Path("docs")
    """Folder of peers.json and peers.md."""
    worker: str = ""
    """Used by this command itself: train one peer in this process, print its result."""


def work(name: str, args: Args) -> PeerResult:
    """Train one peer in this process."""
    import peer_runs

    before = os.getloadavg()[0]
    run = peer_runs.RUNS[name](args.minutes)
    after = os.getloadavg()[0]
    return PeerResult(
        name=name,
        recipe=run.recipe,
        version=run.version,
        minutes=args.minutes,
        cores=len(os.sched_getaffinity(0)),
        load_before=before,
        load_after=after,
        points=tuple(run.points),
        updates_per_second=run.updates_per_second,
        cases=args.cases,
        table=rows(peer_runs.final_table(run.controller, args.cases)),
    )


def in_process(name: str, args: Args) -> PeerResult:
    """Train one peer in a process of its own, so that none finds the memory or the threads of another."""
    options = ["--worker", name, "--minutes", str(args.minutes), "--cases", str(args.cases)]
    command = [sys.executable, __file__, *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        last = ""
        for last in process.stdout:
            if not last.startswith("{"):
                print(last, end="", flush=True)
    if process.returncode:
        raise SystemExit(f"peers: {name} failed")
    return PeerResult.model_validate_json(last)


def main(args: Args) -> None:
    """Train, write the JSON after every peer, and the tables."""
    if args.worker:
        print(work(args.worker, args).model_dump_json())
        return
    unknown = [name for name in args.peers if name not in NAMES]
    if unknown:
        raise SystemExit(f"peers: unknown {', '.join(unknown)}; allowed: {', '.join(NAMES)}")
    saved = args.out / "peers.json"
    before = Report.model_validate_json(saved.read_text()) if saved.exists() else Report()
    report = before.model_copy(update={"environment": adapter_rates.rates()}) if args.peers else before
    for name in args.peers:
        print(name, flush=True)
        found = {result.name: result for result in report.results} | {name: in_process(name, args)}
        report = report.model_copy(update={"results": tuple(found[peer] for peer in NAMES if peer in found)})
        files.write_text(saved, json.dumps(report.model_dump(mode="json"), indent=1) + "\n")
    files.write_text(args.out / "peers.md", markdown(report))


if __name__ == "__main__":
    main(tyro.cli(Args))
