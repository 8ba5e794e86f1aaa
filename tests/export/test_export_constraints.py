"""What an export takes from the constraints of a maneuver file: how fast its cones turn, and how many there are."""

import pytest
from support import tiny

from koz_jax.cli.export import ExportFlags
from koz_jax.cli.flags import parsing
from koz_jax.config.maneuvers.maneuver_file import load_spacecraft

LEO = tiny.MANEUVER_FILES["leo_6u"]  # the Earth's edge turns by 0.0634 deg/s


@pytest.mark.parametrize(
    ("argv", "rate"), [("", 0.0634), ("--cone-rate-deg 0.0634", 0.0634), ("--cone-rate-deg 0.2", 0.2)]
)
def test_the_shield_is_for_the_cones_of_the_file(argv, rate):
    """As it is in flight; a larger rate that is asked for is kept."""
    flags = ["universal", "--to", "c", "--out", "c", "--shield", "--spacecraft", str(LEO), *argv.split()]
    made = parsing.parse(ExportFlags, flags, "koz export").shield_config(load_spacecraft(LEO).constraints)
    assert made is not None and made.cone_rate_deg == pytest.approx(rate)


def test_a_shield_for_slower_cones_than_those_of_the_file_is_refused(tmp_path, capsys):
    argv = ["universal", "--to", "c", "--out", tmp_path / "c", "--shield", "--spacecraft", LEO, "--cone-rate-deg"]
    assert tiny.status("export", *argv, 0.01) == 2
    told = capsys.readouterr().err
    assert "cone_rate_deg: must be at least 0.0634, the rate of the fastest of the constraints in" in told
    assert told.endswith("got 0.01; by default it is that\n") and not (tmp_path / "c").exists()
