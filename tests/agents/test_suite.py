"""The suite: one table of everybody over maneuver files, with what others report beside it."""

import json
from pathlib import Path

import pytest
from support import tiny

from koz_jax.agents import suite
from koz_jax.agents.suite import SuiteFlight
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.errors import SettingsError

pytestmark = pytest.mark.slow

FILTERS: tuple[suite.Under, ...] = (None, "shield")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A turn past a cone that pd flies through, and one that has no cone in its way."""
    made = tmp_path_factory.mktemp("suite")
    text = tiny.MANEUVER_FILES["paper"].read_text().replace("step_seconds = 0.1", "step_seconds = 0.2")
    (made / "through.toml").write_text(text)
    lines = text.splitlines()
    lines[next(i for i, line in enumerate(lines) if line.startswith("direction"))] = "direction = [0, 0, -1]"
    clear = "\n".join(line for line in lines if not line.startswith("published"))
    (made / "clear.toml").write_text(clear)
    return made


@pytest.fixture(scope="module")
def flights(folder) -> list[SuiteFlight]:
    """Flights of pd over both, and over a few random cases."""
    draw = MonteCarloConfig(cases=4, substeps=5)
    return list(suite.fly_suite(suite.load_suite(folder), ["pd"], FILTERS, draw))


def test_rows_are_those_that_are_announced(folder, flights):
    announced = list(suite.labels(suite.load_suite(folder), ["pd"], FILTERS))
    assert [(flight.row.case, flight.row.by) for flight in flights] == announced
    assert announced[0] == ("clear", "pd") and announced[2][0] == "through"
    assert all(len(flight.row.cells()) == len(suite.COLUMNS) for flight in flights)


def test_what_others_report_stands_beside_what_is_flown(flights):
    told, flown, shielded = (flight.row for flight in flights[2:5])
    assert (told.settling_time_s, told.control_effort, told.success) == (27.8, 76.0, None)
    assert flown.violated == 1.0 and flown.success == 0.0 and flown.min_margin_deg < -10.0
    assert shielded.violated == 0.0 and shielded.success == 1.0 and shielded.min_margin_deg > 0.0
    assert flown.cells()[5:7] == ["no", "yes"] and told.cells()[5:7] == ["-", "-"]


def test_the_worst_of_all_maneuvers_and_the_random_cases_follow(flights):
    single = [flight.row for flight in flights if flight.flown is not None and flight.row.by == "pd"]
    rows = {(flight.row.case, flight.row.by): flight.row for flight in flights}
    worst, drawn = rows[suite.ALL, "pd"], rows[suite.DRAW, "pd"]
    assert worst.min_margin_deg == min(row.min_margin_deg for row in single) and worst.success == 0.5
    assert worst.decision_us > 0.0 and worst.planning_ms > 0.0
    assert drawn.violated == 1.0 and rows[suite.DRAW, "pd + shield"].violated == 0.0


def test_every_published_maneuver_says_what_is_published():
    assert {"paper", "yang2021", "swift", "calaon1"} <= set(suite.load_suite())
    assert all(one.source for one in suite.load_suite().values())


def test_a_folder_without_maneuvers_is_refused(tmp_path):
    with pytest.raises(SettingsError, match=r"suite: must be a folder that holds maneuver files, \*.toml; got"):
        suite.load_suite(tmp_path)


def test_the_command_writes_the_table_the_rows_and_the_traces(folder, tmp_path, capsys):
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "clear.toml").write_text((folder / "clear.toml").read_text())
    outputs = ["--json", tmp_path / "x.json", "--markdown", tmp_path / "x.md", "--figures", tmp_path]
    argv = ["--suite", tmp_path / "one", "--controllers", "pd", "--filters", "none", "--cases", "0", *outputs]
    assert tiny.status("evaluate", *argv) == 0
    printed = capsys.readouterr().out
    assert (tmp_path / "x.md").read_text() in printed
    rows = json.loads((tmp_path / "x.json").read_text())["rows"]
    assert [row["case"] for row in rows] == ["clear", suite.ALL] and rows[0]["success"] == 1.0
    assert (tmp_path / "suite.png").stat().st_size > 10_000
