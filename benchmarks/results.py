"""The paper's table beside agents and runs, from what is recorded with them: flies nothing.

    python benchmarks/results.py phase2 phase2-sac runs/seed0 --markdown docs/results/main.md

A shipped agent has its table in its record (``tools/ship.py``), a finished run in its ``evaluation.json``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path

import stamp

from koz_jax.agents.record import read_agent_record, shipped_agents, shipped_folder
from koz_jax.cli.exit_status import exit_status
from koz_jax.errors import SettingsError
from koz_jax.evaluation.summary import PAPER_TABLE

Table = Mapping[str, float | int | str]

ROWS = (
    ("mean reward", "{mean_reward:.0f} ± {std_reward:.0f}"),
    ("settling time* [s]", "{settling_time_mean:.2f} ± {settling_time_std:.2f}"),
    ("control effort* [N² m² s]", "{control_effort_mean:.1f} ± {control_effort_std:.1f}"),
    ("control accuracy* [deg]", "{control_accuracy_deg_mean:.4f} ± {control_accuracy_deg_std:.4f}"),
    ("not settled", "{non_settled_rate:.2%}"),
    ("violated", "{violation_rate:.2%}"),
    ("success", "{success_rate:.2%}"),
)


# As the paper says it, where that is shorter.
_PAPER = {"control accuracy* [deg]": "0.08 ± 0.04", "success": "about 97 %"}


def read_table(source: str) -> Table:
    """Read the Monte Carlo table of a shipped agent or of a run folder.

    Raises:
        SettingsError: there is none.

    """
    if source in shipped_agents():
        return read_agent_record(shipped_folder() / source).provenance.table
    report = Path(source, "evaluation.json")
    if not report.is_file():
        raise SettingsError(f"source: must be a shipped agent or the folder of a finished run, got {source}")
    return json.loads(report.read_text())


def markdown(tables: Mapping[str, Table]) -> str:
    """A column per source, the paper first."""
    lines = [["", "paper", *tables], ["---"] * (len(tables) + 2)]
    for label, form in ROWS:
        paper, *ours = (form.format(**table).replace("%", " %") for table in (vars(PAPER_TABLE), *tables.values()))
        lines.append([label, _PAPER.get(label, paper), *ours])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def main(argv: list[str]) -> int:
    """Print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(prog="benchmarks/results.py", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sources", nargs="+", metavar="AGENT|RUN", help="shipped agents by name, folders of runs")
    parser.add_argument("--markdown", type=Path, help="write the table with its origin, for docs/results/")
    args = parser.parse_args(argv)
    return exit_status(lambda: _collect(args.sources, args.markdown, argv))


def _collect(sources: list[str], path: Path | None, argv: list[str]) -> int:
    table = markdown({Path(source).name: read_table(source) for source in sources})
    print(table)
    if path:
        stamp.write_table(path, ["benchmarks/results.py", *argv], table)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
