"""Maneuver files: what is read, what is chosen, and what is refused in a line that says what to write."""

import logging
import re
import tomllib
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from support.tiny import MANEUVER_FILES, merged

from koz_jax.config import attitudes, plausibility
from koz_jax.config.maneuvers.maneuver import ManeuverConfig
from koz_jax.config.maneuvers.maneuver_file import load_maneuver, load_spacecraft
from koz_jax.config.task import TaskConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.errors import SettingsError
from koz_jax.task import rotations

EXAMPLES = list(MANEUVER_FILES.values())

# A start that looks along z, a target 120 deg away, a cone beside the way.
TEXT = """
name = "mine"
step_seconds = 0.2
[spacecraft]
inertia = [[0.05, 0, 0], [0, 0.06, 0], [0, 0, 0.02]]
torque_limit = 0.004
[[instruments]]
name = "telescope"
boresight = [0, 0, 1]
[[constraints]]
instrument = "telescope"
kind = "keep_out"
direction = [1, 0, 0]
half_angle_deg = 20
[start]
attitude = [1, 0, 0, 0]
[target]
attitude = [0.5, 0.5, 0.5, 0.5]
"""


def written(folder: Path, text: str) -> Path:
    (folder / "mine.toml").write_text(text)
    return folder / "mine.toml"


def made(**changes: Any) -> ManeuverConfig:
    """The maneuver of ``TEXT`` with tables changed."""
    return ManeuverConfig.model_validate(merged({"errors": {}} | tomllib.loads(CLEAR), changes))


# The target of ``TEXT`` looks along x, into the cone: there it is refused.
CLEAR = TEXT.replace("direction = [1, 0, 0]", "direction = [0, 1, 0]")


def test_a_file_is_read(tmp_path):
    read = load_maneuver(written(tmp_path, CLEAR))
    assert read == made()
    assert read.task.spacecraft.torque_limits == (0.004, 0.004, 0.004)
    assert read.task.spacecraft.boresight == (0.0, 0.0, 1.0)
    assert (read.task.step_seconds, read.task.reward.settled_angle_deg) == (0.2, 0.25)
    assert not read.has_errors and read.cautions == []


def test_without_a_name_it_is_called_like_the_file(tmp_path):
    assert load_maneuver(written(tmp_path, CLEAR.replace('name = "mine"', ""))).name == "mine"


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_are_read_and_written_without_loss(path):
    read = load_maneuver(path)
    assert ManeuverConfig.model_validate_json(read.model_dump_json()) == read
    assert read.source and read.name != path.stem


def test_lasts_five_half_turns_about_the_slowest_axis_in_whole_tens():
    half_turn = 2.0 * np.sqrt(np.pi * 0.06 / 0.004)  # 13.73 s
    assert made().spacecraft.half_turns[0] == pytest.approx(half_turn)
    assert made().seconds == 70.0 == made().task.episode_seconds
    # The third axis has less torque: 2 sqrt(pi 0.02 / 0.0001) = 50.1 s.
    assert made(spacecraft={"torque_limit": (0.004, 0.004, 0.0001)}).seconds == 260.0
    assert made(duration_seconds=33.0).seconds == 33.0


def test_lasts_two_half_turns_at_the_largest_rate_where_that_is_longer():
    assert made(spacecraft={"max_rate_deg": 5.0}).seconds == 80.0
    slow = made(spacecraft={"max_rate_deg": 0.5})
    assert slow.default_duration == (720.0, "2 half turns at the largest rate, 0.5 deg/s, in whole 10 s")
    assert slow.cautions == []
    # Of wheels by what they hold: 0.001 N m s on 0.06 kg m2.
    wheels = [{"axis": axis, "max_torque": 0.004, "max_momentum": 0.001} for axis in np.eye(3).tolist()]
    on_wheels = made(spacecraft={"torque_limit": None, "wheels": wheels})
    assert on_wheels.seconds == 10.0 * np.ceil(0.2 * np.pi / (0.001 / 0.06))
    full = [wheel | {"momentum": 0.001} for wheel in wheels]
    assert made(spacecraft={"torque_limit": None, "wheels": full}).seconds == 7200.0


