"""Values are shown in units that suit the spacecraft, names without the path to them."""

import pytest

from koz_jax.figures import wording


@pytest.mark.parametrize(
    ("limits", "name"),
    [((2.0, 2.0, 2.0), "N m"), ((0.15,), "N m"), ((0.002, 0.004, 0.001), "mN m"), ((5e-5,), "µN m")],
)
def test_torques_are_shown_in_the_unit_of_the_strongest_actuator(limits, name):
    unit = wording.torque_unit(limits)
    assert unit.name == name
    assert 0.1 <= unit.factor * max(limits) < 1000.0


def test_efforts_are_squares_of_torques():
    for torque, squared in (("N m", "N² m² s"), ("mN m", "(mN m)² s"), ("µN m", "(µN m)² s")):
        unit = next(unit for _, unit in wording._TORQUE if unit.name == torque)
        effort = next(unit for _, unit in wording._EFFORT if unit.name == squared)
        assert effort.factor == pytest.approx(unit.factor**2)
    assert wording.effort_unit(2.4e-4)(2.4e-4) == "240 (mN m)² s"
    assert wording.effort_unit(76.0)(76.02) == "76.0 N² m² s"
    assert wording.effort_unit(0.0)(0.0) == "0 N² m² s"
    assert wording.effort_unit(float("nan")).name == "N² m² s"


def test_a_path_is_named_by_its_last_part():
    assert wording.short_name("phase2") == "phase2"
    assert wording.short_name("/home/me/runs/6u + shield") == "6u + shield"
