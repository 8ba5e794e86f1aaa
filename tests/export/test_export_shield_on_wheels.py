"""The shield exported for a spacecraft on wheels: within what they leave, below the rate that they can stop."""

import functools
import os
import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import blank, spacecraft, tiny

from koz_jax.config.maneuvers.maneuver_file import load_spacecraft
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.control.shield import filter as shield
from koz_jax.export import files
from koz_jax.export.files import export, made_for, write_files
from koz_jax.export.golden import Situation, known, rows
from koz_jax.export.library import CLibrary
from koz_jax.export.shield_golden import shield_situations
from koz_jax.task.state import torque_limits

# All of it takes what the fixture compiles.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler"),
]

AGENT = spacecraft.agent()
LEO = load_spacecraft(tiny.ROOT / "examples" / "leo_6u.toml").task
BODY = LEO.spacecraft.model_copy(update={"max_rate_deg": 8.0})
TASK = LEO.model_copy(update={"spacecraft": BODY, "episode_seconds": 15.0})
SHIELD = ShieldConfig(error_bounds=UncertaintyConfig(inertia_error=0.05, rate_noise_deg=0.001))


@pytest.fixture(scope="module")
def guarded(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("guarded")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "golden", blank.golden)
        patch.setattr(files, "shield_golden", blank.shield_golden)
        write_files(path, export(AGENT, "c", SHIELD, TASK))
    return path


def test_the_shield_decides_as_the_core_does(guarded):
    agent, library, count = made_for(AGENT, TASK), CLibrary(guarded), 2000
    model, look_B = known(agent)
    made, limits = shield.from_config(SHIELD, model), np.array(TASK.spacecraft.torque_limits)
    drawn, kind = shield_situations(agent, SHIELD, count, seed=4)
    box = np.random.default_rng(0).uniform(-limits, limits, (count, 3)).astype(np.float32)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, 0))
    def expect(situation: Situation, torque_B: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        at = situation.state(model, look_B)
        left_B = torque_limits(at, model).box_B
        allowed = made.allow(at, jnp.clip(torque_B / left_B, -1.0, 1.0), model).action
        return left_B * jnp.clip(allowed, -1.0, 1.0), left_B, made.covers(at, model)

    expected, left, safe = map(np.asarray, expect(drawn, box))
    found = library.shield(rows(drawn), box)
    passed = np.all(np.abs(expected - np.clip(box, -left, left)) < 1e-6 * limits, axis=1)
    # The same candidate, but for situations within rounding of a threshold.
    same = np.all(np.abs(found - expected) < 1e-3 * limits, axis=1)
    for each in np.unique(kind):
        there = kind == each
        assert np.sum(~passed & there) > 20
        assert np.mean(same[there]) > 0.985 and np.mean(same[there & ~passed]) > 0.95
    assert np.sum(passed) > count // 20 and np.all(np.abs(found) <= left * (1 + 1e-5))
    assert np.mean(library.is_safe(rows(drawn)) == safe) > 0.995 and 0.1 < np.mean(safe) < 0.9
    # With empty wheels it would decide otherwise.
    empty = rows(drawn).copy()
    empty[:, 15:] = 0.0
    assert np.mean(library.is_safe(empty) != safe) > 0.05
    assert np.mean(np.any(np.abs(library.shield(empty, box) - expected) > 1e-3 * limits, axis=1)) > 0.1


def test_the_example_flies_under_it_and_sanitizers_find_nothing(guarded, tmp_path):
    flags = ["-std=c99", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-DKOZ_WITH_SHIELD"]
    sources = [guarded / name for name in ("koz_policy.c", "koz_shield.c", "koz_example.c")]
    built = subprocess.run(
        ["cc", *flags, "-o", tmp_path / "program", *sources, "-lm"], capture_output=True, text=True, check=False
    )
    if "asan" in built.stderr and "cannot find" in built.stderr:
        pytest.skip("there are no sanitizers")
    assert built.returncode == 0, built.stderr
    environment = {**os.environ, "ASAN_OPTIONS": "detect_leaks=0"}
    done = subprocess.run([tmp_path / "program"], capture_output=True, text=True, check=False, env=environment)
    assert "stayed clear" in done.stdout, done.stdout + done.stderr
    assert "below what wheels can stop, and 8 deg/s" in (guarded / "koz_shield.h").read_text()
