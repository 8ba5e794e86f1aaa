"""The exported C source as others build and use it: strict compilers, C++, sanitizers, the example, any sign of q."""

import dataclasses
import os
import re
import shutil
import subprocess

import numpy as np
import pytest
from support import blank, oracle, spacecraft, tiny

from koz_jax.agents.agent import Agent, load_agent
from koz_jax.config.maneuvers.maneuver_file import load_spacecraft
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.evaluation import cases
from koz_jax.export import files
from koz_jax.export.files import export, write_files
from koz_jax.export.golden import EXAMPLE_CASE
from koz_jax.export.library import CLibrary

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")

WARNINGS = (
    "-std=c99 -O2 -Wall -Wextra -Wpedantic -Werror -Wconversion -Wdouble-promotion -Wfloat-equal -Wshadow"
    " -Wstrict-prototypes -Wmissing-prototypes -Wcast-qual"
).split()
SOURCES = ("koz_policy.c", "koz_shield.c", "koz_selftest.c", "koz_shield_selftest.c", "koz_example.c")
ROBUST = ShieldConfig(error_bounds=UncertaintyConfig(inertia_error=0.1, rate_noise_deg=0.001))
UNEQUAL = (2.0, 1.0, 0.3)  # [N m]


@pytest.fixture(scope="module")
def agent() -> Agent:
    return load_agent("phase2")


@pytest.fixture(scope="module")
def exported(agent) -> dict[str, bytes]:
    """Of the policy and a shield."""
    return export(agent, "c", ShieldConfig())


def run(*command: object, **environment: str) -> subprocess.CompletedProcess[str]:
    words = [str(word) for word in command]
    done = subprocess.run(words, capture_output=True, text=True, check=False, env={**os.environ, **environment})
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def of_other_task(agent: Agent) -> Agent:
    """Unequal torque limits, and up to three zones."""
    task = agent.task
    body = task.spacecraft.model_copy(update={"torque_limit": UNEQUAL})
    scenario = task.scenario.model_copy(update={"max_zones": 3})
    return dataclasses.replace(agent, task=task.model_copy(update={"spacecraft": body, "scenario": scenario}))


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("kind", ["plain", "robust", "unequal", "scaled", "instruments", "wheels"])
def test_everything_compiles_without_a_warning(agent, folder, tmp_path, monkeypatch, compiler, kind):
    if shutil.which(compiler) is None:
        pytest.skip(f"there is no {compiler}")
    where = folder
    if kind != "plain":
        where = tmp_path
        monkeypatch.setattr(files, "golden", blank.golden)
        monkeypatch.setattr(files, "shield_golden", blank.shield_golden)
        several = spacecraft.agent(spacecraft.SCALED.model_copy(update={"observed_zones": 3}))
        exported = {"robust": agent, "unequal": of_other_task(agent), "scaled": spacecraft.agent()}.get(kind, several)
        others = ((0.0, 0.0, -1.0), (-0.6, 0.8, 0.0)) if kind in ("instruments", "wheels") else ()
        task = load_spacecraft(tiny.ROOT / "examples" / "leo_6u.toml").task if kind == "wheels" else None
        config = ShieldConfig() if kind == "wheels" else ROBUST
        write_files(where, export(exported, "c", config, task, others))
    for name in SOURCES:
        knows = b"KOZ_WITH_SHIELD" in (where / name).read_bytes()
        for defined in ((), ("-DKOZ_WITH_SHIELD",)) if knows else ((),):
            run(compiler, *WARNINGS, *defined, "-c", where / name, "-o", tmp_path / "out.o")


