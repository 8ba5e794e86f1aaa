"""A policy for any spacecraft, exported for one: it sees, decides and asks for the torque that the core does."""

import re
import shutil
import subprocess
from pathlib import Path

import jax.export
import numpy as np
import pytest
from support import spacecraft, tiny

from koz_jax.agents.agent import load_agent
from koz_jax.agents.numpy_observer import scaled_observer_of
from koz_jax.config.maneuvers.maneuver_file import load_spacecraft
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import TaskConfig
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases
from koz_jax.export.files import export, made_for, write_files
from koz_jax.export.golden import golden
from koz_jax.export.library import CLibrary
from koz_jax.export.loop import HostController
from koz_jax.export.metadata import Metadata, describe
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE, layout, meaning, size

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")

AGENT = spacecraft.agent()
POLICY = AGENT.to_numpy()
CUBESAT = load_spacecraft(tiny.ROOT / "examples" / "cubesat_6u.toml").task
COUNT = 300


def of_odd_shape() -> TaskConfig:
    """A body with products of inertia, unequal limits, an oblique instrument and a limit of its rate."""
    body = spacecraft.spacecraft(np.random.default_rng(7), limited=True)
    step = round(0.02 * body.time_unit, 6)
    return TaskConfig(spacecraft=body, step_seconds=step, episode_seconds=200 * step)


TASKS = {"odd": of_odd_shape(), "cubesat": CUBESAT}


# Where one shows what the other would: the one with products of inertia.
one_task = pytest.mark.parametrize("task", ["odd"], indirect=True)


@pytest.fixture(scope="module", params=TASKS)
def task(request) -> TaskConfig:
    return TASKS[request.param]


@pytest.fixture(scope="module")
def exported(task) -> dict[str, bytes]:
    return export(AGENT, "c", task=task)