@pytest.mark.parametrize(
    "changes, words",
    [
        ({}, []),
        ({"spacecraft": {"max_rate_deg": 0.5}}, ["the turn by 120 deg takes 240 s or more", "at up to 0.5 deg/s"]),
        ({"spacecraft": {"torque_limit": 0.00002}}, ["is 100, and the turn by 120 deg", "0.0433 kg m^2"]),
        ({"duration_seconds": 3.0}, ["duration_seconds: is 3, and the turn"]),
        ({"target": {"attitude": (1.0, 0.0, 0.0, 0.0)}, "duration_seconds": 1.0}, []),
    ],
)
def test_a_maneuver_that_is_too_short_for_its_turn_is_cautioned_of(changes, words):
    cautions = made(**({"duration_seconds": 100.0} | changes)).cautions
    assert len(cautions) == bool(words) and all(word in cautions[0] for word in words)


def test_errors_become_what_is_flown_with():
    found = made(errors={"inertia": 0.1, "disturbance_torque": 1e-6, "attitude_noise_deg": 0.01, "delay_steps": 2})
    assert found.has_errors
    expected = UncertaintyConfig(inertia_error=0.1, disturbance_torque=1e-6, attitude_noise_deg=0.01, delay_steps=2)
    assert found.errors.uncertainty == expected


# --- directions and attitudes ---


