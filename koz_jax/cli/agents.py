"""``koz agents``: what is inside the package."""

from __future__ import annotations

from collections.abc import Sequence

from koz_jax.agents.record import Record, read_agent_record, shipped_agents, shipped_folder
from koz_jax.cli import invocation
from koz_jax.cli.exit_status import exit_status
from koz_jax.cli.flags import parsing
from koz_jax.config.base import Settings
from koz_jax.evaluation.digits import significant

_HEAD = ("agent", "zones", "start up to", "success", "violated", "settling time", "effort", "cases")


class AgentsFlags(Settings):
    """List the agents inside the package: what they were trained for, and what they came to in their evaluation."""


def main(argv: Sequence[str]) -> int:
    """Print the list.  Returns the exit status."""
    return exit_status(lambda: _list(parsing.parse(AgentsFlags, argv, invocation.command("agents"))))


def _list(_: AgentsFlags) -> int:
    rows = [_HEAD, *(_row(name, read_agent_record(shipped_folder() / name)) for name in shipped_agents())]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEAD))]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    print(f"\nlook further: {invocation.command('evaluate')} --agent {rows[-1][0]}")
    return 0


def _row(name: str, record: Record) -> tuple[str, ...]:
    """What an agent was trained for, and its table in short."""
    scenario, table = record.task.scenario, record.provenance.table
    few, many = record.task.zones

    def told(key: str, form: str) -> str:
        return form.format(table[key]) if key in table else "-"

    def measured(key: str, decimals: int, unit: str) -> str:
        return f"{significant(float(table[key]), decimals)} {unit}" if key in table else "-"

    return (
        name,
        str(many) if few == many else f"{few} to {many}",
        f"{scenario.max_rate_deg:g} deg/s",
        told("success_rate", "{:.2%}"),
        told("violation_rate", "{:.2%}"),
        measured("settling_time_mean", 2, "s"),
        measured("control_effort_mean", 1, "N2 m2 s"),
        told("cases", "{}"),
    )