@pytest.mark.slow
def test_nothing_is_left_to_be_filled_in(folder):
    for path in folder.iterdir():
        assert not re.findall(r"@[A-Z_]+@", path.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("program", ["koz_selftest", "koz_shield_selftest", "koz_example"])
def test_sanitizers_find_nothing(folder, tmp_path, program):
    flags = ["-std=c99", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-DKOZ_WITH_SHIELD"]
    sources = [folder / name for name in ("koz_policy.c", "koz_shield.c", f"{program}.c")]
    built = subprocess.run(
        ["cc", *flags, "-o", tmp_path / "program", *sources, "-lm"], capture_output=True, text=True, check=False
    )
    if "asan" in built.stderr and "cannot find" in built.stderr:
        pytest.skip("there are no sanitizers")
    assert built.returncode == 0, built.stderr
    done = run(tmp_path / "program", ASAN_OPTIONS="detect_leaks=0")
    assert "passed" in done.stdout or "stayed clear" in done.stdout


USER = """
#include <cstdio>

#include "koz_shield.h"

int main()
{
    koz_situation now = {{1, 0, 0, 0}, {0, 0, 0}, {1, 0, 0, 0}, {{0, 1, 0}}, {0.3f}};
    koz_memory memory;
    float observation[KOZ_OBSERVATION_SIZE], requested_B[3], torque_B[3];
    koz_start(&memory, &now);
    koz_observe(&memory, &now, observation);
    koz_torque(observation, requested_B);
    koz_shield(&now, requested_B, torque_B);
    std::printf("%d %d\\n", koz_fault(&now) == nullptr, koz_is_safe(&now));
    return 0;
}
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler")
def test_a_user_in_cpp(folder, tmp_path):
    (tmp_path / "user.cpp").write_text(USER)
    for name in ("koz_policy", "koz_shield"):
        run("cc", "-std=c99", "-O2", "-c", folder / f"{name}.c", "-o", tmp_path / f"{name}.o")
    objects = sorted(tmp_path.glob("*.o"))
    warnings = ["-std=c++11", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    run("g++", *warnings, "-I", folder, "-o", tmp_path / "user", tmp_path / "user.cpp", *objects, "-lm")
    assert run(tmp_path / "user").stdout == "1 1\n"


@pytest.mark.slow
@pytest.mark.parametrize("shield", [None, ShieldConfig()], ids=["alone", "shielded"])
def test_the_example_flies_a_case(agent, folder, tmp_path, shield):
    if shield is None:
        folder = tmp_path
        write_files(folder, export(agent, "c"))
    shown = run("make", "-s", "-C", folder, "example").stdout
    settled, margin = map(
        float, re.findall(r"settled within 0\.25 deg in (.*) s, smallest margin (.*) deg: ", shown)[0]
    )
    assert shown.rstrip().endswith("stayed clear")
    config = MonteCarloConfig(shield=shield, cases=EXAMPLE_CASE + 1)
    _, expected = cases.fly_case(agent, EXAMPLE_CASE, config)
    assert settled == pytest.approx(float(expected.settling_time), abs=0.11)
    assert margin == pytest.approx(np.rad2deg(float(expected.min_margin)), abs=2e-3)
    first, *rows, last = shown.splitlines()
    assert first.split() == ["time", "[s]", "pointing", "error", "[deg]", "margin", "[deg]"] and last
    assert [float(row.split()[0]) for row in rows] == pytest.approx(np.arange(0.0, 101.0, 5.0))
    assert float(rows[-1].split()[1]) < 0.25


def turned(axis: tuple[float, ...], half_deg: float) -> np.ndarray:
    half = np.deg2rad(half_deg)
    return np.array([np.cos(half), *(np.sin(half) * np.array(axis))])


def as_it_is(q_BN: np.ndarray, step: int) -> np.ndarray:
    return q_BN


def from_a_star_tracker(q_BN: np.ndarray, step: int) -> np.ndarray:
    return q_BN * np.where(q_BN[:, :1] < 0.0, -1.0, 1.0)


def now_and_then(q_BN: np.ndarray, step: int) -> np.ndarray:
    return q_BN * (-1.0) ** (step // 3)


def fly(library: CLibrary, row: np.ndarray, measure, target_sign: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Close the loop in float64.  row: (1, 15) situation.  Returns pointing errors (1001,) [rad] and torques."""
    row = row.copy()
    row[:, 7:11] *= target_sign
    q_BN, omega, memory, errors, torques = row[:, :4], row[:, 4:7], None, [], []
    for step in range(1001):
        told = row.copy()
        told[:, :4], told[:, 4:7] = measure(q_BN, step), omega
        observed, memory = library.observe(told, library.start(told) if memory is None else memory)
        errors.append(2.0 * np.arccos(min(1.0, abs(float(np.sum(q_BN * row[:, 7:11]))))))
        torques.append(library.torque(observed))
        q_BN, omega = oracle.propagate_many(q_BN, omega, torques[-1].astype(float), 0.1)
    return np.array(errors), np.concatenate(torques)


@pytest.mark.slow
@pytest.mark.parametrize("measure", [as_it_is, from_a_star_tracker, now_and_then])
@pytest.mark.parametrize(
    ("axis", "start", "target", "zone", "expected"),
    [((0, 0, 1), 85.0, 145.0, (0, 0, -1), 18.1), ((0, 1, 0), 88.0, 138.0, (0, 1, 0), 17.5)],
)
def test_the_sign_of_a_measured_quaternion_does_not_matter(library, axis, start, target, zone, expected, measure):
    half_angle = np.deg2rad(20.0)
    row = np.array([[*turned(axis, start), 0, 0, 0, *turned(axis, target), *zone, half_angle]])
    errors, torques = fly(library, row, measure)
    outside = np.flatnonzero(errors > np.deg2rad(0.25))
    assert 0.1 * (outside[-1] + 1) == pytest.approx(expected, abs=0.3)
    _, other = fly(library, row, measure, target_sign=-1.0)
    np.testing.assert_allclose(other, torques, rtol=0, atol=1e-3)


@pytest.mark.slow
def test_what_is_no_situation_is_refused_by_name(library):
    good = np.array([[1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0.3]], np.float32)
    absent = good.copy()
    absent[0, 11:] = 0.0, 0.0, 0.0, -np.pi
    assert library.faults(np.concatenate([good, -good, absent])) == [None] * 3
    for columns, value, named in (
        (slice(0, 4), 0.0, "q_BN"),
        (slice(1, 2), np.nan, "q_BN"),
        (slice(7, 11), 0.0, "q_DN"),
        (slice(8, 9), np.inf, "q_DN"),
        (slice(5, 6), np.nan, "omega_BN_B"),
        (slice(11, 14), 0.0, "zone_axis_N"),
        (slice(12, 13), np.nan, "zone_axis_N"),
        (slice(14, 15), np.nan, "zone_half_angle"),
        (slice(14, 15), 30.0, "zone_half_angle"),  # in degrees
    ):
        broken = good.copy()
        broken[:, columns] = value
        (fault,) = library.faults(broken)
        assert fault is not None and fault.startswith(f"{named}: must be")


@pytest.mark.slow
def test_only_directions_count(library):
    row = np.array([[0.5, 0.5, 0.5, 0.5, 0.01, 0, 0, 1, 0, 0, 0, 0.5, 0.866, 0, 0.3]], np.float32)
    row[:, 11:14] /= np.linalg.norm(row[:, 11:14])
    longer = row.copy()
    longer[:, :4] *= 3.0
    longer[:, 7:11] *= 0.1
    longer[:, 11:14] *= 1000.0
    expected, _ = library.observe(row, library.start(row))
    found, _ = library.observe(longer, library.start(longer))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_of_no_observation_it_makes_no_torque(library):
    nothing = np.full((1, 16), np.nan, np.float32)
    np.testing.assert_array_equal(library.torque(nothing), np.zeros((1, 3)))
