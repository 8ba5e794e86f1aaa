"""What an export takes from the constraints of a maneuver file: how fast its cones turn, and how many there are."""

import shutil

import numpy as np
import pytest
from support import blank, spacecraft, tiny

from koz_jax.cli.export import ExportFlags
from koz_jax.cli.flags import parsing
from koz_jax.config.maneuvers.maneuver_file import load_spacecraft
from koz_jax.config.shield import ShieldConfig
from koz_jax.export import files
from koz_jax.export.golden import rows, situations
from koz_jax.export.library import CLibrary

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


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_c_is_told_of_all_constraints_and_each_may_have_any_place(tmp_path, monkeypatch):
    """Also where the policy sees one: that is the nearest, and the shield keeps all."""
    monkeypatch.setattr(files, "golden", blank.golden)
    monkeypatch.setattr(files, "shield_golden", blank.shield_golden)
    agent, body = spacecraft.agent(), load_spacecraft(tiny.MANEUVER_FILES["swift"])
    assert agent.controller.network.observed_zones == 1 and len(body.constraints) == 3
    files.write_files(tmp_path, files.export(agent, "c", ShieldConfig(), body.task, least_zones=3))
    library = CLibrary(tmp_path)
    assert library.zones == 3
    drawn = situations(files.made_for(agent, body.task), 300, least_zones=3)
    last_first = drawn.replace(zone_axis_N=drawn.zone_axis_N[:, ::-1], zone_half_angle=drawn.zone_half_angle[:, ::-1])
    told, turned = rows(drawn), rows(last_first)
    requested = np.zeros((300, 3))
    observed, same = (library.observe(table, library.start(table))[0] for table in (told, turned))
    np.testing.assert_allclose(observed, same, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(library.is_safe(told), library.is_safe(turned))
    without = rows(drawn.replace(zone_half_angle=drawn.zone_half_angle.at[:, 2].set(-np.pi)))
    assert np.any(library.is_safe(without) & ~library.is_safe(told))
    assert np.any(library.shield(without, requested) != library.shield(told, requested))


def test_constraints_that_the_policy_does_not_see_are_told(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(files, "golden", blank.golden)
    spacecraft.agent().save(tmp_path / "agent")
    swift = tiny.MANEUVER_FILES["swift"]
    argv = ["export", tmp_path / "agent", "--to", "c", "--out", tmp_path / "c", "--spacecraft", swift]
    assert tiny.status(*argv) == 0
    assert f"spacecraft: {swift} has 3 constraints, of which {tmp_path / 'agent'} sees the nearest 1" in caplog.text
    assert "#define KOZ_ZONES 3 " in (tmp_path / "c" / "koz_policy.h").read_text()
