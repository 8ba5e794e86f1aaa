"""The comparison as Markdown."""

from peer_record import TARGETS, PeerResult

from koz_jax.config.base import Settings
from koz_jax.evaluation.summary import PAPER_TABLE

_INTRO = """# Peers

Made by `python benchmarks/peers.py` (extra `peers`), which trains every library on the same environment, one after
another on the same cores, each in a process of its own; do not edit. A peer that a run is not asked for (`--peers`)
keeps its result of before. Numbers behind it: [`peers.json`](peers.json).

Every peer trains on deviations of 80 to 180 deg with the paper's reward and observation, with networks of 256-256 and
batches of 256, through its best wrapper of the environment. Beyond that it has the settings of the table, mostly its
own defaults; nobody tuned them for this task, as ours were. Ours is `koz train --preset fast` of the commit in
the table of settings.

The clock of a peer begins before the first step and stands still while it is evaluated. Ours begins with the process
and counts imports, compilation and its own evaluations. Success is settled and no zone entered, in 1,000 cases that no
training draws; time to a success rate is the time of the first evaluation that shows it.
"""

_ROWS = (
    ("mean reward", "mean_reward", 1.0, "{:.0f}"),
    ("settling time* [s]", "settling_time_mean", 1.0, "{:.2f}"),
    ("control effort* [N² m² s]", "control_effort_mean", 1.0, "{:.1f}"),
    ("control accuracy* [deg]", "control_accuracy_deg_mean", 1.0, "{:.4f}"),
    ("not settled", "non_settled_rate", 100.0, "{:.2f} %"),
    ("violated", "violation_rate", 100.0, "{:.2f} %"),
    ("success", "success_rate", 100.0, "{:.2f} %"),
)


class Report(Settings):
    """Everything that was measured."""

    environment: dict[str, float] = {}  # noqa: RUF012
    """Environment steps per second by adapter."""
    results: tuple[PeerResult, ...] = ()
    """What came of the peers."""


def _table(rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    lines.insert(1, "|" + "---|" * len(rows[0]))
    return "\n".join(lines)


def _time(result: PeerResult, target: float) -> str:
    seconds = result.seconds_to(target)
    return f"not in {result.minutes:g} min" if seconds is None else f"{seconds:.0f} s"


def _learning(report: Report) -> str:
    header = ["", "updates/s", "updates done", "environment steps done", "best success"]
    header += [f"to {target:.0%}" for target in TARGETS]
    rows = [header]
    for result in report.results:
        speed = "-" if result.updates_per_second is None else f"{result.updates_per_second:.0f}"
        updates, steps = (max(getattr(point, name) for point in result.points) for name in ("updates", "env_steps"))
        times = [_time(result, target) for target in TARGETS]
        best = max(point.success_rate for point in result.points)
        rows.append([result.name, speed, f"{updates:,}", f"{steps:,}", f"{best:.1%}", *times])
    return _table(rows)


def _monte_carlo(report: Report) -> str:
    rows = [["", *(result.name for result in report.results), "paper"]]
    rows.append(["training [min]", *(f"{result.minutes:g}" for result in report.results), "-"])
    for label, field, factor, form in _ROWS:

        def cell(value: float | None, factor: float = factor, form: str = form) -> str:
            return "-" if value is None else form.format(factor * value)

        cells = [cell(result.table[field]) for result in report.results]
        rows.append([label, *cells, cell(getattr(PAPER_TABLE, field))])
    return _table(rows)


def _settings(report: Report) -> str:
    rows = [["", "version", "settings", "minutes", "cores", "load before, after"]]
    for result in report.results:
        load = f"{result.load_before:.1f}, {result.load_after:.1f}"
        rows.append([result.name, result.version, result.recipe, f"{result.minutes:g}", str(result.cores), load])
    return _table(rows)


def _bound(report: Report) -> str:
    """How long the peers would need at least, if they learned as much per update as ours."""
    found = {result.name: result for result in report.results}
    ours = found.get("koz_jax")
    updates, seconds = (ours.updates_to(0.95), ours.seconds_to(0.95)) if ours else (None, None)
    if updates is None or seconds is None:
        return ""
    rows = [["", "95 % not within (measured)", "times ours", "95 % not before (extrapolated)", "times ours"]]
    for result in report.results:
        speed = result.updates_per_second
        if speed and result.name not in ("koz_jax", "brax PPO") and result.seconds_to(0.95) is None:
            trained, least = 60.0 * result.minutes, updates / speed
            bounds = [text for bound in (trained, least) for text in (f"{bound:.0f} s", f"{bound / seconds:.1f}")]
            rows.append([result.name, *bounds])
    return (
        f"Ours showed 95 % after {updates:,} updates and {seconds:.0f} s. Where a peer did not get there, its time is"
        " not known, only that it is longer than the training. The last two columns are no measurement: the time"
        " that its updates/s would take for as many updates as ours"
        " needed, as if it learned as much from each without the curriculum, the encoding and the n-step returns."
        f"\n\n{_table(rows)}"
    )


def markdown(report: Report) -> str:
    """The page."""
    environment = [["through", "environment steps/s"]]
    environment += [[name, f"{value:,.0f}"] for name, value in report.environment.items()]
    parts = [
        _INTRO.rstrip(),
        "## Learning\n\n" + _learning(report),
        "Updates/s are with networks of 256-256 and batches of 256, environment steps included, in the best stretch"
        " between two evaluations; for koz_jax measured apart, because its preset has smaller networks."
        " PPO's updates are of 512 unrolls of 20 steps, not of 256 transitions.",
        _bound(report),
        "## Monte Carlo after the training\n\n" + _monte_carlo(report),
        "\\* settled cases only. Of each peer the best policy by its evaluations, in"
        f" {max((result.cases for result in report.results), default=0):,} cases, seed 0 of `koz evaluate`.",
        "## Settings\n\n" + _settings(report),
        "The load average counts all processes of the machine; above the number of its cores, timings suffer.",
        "## Environment\n\n" + _table(environment),
        "At 1,024 environments, but for the single one.",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"