@pytest.fixture(scope="module")
def shielded(task, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("shielded")
    write_files(path, export(AGENT, "c", ShieldConfig(), task))
    return path


@pytest.fixture(scope="module")
def vectors(task):
    return golden(made_for(AGENT, task), COUNT, seed=1)


@pytest.mark.slow
@needs_compiler
def test_c_flies_it_as_jax_and_numpy_do(task, folder, vectors):
    library, limits = CLibrary(folder), np.array(task.spacecraft.torque_limits)
    observed, memories = library.observe(vectors.situation, vectors.memory)
    np.testing.assert_allclose(observed, vectors.observation, rtol=0, atol=2e-5)
    np.testing.assert_array_equal(memories[:, 4], vectors.memory[:, 4])
    np.testing.assert_allclose(library.decide(vectors.observation), vectors.action, rtol=0, atol=2e-6)
    torque_B = library.torque(vectors.observation)
    np.testing.assert_allclose(torque_B / limits, vectors.torque / limits, rtol=0, atol=1e-5)
    assert np.std(vectors.action, axis=0).min() > 0.2
    assert 0.02 < np.mean(np.abs(torque_B) > 0.999 * limits) < 0.98
    for number, (row, memory, expected) in enumerate(zip(vectors.situation, vectors.memory, observed, strict=True)):
        q_BN, omega_BN_B, q_DN, axis, half_angle = np.split(row.astype(np.float64), (4, 7, 11, 14))
        observer = scaled_observer_of(POLICY, task.spacecraft, task.step_seconds, float(memory[4]))
        seen = observer.observe(q_BN, omega_BN_B, q_DN, [(axis, np.rad2deg(half_angle[0]))])
        # At a start the error is taken with q_e0 >= 0, in a maneuver as it was before.
        seen[:4] *= np.sign(seen[:4] @ expected[:4])
        np.testing.assert_allclose(seen, expected, rtol=0, atol=2e-5)
        applied = observer.torque(POLICY.predict(vectors.observation[number]))
        np.testing.assert_allclose(applied / limits, torque_B[number] / limits, rtol=0, atol=1e-5)


@needs_compiler
@pytest.mark.slow
@one_task
def test_its_self_tests_pass_and_notice_another_spacecraft(shielded, tmp_path):
    folder = shutil.copytree(shielded, tmp_path / "c")
    done = tiny.make_test(folder)
    assert done.returncode == 0 and done.stdout.count("passed") == 2, done.stdout + done.stderr
    source = (folder / "koz_policy.c").read_text()
    for constant in ("policy_axes", "rate_to_policy", "constant_parts", "torque_per_action"):
        changed = re.sub(rf"({constant}\[.*\] = \{{+)[^,]*,", r"\g<1>0.3f,", source, count=1)
        assert changed != source
        (folder / "koz_policy.c").write_text(changed)
        done = tiny.make_test(folder)
        assert done.returncode != 0 and "FAILED" in done.stdout, constant


@needs_compiler
def test_the_urgency_is_the_users(folder, vectors, tmp_path):
    library = CLibrary(folder)
    memories = library.start(vectors.situation[:5])
    np.testing.assert_array_equal(memories[:, 4], 0.5)
    memories[:, 4] = 0.2, -3.0, 7.0, np.nan, 1.0
    observed, kept = library.observe(vectors.situation[:5], memories)
    np.testing.assert_allclose(observed[:, -1], [-0.6, -1.0, 1.0, 0.0, 1.0], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(kept[:, 4], memories[:, 4])
    (tmp_path / "user.c").write_text(
        '#include <stdio.h>\n#include "koz_policy.h"\n'
        "int main(void)\n{\n    koz_situation now = {{1, 0, 0, 0}, {0, 0, 0}, {1, 0, 0, 0}, {{0, 1, 0}}, {0.3f}};\n"
        '    koz_memory memory;\n    koz_start(&memory, &now);\n    printf("%g", (double)memory.urgency);\n'
        "    return 0;\n}\n"
    )
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-Wconversion", "-DKOZ_URGENCY=0.9", "-I", folder]
    sources = [folder / "koz_policy.c", tmp_path / "user.c"]
    subprocess.run(["cc", *flags, "-o", tmp_path / "user", *sources, "-lm"], check=True)
    assert subprocess.run([tmp_path / "user"], capture_output=True, text=True, check=True).stdout == "0.9"


@needs_compiler
def test_of_no_observation_it_makes_no_torque(folder):
    broken = np.where(np.eye(size(scaled=True)), np.nan, 0.0)
    np.testing.assert_array_equal(CLibrary(folder).torque(broken), 0.0)


@pytest.mark.slow
@needs_compiler
def test_of_several_zones_it_sees_the_nearest(tmp_path):
    network = spacecraft.SCALED.model_copy(update={"observed_zones": 3})
    agent = made_for(spacecraft.agent(network), CUBESAT)
    drawn = golden(agent, 500, seed=2)
    assert np.any(drawn.situation[:, 22] == np.float32(ABSENT_HALF_ANGLE))
    write_files(tmp_path, export(agent, "c"))
    library = CLibrary(tmp_path)
    observed, _ = library.observe(drawn.situation, drawn.memory)
    np.testing.assert_allclose(observed, drawn.observation, rtol=0, atol=2e-5)
    np.testing.assert_allclose(library.decide(drawn.observation), drawn.action, rtol=0, atol=5e-6)


@pytest.mark.slow
@needs_compiler
@one_task
def test_c_flown_in_the_loop_comes_to_the_same_end(folder, task):
    agent = made_for(AGENT, task.model_copy(update={"episode_seconds": 100 * task.step_seconds}))
    config = MonteCarloConfig(cases=8)
    expected = cases.fly_cases(agent.controller, agent.task, config)
    controller = HostController(CLibrary(folder).decide, scaled=True)
    found = cases.fly_cases(controller, agent.task, config)
    np.testing.assert_allclose(found.min_margin, expected.min_margin, rtol=0, atol=1e-4)
    np.testing.assert_allclose(found.control_effort, expected.control_effort, rtol=1e-3)


def test_onnx_decides_and_asks_as_numpy_does(task, vectors):
    import onnxruntime

    session = onnxruntime.InferenceSession(export(AGENT, "onnx", task=task)["koz_policy.onnx"])
    action, torque_B = map(np.asarray, session.run(None, {"observation": vectors.observation}))
    np.testing.assert_allclose(action, POLICY.predict(vectors.observation), rtol=0, atol=2e-6)
    limits = np.array(task.spacecraft.torque_limits)
    np.testing.assert_allclose(torque_B / limits, vectors.torque / limits, rtol=0, atol=1e-5)
    described = Metadata.model_validate_json(session.get_modelmeta().custom_metadata_map["koz_jax"])
    assert described == describe(POLICY, made_for(AGENT, task).task)


def test_stablehlo_decides_as_numpy_does(task, vectors):
    files = export(AGENT, "stablehlo", task=task)
    reloaded = jax.export.deserialize(bytearray(files["koz_policy.jax_export"]))
    found = np.asarray(reloaded.call(vectors.observation))
    np.testing.assert_allclose(found, POLICY.predict(vectors.observation), rtol=0, atol=2e-6)
    assert Metadata.model_validate_json(files["koz_policy.json"]) == describe(POLICY, made_for(AGENT, task).task)


def test_every_export_says_how_it_is_used(task, folder):
    metadata = describe(POLICY, made_for(AGENT, task).task)
    scaling = metadata.scaling
    assert scaling is not None
    for text in (
        export(AGENT, "stablehlo", task=task)["koz_policy.mlir"].decode(),
        (folder / "koz_policy.h").read_text(),
    ):
        flat = " ".join(re.sub(r"\n *(\*|//)? *", " ", text[:6000]).split())
        for name in layout(scaled=True):
            assert f"{name}: {meaning(name, scaled=True)}" in flat
        assert f"T = sqrt(J / u) = {scaling.time_unit:.6g} s" in flat and "torque_per_action" in flat
    # From an action of one about the policy's x axis: J times the acceleration 2 u / J along the instrument.
    inertia_B, body = np.array(task.spacecraft.inertia), task.spacecraft
    expected = inertia_B @ np.array(body.boresight) * 2.0 * scaling.torque_unit / scaling.inertia_unit
    np.testing.assert_allclose(np.array(scaling.torque_per_action)[:, 0], expected, rtol=1e-6)


def test_spacecraft_of_a_spread_is_the_tasks_own_by_default():
    spread = SpreadConfig(spacecraft=True, max_rate_deg=(2.0, 60.0), urgency=(0.0, 1.0))
    task = AGENT.task.model_copy(update={"spread": spread})
    made = made_for(type(AGENT)(AGENT.controller, task, AGENT.provenance, AGENT.name))
    assert made.task == AGENT.task and made.task.spread.is_none


def test_an_urgency_of_the_agents_is_the_default():
    header = export(AGENT.with_urgency(0.75), "c")["koz_policy.h"].decode()
    assert "#define KOZ_URGENCY 0.75f\n" in header


@pytest.mark.slow
@needs_compiler
@one_task
def test_a_shield_of_another_spacecraft_is_not_compiled_in(shielded, task, tmp_path):
    (other,) = (each for each in TASKS.values() if each != task)
    write_files(tmp_path, export(AGENT, "c", task=other))
    shutil.copy(shielded / "koz_shield.c", tmp_path)
    shutil.copy(shielded / "koz_shield.h", tmp_path)
    with pytest.raises(SettingsError, match="different exports"):
        CLibrary(tmp_path)


def test_the_command_line(tmp_path, capsys):
    AGENT.save(tmp_path / "agent")
    file = tiny.ROOT / "examples" / "cubesat_6u.toml"
    out = ["--out", tmp_path / "c", "--to", "c"]
    assert tiny.status("export", tmp_path / "agent", *out, "--spacecraft", file) == 0
    expected = export(load_agent(tmp_path / "agent"), "c", task=CUBESAT)
    assert {name: (tmp_path / "c" / name).read_bytes() for name in expected} == expected
    header = (tmp_path / "c" / "koz_policy.h").read_text()
    assert "trained for any spacecraft, sees the nearest" in " ".join(header.replace("\n *", "").split())
    assert "#define KOZ_STEP_SECONDS 0.2f" in header and "#define KOZ_TORQUE_LIMIT 0.004f" in header
    assert tiny.status("export", tmp_path / "agent", *out, "--spacecraft", file, "--urgency", 0.25) == 0
    assert "#define KOZ_URGENCY 0.25f" in (tmp_path / "c" / "koz_policy.h").read_text()
    capsys.readouterr()
    assert tiny.status("export", "phase2", "--to", "c", "--out", tmp_path / "other", "--urgency", 0.25) == 2
    assert "error: urgency: phase2 was trained for one trade" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()
    assert tiny.status("export", "phase2", *out, "--spacecraft", file) == 2
    assert "error: spacecraft: phase2 was trained for one spacecraft" in capsys.readouterr().err
    gyros = tiny.ROOT / "examples" / "cmg_smallsat.toml"
    assert tiny.status("export", tmp_path / "agent", *out, "--spacecraft", gyros) == 2
    assert "error: spacecraft.gyros: are not exported yet" in capsys.readouterr().err
    assert tiny.status("export", tmp_path / "agent", *out, "--spacecraft", tmp_path / "none.toml") == 2
    assert "none.toml cannot be read" in capsys.readouterr().err


@pytest.mark.parametrize("to", ["onnx", "stablehlo"])
def test_formats_that_know_one_instrument_refuse_a_file_with_two(to, tmp_path, capsys):
    file = tmp_path / "two.toml"
    text = (tiny.ROOT / "examples" / "cubesat_6u.toml").read_text()
    file.write_text(text + '\n[[instruments]]\nname = "second"\nboresight = [1, 0, 0]\n')
    assert tiny.status("export", "universal", "--to", to, "--out", tmp_path / "out", "--spacecraft", file) == 2
    err = capsys.readouterr().err
    assert f"two.toml has 2 instruments, of which only --to c knows all; leave one in the file, got --to {to}" in err
    assert not (tmp_path / "out").exists()


@needs_compiler
@pytest.mark.slow
def test_the_command_line_exports_the_shipped_agent_and_its_shield_for_a_cubesat(tmp_path):
    file = tiny.ROOT / "examples" / "cubesat_6u.toml"
    argv = ["universal", "--to", "c", "--out", tmp_path, "--spacecraft", file, "--shield"]
    assert tiny.status("export", *argv) == 0
    source = (tmp_path / "koz_shield.c").read_text()
    assert "inertia[3][3] = {{0.05f, 0.0f, 0.0f}, {0.0f, 0.06f, 0.0f}, {0.0f, 0.0f, 0.02f}};" in source
    done = tiny.make_test(tmp_path)
    assert done.returncode == 0 and done.stdout.count("passed") == 2, done.stdout + done.stderr