@pytest.mark.parametrize("length", [0.9901, 1.0, 1.0099])
def test_directions_and_quaternions_are_normalised(length):
    found = made(
        constraints=[{"instrument": "telescope", "direction": (0, length, 0), "half_angle_deg": 20.0}],
        instruments=[{"name": "telescope", "boresight": (0, 0, length)}],
        start={"attitude": (length, 0, 0, 0)},
    )
    assert found.constraints[0].direction == (0.0, 1.0, 0.0)
    assert found.instruments[0].boresight == (0.0, 0.0, 1.0)
    assert found.start.attitude == (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_nearer_sign_of_the_target_is_taken(sign):
    target = sign * np.array([0.5, 0.5, 0.5, 0.5])
    for start in (1.0, -1.0):
        aim = made(start={"attitude": (start, 0, 0, 0)}, target={"attitude": tuple(target)}).aim
        assert aim.attitude == (0.5 * start,) * 4 and aim.roll_deg == 0.0


def pointing(direction, **changes: Any) -> ManeuverConfig:
    target = {"attitude": None, "instrument": "telescope", "direction": direction}
    return made(target=target, **changes)


def test_a_target_by_direction_is_the_end_of_the_smallest_rotation():
    start = attitudes.normalized((0.9, 0.1, -0.2, 0.3))
    direction = attitudes.normalized((0.6, -0.5, 0.1))
    found = pointing(tuple(direction), start={"attitude": tuple(start)})
    q = np.array(found.aim.attitude)
    look = attitudes.rotate(q, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(look, direction, atol=1e-12)
    least = attitudes.angle_between(attitudes.rotate(start, np.array([0.0, 0.0, 1.0])), direction)
    assert 2.0 * np.arccos(q @ start) == pytest.approx(least, abs=1e-9)  # no rotation about the direction in it
    assert found.aim.roll_deg == 0.0


def test_an_opposite_direction_is_reached_by_half_a_turn():
    found = pointing((0.0, 0.0, -1.0))
    assert abs(found.aim.attitude[0]) < 1e-12
    look = attitudes.rotate(np.array(found.aim.attitude), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(look, (0.0, 0.0, -1.0), atol=1e-12)


def test_where_the_smallest_rotation_ends_inside_a_constraint_the_nearest_roll_that_does_not_is_taken():
    """The tracker (+x) would look along -z at the end, into a cone of 30 deg around (0, 0.2, -1)."""
    axis = attitudes.normalized((0.0, 0.2, -1.0))
    found = pointing(
        (1.0, 0.0, 0.0),
        instruments=[{"name": "telescope", "boresight": (0, 0, 1)}, {"name": "tracker", "boresight": (1, 0, 0)}],
        constraints=[{"instrument": "tracker", "direction": tuple(axis), "half_angle_deg": 30.0}],
    )
    margin = found.margins_deg(np.array(found.aim.attitude))
    assert 0.25 <= margin[0] < 0.25 + 0.1  # just outside, by what is kept and one step of the search
    # The tracker turns in the plane that is square to x, which holds the axis: from 11.3 deg beside it to 30.25 deg.
    assert abs(found.aim.roll_deg) == pytest.approx(30.25 - np.rad2deg(np.arctan(0.2)), abs=0.1)
    look = attitudes.rotate(np.array(found.aim.attitude), np.array([1.0, 0.0, 0.0]))
    assert look[1] < 0.0  # to the side that is nearer
    np.testing.assert_allclose(
        attitudes.rotate(np.array(found.aim.attitude), np.array([0.0, 0.0, 1.0])), (1.0, 0.0, 0.0), atol=1e-12
    )


def test_to_be_kept_in_a_cone_is_to_be_kept_out_of_the_rest_of_the_sphere():
    inside = {"instrument": "telescope", "kind": "keep_in", "direction": (0.6, 0.0, 0.8), "half_angle_deg": 100.0}
    found = pointing((1.0, 0.0, 0.0), constraints=[inside])
    for attitude in (found.start.attitude, found.aim.attitude):
        look = attitudes.rotate(np.array(attitude), np.array([0.0, 0.0, 1.0]))
        expected = 100.0 - np.rad2deg(attitudes.angle_between(look, np.array([0.6, 0.0, 0.8])))
        np.testing.assert_allclose(found.margins_deg(np.array(attitude)), expected, atol=1e-9)


def test_the_target_must_be_clear_when_the_maneuver_ends():
    """A cone that turns about z by 90 deg while the telescope turns from +z to +x."""
    turning = {"instrument": "telescope", "half_angle_deg": 30.0, "rotation_deg": (0.0, 0.0, 0.9)}
    away = pointing((1.0, 0.0, 0.0), constraints=[{**turning, "direction": (1.0, 0.0, 0.0)}], duration_seconds=100.0)
    np.testing.assert_allclose(away.constraints[0].keep_out_cone.axis_after(100.0), (0.0, 1.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(away.margins_deg(np.array(away.aim.attitude), 100.0), 60.0, atol=1e-9)
    entered = {"constraints": [{**turning, "direction": (0.0, -1.0, 0.0)}], "duration_seconds": 100.0}
    with pytest.raises(ValueError, match=r"target.direction: no roll about it keeps every constraint"):
        pointing((1.0, 0.0, 0.0), **entered)
    with pytest.raises(ValueError, match=r"target.attitude: .* inside constraints.0 after 100 s, a keep_out cone"):
        made(target={"attitude": (0.5**0.5, 0.0, 0.5**0.5, 0.0)}, **entered)


# --- what is refused ---

ATTITUDE, DIRECTION = "attitude = [1, 0, 0, 0]", "direction = [0, 1, 0]"
TARGET = "attitude = [0.5, 0.5, 0.5, 0.5]"

WHEEL = "[[spacecraft.wheels]]\naxis = {}\nmax_torque = 0.002\nmax_momentum = 0.015\n"

# A change of the file, and words of the message: the key, the value, what is allowed.
REFUSED = {
    "not TOML": ("step_seconds = 0.2", "step_seconds = ", "is not TOML"),
    "unknown key": (
        "half_angle_deg = 20",
        "half_angle = 20",
        "constraints.0: unknown key 'half_angle' (got 20); allowed",
    ),
    "unknown key lists": ("half_angle_deg = 20", "half_angle = 20", "direction, half_angle_deg"),
    "unknown key at the top": (
        'name = "mine"',
        "steps = 3",
        "unknown key 'steps' (got 3); allowed are name, step_seconds",
    ),
    "unknown table": ("[start]", "[stop]\nx = 1\n[start]", "unknown key 'stop'"),
    "missing step": ("step_seconds = 0.2", "", "step_seconds: Field required"),
    "moments alone": (
        "inertia = [[0.05, 0, 0], [0, 0.06, 0], [0, 0, 0.02]]",
        "inertia = [0.05, 0.06, 0.02]",
        "spacecraft.inertia: must be three rows of three numbers, such as [[0.05, 0.0, 0.0], [0.0, 0.06, 0.0],"
        " [0.0, 0.0, 0.02]] (got (0.05, 0.06, 0.02))",
    ),
    "two rows": (
        "inertia = [[0.05, 0, 0], [0, 0.06, 0], [0, 0, 0.02]]",
        "inertia = [[0.05, 0, 0], [0, 0.06, 0]]",
        "spacecraft.inertia: must be three rows of three numbers, such as",
    ),
    "missing inertia": ("inertia = ", "# ", "spacecraft.inertia: Field required"),
    "a number as text": ("torque_limit = 0.004", 'torque_limit = "0.004"', "spacecraft.torque_limit"),
    "a truth value": (
        "half_angle_deg = 20",
        "half_angle_deg = true",
        "constraints.0.half_angle_deg: Input should be a valid number (got True)",
    ),
    "wheels": (
        "torque_limit = 0.004",
        "torque_limit = 0.004\n" + WHEEL.format("[1, 0, 0]") * 3,
        "spacecraft: must have one of torque_limit, wheels and gyros; got torque_limit and wheels",
    ),
    "no actuators": (
        "torque_limit = 0.004",
        "",
        "spacecraft: must have one of torque_limit, wheels and gyros; got none",
    ),
    "half a wheel": (
        "torque_limit = 0.004",
        "[[spacecraft.wheels]]\naxis = [1, 0, 0]\nmax_torque = 0.002",
        "spacecraft.wheels.0.max_momentum: Field required",
    ),
    "wheels in a plane": (
        "torque_limit = 0.004",
        WHEEL.format("[1, 0, 0]") * 2 + WHEEL.format("[0, 1, 0]"),
        "wheels must be at least three, with axes that do not lie in a plane",
    ),
    "rate limit": (
        "torque_limit = 0.004",
        "torque_limit = 0.004\nmax_rate_deg = -3.0",
        "spacecraft.max_rate_deg: Input should be greater than 0",
    ),
    "outside the cone to be kept in": (
        'kind = "keep_out"',
        'kind = "keep_in"',
        "start.attitude: must keep every constraint",
    ),
    "another kind": (
        'kind = "keep_out"',
        'kind = "avoid"',
        "constraints.0.kind: Input should be 'keep_out' or 'keep_in' (got 'avoid')",
    ),
    "moving cone": (
        "half_angle_deg = 20",
        "half_angle_deg = 20\nrotation_deg = [0, 0, inf]",
        "constraints.0.rotation_deg.2: Input should be a finite number (got inf)",
    ),
    "delay": (
        "[start]",
        "[errors]\ndelay_steps = 4\n[start]",
        "errors.delay_steps: Input should be less than or equal to 3 (got 4)",
    ),
    "long direction": (
        DIRECTION,
        "direction = [8, 6, 1]",
        "direction: must be a unit vector, of length 1 to within 1%; its length is 10.0499 (got (8, 6, 1))",
    ),
    "slightly long": (DIRECTION, "direction = [0, 1.0101, 0]", "its length is 1.0101"),
    "zero direction": (DIRECTION, "direction = [0, 0, 0]", "constraints.0.direction: must be a unit vector"),
    "nan": (
        DIRECTION,
        "direction = [0, nan, 0]",
        "constraints.0.direction.1: Input should be a finite number (got nan)",
    ),
    "boresight": ("boresight = [0, 0, 1]", "boresight = [0, 0, 2]", "instruments.0.boresight: must be a unit vector"),
    "quaternion": (
        TARGET,
        "attitude = [0.5, 0.5, 0.5, 0.6]",
        "target.attitude: must be a unit quaternion, scalar first, of length 1",
    ),
    "three numbers": (ATTITUDE, "attitude = [1, 0, 0]", "start.attitude.3: Field required"),
    "half angle": (
        "half_angle_deg = 20",
        "half_angle_deg = 180",
        "constraints.0.half_angle_deg: Input should be less than 180 (got 180)",
    ),
    "unknown instrument": (
        'instrument = "telescope"',
        'instrument = "camera"',
        "constraints.0.instrument: must be one of the instruments (telescope), got 'camera'",
    ),
    "two of a name": (
        "[[constraints]]",
        '[[instruments]]\nname = "telescope"\nboresight = [1, 0, 0]\n[[constraints]]',
        "instruments: must have different names, got telescope, telescope",
    ),
    "no target": (TARGET, "", "target: must have either attitude, or instrument and direction; got neither"),
    "two targets": (
        TARGET,
        TARGET + '\ninstrument = "telescope"\ndirection = [1, 0, 0]',
        "target: must have either attitude, or instrument and direction; got attitude, instrument, direction",
    ),
    "half a target": (
        TARGET,
        "direction = [1, 0, 0]",
        "target: must have either attitude, or instrument and direction; got direction",
    ),
    "start inside": (
        DIRECTION,
        "direction = [0, 0.1736, 0.9848]",
        "start.attitude: must keep every constraint; (1, 0, 0, 0) has 'telescope' 10 deg inside constraints.0, a"
        " keep_out cone of half angle 20 deg",
    ),
    "target inside": (
        DIRECTION,
        "direction = [1, 0, 0]",
        "target.attitude: must keep every constraint; (0.5, 0.5, 0.5, 0.5) has 'telescope' 20 deg inside constraints.0",
    ),
    "target by direction inside": (
        TARGET,
        'instrument = "telescope"\ndirection = [0, 1, 0]',
        "target.direction: no roll about it keeps every constraint by 0.25 deg; the best leaves -20 deg to"
        " constraints.0, a keep_out cone of half angle 20 deg for 'telescope', got (0.0, 1.0, 0.0)",
    ),
    "g cm2": (
        "[[0.05, 0, 0], [0, 0.06, 0], [0, 0, 0.02]]",
        "[[5e5, 0, 0], [0, 6e5, 0], [0, 0, 2e5]]",
        "spacecraft: inertia: moments of up to 600000 kg m2 on a torque of 0.004 N m make a half turn take 12.1"
        " h; allowed is at most 1 h",
    ),
    "torque in mN m": (
        "torque_limit = 0.004",
        "torque_limit = 4",
        "at most 0.125, half of the 0.251 s in which this spacecraft can make a half turn; got 0.2",
    ),
    "asymmetric": ("[0, 0.06, 0]", "[0.01, 0.06, 0]", "spacecraft: inertia must be symmetric"),
    "impossible body": ("[0, 0, 0.02]", "[0, 0, 0.2]", "spacecraft: inertia must obey the triangle inequality"),
    "duration": (
        "step_seconds = 0.2",
        "step_seconds = 0.2\nduration_seconds = 0.01",
        "duration_seconds must hold 1 to 2^31 - 1 steps",
    ),
    "published": (
        "step_seconds = 0.2",
        "step_seconds = 0.2\npublished = { time = 3 }",
        "published: unknown key 'time' (got 3); allowed are by, slew_deg, settling_seconds",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_flown_is_refused_in_one_line(name, tmp_path):
    old, new, message = REFUSED[name]
    assert old in CLEAR
    path = written(tmp_path, CLEAR.replace(old, new, 1))
    with pytest.raises(SettingsError) as refused:
        load_maneuver(path)
    told = str(refused.value)
    assert message in told and told.startswith((f"{path}: ", f"maneuver: {path} ")), told
    assert len(told.splitlines()) == 1, told


def test_all_that_is_wrong_is_told_at_once(tmp_path):
    text = CLEAR.replace("half_angle_deg = 20", "half_angle_deg = -1").replace(ATTITUDE, "attitude = [2, 0, 0, 0]")
    with pytest.raises(SettingsError) as refused:
        load_maneuver(written(tmp_path, text))
    lines = str(refused.value).splitlines()
    found = [re.sub(r"^\S+: (\S+): .*", r"\1", line) for line in lines]
    assert found == ["constraints.0.half_angle_deg", "start.attitude"]


def test_files_that_are_none_are_refused(tmp_path):
    for path in (tmp_path / "no.toml", tmp_path):
        with pytest.raises(SettingsError, match=rf"maneuver: {path} cannot be read"):
            load_maneuver(path)
    (tmp_path / "x.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(SettingsError, match="is not TOML"):
        load_maneuver(tmp_path / "x.toml")


def test_half_angles_that_look_like_radians_are_told(tmp_path, caplog):
    """Once, by a file and in Python."""
    small = {"constraints": [{"instrument": "telescope", "direction": (0, 1, 0), "half_angle_deg": 0.5}]}
    with caplog.at_level(logging.WARNING, "koz_jax"):
        load_maneuver(written(tmp_path, CLEAR.replace("half_angle_deg = 20", "half_angle_deg = 0.5")))
        made(**small)
    expected = "mine: constraints.0.half_angle_deg: 0.5 deg is small; is it 0.5 rad = 28.6 deg?"
    assert [record.getMessage() for record in caplog.records] == [expected] * 2


@pytest.mark.parametrize(("momentum", "told"), [(0.015, False), (0.2, False), (15.0, True), (50.0, True)])
def test_wheels_that_hold_what_the_body_makes_no_use_of_are_cautioned_of(momentum, told):
    """15 mN m s in mN m s, for one; the momentum that its fastest half turn takes is sqrt(pi J u), about 20 mN m s."""
    wheels = [{"axis": axis, "max_torque": 0.004, "max_momentum": momentum} for axis in np.eye(3).tolist()]
    found = made(spacecraft={"torque_limit": None, "wheels": wheels})
    words = [f"spacecraft.wheels.{i}.max_momentum: {momentum:g} N m s would turn the body at" for i in range(3)]
    assert all(caution.startswith(word) for caution, word in zip(found.cautions, words * told, strict=True))
    task = TaskConfig(spacecraft=found.task.spacecraft, step_seconds=0.2)
    assert sum("max_momentum" in finding.text for finding in plausibility.findings(task, 80.0, 180.0)) == 3 * told


def test_no_constraints_and_no_instruments_are_a_maneuver_too():
    free = made(constraints=(), instruments=())
    assert free.margins_deg(np.array(free.start.attitude)).shape == (0,)
    assert free.task.spacecraft.boresight == (1.0, 0.0, 0.0)


# --- a spacecraft alone ---


@pytest.mark.parametrize("another", [False, True])
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_first_instrument_is_that_of_flights_and_of_draws(path, another, tmp_path):
    """Whatever constraints there are."""
    text = path.read_text()
    if another:
        first, _, rest = text.partition("[[instruments]]")
        text = f"{first}[[instruments]]\nname = 'new'\nboresight = [0, -0.6, 0.8]\n[[instruments]]{rest}"
    flown, drawn = load_maneuver(written(tmp_path, text)), load_spacecraft(written(tmp_path, text))
    expected = flown.instruments[0].boresight
    assert flown.task.spacecraft.boresight == expected == drawn.task.spacecraft.boresight
    if not another:  # published flights are of the first constraint's instrument too
        assert flown.constraints[0].instrument == flown.instruments[0].name


def test_a_maneuver_file_will_do_for_its_spacecraft(tmp_path):
    found = load_spacecraft(written(tmp_path, TEXT))
    assert found.spacecraft.torque_limit == 0.004 and found.step_seconds == 0.2
    assert [instrument.name for instrument in found.instruments] == ["telescope"]


@pytest.mark.parametrize(
    "text, message",
    [
        ("step_seconds = 0.1", "spacecraft: Field required"),
        ("step_seconds = 0.1\nmass = 3\n[spacecraft]", "unknown key 'mass' (got 3); allowed are name, step_seconds"),
        ("[spacecraft]\ninertia = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\ntorque_limit = 1", "step_seconds: Field required"),
    ],
)
def test_a_spacecraft_that_is_none_is_refused(text, message, tmp_path):
    with pytest.raises(SettingsError) as refused:
        load_spacecraft(written(tmp_path, text))
    assert message in str(refused.value)


# --- quaternions ---


def test_quaternions_agree_with_those_of_the_task():
    draw = np.random.default_rng(0)
    a, b = (attitudes.normalized(draw.normal(size=4)) for _ in range(2))
    v, w = (attitudes.normalized(draw.normal(size=3)) for _ in range(2))
    p, q, x, y = map(jnp.asarray, (a, b, v, w))
    for ours, theirs in [
        (attitudes.multiply(a, b), rotations.multiply(p, q)),
        (attitudes.rotate(a, v), rotations.rotate(p, x)),
        (attitudes.turn_about(v, 0.7), rotations.from_axis_angle(x, jnp.float32(0.7))),
        (attitudes.angle_between(v, w), rotations.angle_between(x, y)),
        (attitudes.rotate(attitudes.shortest_arc(v, w), v), y),
    ]:
        np.testing.assert_allclose(ours, np.asarray(theirs), atol=1e-6)
    many = np.stack([a, b])
    np.testing.assert_allclose(attitudes.multiply(many, b)[0], attitudes.multiply(a, b))
    np.testing.assert_allclose(attitudes.rotate(many, v)[1], attitudes.rotate(b, v))
