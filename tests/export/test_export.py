"""Exported controllers: they decide as the agent does, alone and in the loop, and say what they are."""

import dataclasses
import re
import shutil
import subprocess

import jax.export
import numpy as np
import pytest
from support import oracle, tiny

from koz_jax.agents.agent import Agent, load_agent
from koz_jax.agents.numpy_policy import load_policy
from koz_jax.agents.record import Provenance
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.training import NO_ENCODING
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.export.c_source.literals import number
from koz_jax.export.c_source.policy import C_FILES
from koz_jax.export.files import export, write_files
from koz_jax.export.golden import Golden, golden
from koz_jax.export.library import STRICT, CLibrary
from koz_jax.export.loop import HostController
from koz_jax.export.metadata import as_text, describe, training_sha256
from koz_jax.task.observation_layout import SIZE, layout, meaning, size

ACTION_RANGE = 2.0
UNEQUAL = (2.0, 1.0, 0.3)  # [N m]
CASES = MonteCarloConfig(cases=50, seed=3)

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")


@pytest.fixture(scope="module")
def agent() -> Agent:
    """Enters most zones and misses some: its verdicts differ."""
    return load_agent("phase1")


@pytest.fixture(scope="module")
def vectors(agent) -> Golden:
    """10,000 observations, other ones than those in the exported self-test."""
    return golden(agent, 10_000, seed=1)


@pytest.fixture(scope="module")
def exported(agent) -> dict[str, bytes]:
    return export(agent, "c")


@pytest.fixture(scope="module")
def flown(agent) -> CaseResult:
    """The cases as the agent flies them."""
    return cases.fly_cases(agent.controller, agent.task, CASES)


@pytest.fixture(scope="module")
def session(agent):
    import onnxruntime

    return onnxruntime.InferenceSession(export(agent, "onnx")["koz_policy.onnx"])


@pytest.mark.slow
def test_the_golden_situations_cover_the_envelope(vectors):
    q_e, omega = vectors.observation[:, :4], vectors.observation[:, 4:7]
    angle = np.rad2deg(oracle.rotation_angle(q_e))
    assert angle.min() < 0.01 and angle.max() > 170
    assert 0.02 < np.mean(np.linalg.norm(omega, axis=1) < 1e-4)
    margin = vectors.observation[:, 10]
    assert margin.min() < 0 < margin.max()
    assert np.abs(vectors.action).max() > 0.99 and np.mean(np.abs(vectors.action) < 0.5) > 0.1


def test_golden_observations_are_those_of_the_paper(vectors):
    flipped = 0
    for situation, before, observed in zip(vectors.situation[:50], vectors.memory, vectors.observation, strict=False):
        q_BN, omega, q_DN, axis, half_angle = np.split(situation.astype(np.float64), (4, 7, 11, 14))
        if oracle.product(oracle.conjugate(q_DN), q_BN) @ before < 0.0:
            q_BN, flipped = -q_BN, flipped + 1
        expected = oracle.observation(q_BN, omega, q_DN, axis, half_angle[0], before[0])
        np.testing.assert_allclose(observed, expected, rtol=0, atol=5e-6)
        # One step before, at the same rate.
        apart = oracle.product(oracle.conjugate(before.astype(np.float64)), observed[:4])
        np.testing.assert_allclose(2.0 * apart[1:], 0.1 * omega, rtol=1e-3, atol=1e-6)
    assert 10 < flipped < 40, "attitudes of either sign"


@needs_compiler
def test_c_observes_and_decides_alike(library, vectors):
    # The direction to a zone's axis that the telescope nearly points at is a small difference divided by itself.
    observed, memories = library.observe(vectors.situation, vectors.memory)
    np.testing.assert_allclose(observed, vectors.observation, rtol=0, atol=2e-5)
    np.testing.assert_array_equal(memories, observed[:, :4])
    actions = library.decide(vectors.observation)
    np.testing.assert_allclose(actions, vectors.action, rtol=0, atol=1e-5 * ACTION_RANGE)
    np.testing.assert_array_equal(library.torque(vectors.observation), np.float32(2.0) * actions)


@needs_compiler
def test_c_of_the_agent_that_minds_the_zone(tmp_path):
    other = load_agent("phase2")
    write_files(tmp_path, export(other, "c"))
    drawn = golden(other, 10_000, seed=2)
    found = CLibrary(tmp_path).decide(drawn.observation)
    np.testing.assert_allclose(found, drawn.action, rtol=0, atol=1e-5 * ACTION_RANGE)


@needs_compiler
def test_c_is_strict_and_needs_nothing_but_libm(folder, tmp_path):
    extra = ["-Wconversion", "-Wdouble-promotion", "-Wshadow"]
    build = ["cc", *STRICT, *extra, "-c", folder / "koz_policy.c", "-o", tmp_path / "koz_policy.o"]
    subprocess.run(build, check=True)
    symbols = subprocess.run(["nm", "-u", tmp_path / "koz_policy.o"], capture_output=True, text=True, check=True)
    assert set(re.findall(r"U (\w+)", symbols.stdout)) <= {
        "tanhf",
        "atan2f",
        "sqrtf",
        "_GLOBAL_OFFSET_TABLE_",
        "memcpy",
    }


@pytest.mark.slow
@needs_compiler
def test_the_self_test_passes_and_notices_a_changed_weight(folder, tmp_path):
    folder = shutil.copytree(folder, tmp_path / "c")
    done = tiny.make_test(folder)
    assert done.returncode == 0 and "golden vectors: 100" in done.stdout and "passed" in done.stdout
    assert "warning" not in done.stdout + done.stderr
    source = (folder / "koz_policy.c").read_text()
    changed = re.sub(r"(bias_2\[3\] = \{)[^,]*,", r"\g<1>0.5f,", source)
    assert changed != source
    (folder / "koz_policy.c").write_text(changed)
    done = tiny.make_test(folder)
    assert done.returncode != 0 and "FAILED" in done.stdout


@pytest.mark.slow
@needs_compiler
def test_c_flown_in_the_loop_gets_the_same_verdicts(agent, flown, library):
    found = cases.fly_cases(HostController(library.decide), agent.task, CASES)
    np.testing.assert_array_equal(found.settled, flown.settled)
    np.testing.assert_array_equal(found.violated, flown.violated)
    assert 0 < np.sum(flown.violated) < CASES.cases
    np.testing.assert_allclose(found.min_margin, flown.min_margin, rtol=0, atol=1e-4)
    np.testing.assert_allclose(found.settling_time, flown.settling_time, rtol=0, atol=0.11)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("hidden_sizes", [(), (5, 6, 7)])
def test_c_of_other_networks(hidden_sizes, tmp_path):
    network = tiny.CONFIG.network.model_copy(update={"hidden_sizes": hidden_sizes, "encoding": NO_ENCODING})
    other = tiny.untrained_agent(network=network)
    write_files(tmp_path, export(other, "c"))
    drawn = golden(other, 100, seed=5)
    np.testing.assert_allclose(CLibrary(tmp_path).decide(drawn.observation), drawn.action, rtol=0, atol=1e-6)


@pytest.mark.slow
@needs_compiler
def test_exports_of_a_policy_that_sees_several_zones(tmp_path):
    import onnxruntime

    network = tiny.CONFIG.network.model_copy(update={"observed_zones": 3})
    crowded = tiny.CONFIG.task.scenario.model_copy(update={"max_zones": 4})
    other = tiny.untrained_agent(network=network)
    other = dataclasses.replace(other, task=other.task.model_copy(update={"scenario": crowded}))
    drawn = golden(other, 1000, seed=6)
    assert drawn.situation.shape[1] == 11 + 4 * 4 and drawn.observation.shape[1] == size(3) == 26
    absent = drawn.observation[:, 21] == np.float32(np.pi)
    assert 0 < np.sum(absent) < 500
    write_files(tmp_path, export(other, "c"))
    library = CLibrary(tmp_path)
    observed, _ = library.observe(drawn.situation, drawn.memory)
    np.testing.assert_allclose(observed, drawn.observation, rtol=0, atol=2e-5)
    np.testing.assert_allclose(library.decide(drawn.observation), drawn.action, rtol=0, atol=1e-6)
    subprocess.run(["make", "-s", "-C", tmp_path, "test"], check=True, capture_output=True)
    session = onnxruntime.InferenceSession(export(other, "onnx")["koz_policy.onnx"])
    action = np.asarray(session.run(["action"], {"observation": drawn.observation})[0])
    np.testing.assert_allclose(action, drawn.action, rtol=0, atol=1e-6)
    reloaded = jax.export.deserialize(bytearray(export(other, "stablehlo")["koz_policy.jax_export"]))
    np.testing.assert_allclose(reloaded.call(drawn.observation), drawn.action, rtol=0, atol=1e-6)
    np.testing.assert_allclose(other.to_numpy().predict(drawn.observation), drawn.action, rtol=0, atol=1e-6)


def of_unequal_limits(agent: Agent) -> Agent:
    """The same agent on a spacecraft whose axes have limits of their own."""
    spacecraft = agent.task.spacecraft.model_copy(update={"torque_limit": UNEQUAL})
    return dataclasses.replace(agent, task=agent.task.model_copy(update={"spacecraft": spacecraft}))


@pytest.mark.slow
def test_exports_of_unequal_torque_limits_scale_every_axis(agent, vectors, tmp_path):
    import onnxruntime

    other = of_unequal_limits(agent)
    assert "torque 2, 1 and 0.3 N m about the body axes" in " ".join(as_text(describe(other.to_numpy())).split())
    expected = np.array(UNEQUAL, np.float32) * vectors.action
    session = onnxruntime.InferenceSession(export(other, "onnx")["koz_policy.onnx"])
    torque = np.asarray(session.run(["torque_B"], {"observation": vectors.observation})[0])
    np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-4)
    if shutil.which("cc") is None:
        return
    write_files(tmp_path, export(other, "c"))
    library = CLibrary(tmp_path)
    np.testing.assert_allclose(library.torque(vectors.observation), expected, rtol=0, atol=1e-4)
    done = tiny.make_test(tmp_path)
    assert done.returncode == 0 and done.stdout.count("passed") == 1, done.stdout + done.stderr


def test_limits_that_are_told_one_by_one_but_equal_are_one(agent):
    spacecraft = agent.task.spacecraft.model_copy(update={"torque_limit": (2.0, 2.0, 2.0)})
    other = dataclasses.replace(agent, task=agent.task.model_copy(update={"spacecraft": spacecraft}))
    assert describe(other.to_numpy()).torque_limit == 2.0


def test_onnx_decides_alike(session, vectors):
    action, torque = session.run(None, {"observation": vectors.observation})
    np.testing.assert_allclose(action, vectors.action, rtol=0, atol=1e-5 * ACTION_RANGE)
    np.testing.assert_array_equal(torque, np.float32(2.0) * action)
    one = session.run(["action"], {"observation": vectors.observation[:1]})[0]
    np.testing.assert_allclose(one, action[:1], rtol=0, atol=1e-6)


@pytest.mark.slow
def test_onnx_flown_in_the_loop_gets_the_same_verdicts(agent, flown, session):
    def decide(observed: np.ndarray) -> np.ndarray:
        return session.run(["action"], {"observation": observed})[0]

    found = cases.fly_cases(HostController(decide), agent.task, CASES)
    np.testing.assert_array_equal(found.settled, flown.settled)
    np.testing.assert_array_equal(found.violated, flown.violated)


def test_stablehlo_reloads_and_decides_alike(agent, vectors):
    files = export(agent, "stablehlo")
    reloaded = jax.export.deserialize(bytearray(files["koz_policy.jax_export"]))
    for count in (1, 10_000):
        found = np.asarray(reloaded.call(vectors.observation[:count]))
        np.testing.assert_allclose(found, vectors.action[:count], rtol=0, atol=1e-5 * ACTION_RANGE)
    assert reloaded.fun_name.endswith(training_sha256(agent.to_numpy().record)[:16])
    assert {"cpu", "cuda", "tpu"} <= set(reloaded.platforms)
    text = files["koz_policy.mlir"].decode()
    assert "tensor<16xf32>" in text and "stablehlo.dot_general" in text


def test_every_export_carries_its_metadata(agent, session, folder):
    metadata = describe(agent.to_numpy())
    files = export(agent, "stablehlo")
    texts = [files["koz_policy.mlir"].decode(), *((folder / f"koz_policy.{kind}").read_text() for kind in "ch")]
    for text in texts:
        flat = " ".join(re.sub(r"\n *(\*|//)? *", " ", text[:4000]).split())
        for name in layout():
            assert f"{name}: {meaning(name)}" in flat
        assert metadata.training_sha256 in flat and metadata.weights_sha256 in flat
        assert "torque 2 N m" in flat and agent.provenance.command in flat
        assert f"config.json: {agent.provenance.config_sha256}" in flat and len(agent.provenance.config_sha256) == 64
    for described in (session.get_modelmeta().custom_metadata_map["koz_jax"], files["koz_policy.json"]):
        assert type(metadata).model_validate_json(described) == metadata
    ends = [entry.start + entry.size for entry in metadata.observation]
    assert [entry.start for entry in metadata.observation] == [0, *ends[:-1]] and ends[-1] == SIZE


def test_the_hash_is_of_the_training_and_not_of_its_verdict(agent):
    record = agent.to_numpy().record
    judged = record.model_copy(update={"provenance": record.provenance.model_copy(update={"table": {"cases": 1}})})
    reseeded = record.model_copy(update={"provenance": record.provenance.model_copy(update={"seed": 9})})
    assert training_sha256(judged) == training_sha256(record) != training_sha256(reseeded)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("phase1", "85e260137ae333a7e467fe84ff5a2c769a5e7db3c5c1af6099538bc4c2ec2dd7"),
        ("phase2", "a3928d29a134624bcdafe2139a6e824c8726c0f5ce101473c0c52bc9f794d60e"),
        ("phase2-sac", "69e126d206a045ab577fa8c3e50bf5e27f4e0ddfe558e13e27a57b864f1a4547"),
        ("universal", "6a451bc48b3135d01ca4aded0307490f20467115d228542c966705fd5fdd9edc"),
        ("zones3", "9a9011652d6f56fcbb1d870f5782a5d22bda37bd9303524acceaa4d99e2ec41d"),
    ],
)
def test_hashes_of_shipped_agents_stay_where_settings_get_new_fields(name, expected):
    """New ones belong into ``later``; another agent under the name has another hash."""
    assert training_sha256(load_policy(name).record) == expected


def test_a_provenance_cannot_leave_its_comment(agent):
    record = agent.to_numpy().record.model_copy(update={"provenance": Provenance(command="*/ int x; /* \\\n?? //")})
    policy = type(agent.to_numpy())(views=(), layers=agent.to_numpy().layers, record=record, name="a*/b\nc*\\d\\")
    text = as_text(describe(policy))
    assert "*/" not in text and "/*" not in text and "\\" not in text
    assert all(line == "" or len(line) <= 110 for line in text.splitlines())


def test_the_command_line(capsys, tmp_path):
    tiny.untrained_agent().save(tmp_path / "agent")
    assert tiny.status("export", str(tmp_path / "agent"), "--to", "c", "--out", str(tmp_path / "new" / "c")) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / "new" / "c" / name) for name in C_FILES]
    assert tiny.status("export", "nowhere", "--to", "c", "--out", str(tmp_path)) == 2
    assert "error: agent: 'nowhere' is neither" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert tiny.status("export", "phase2", "--to", "c", "--out", str(tmp_path / "file")) == 2
    assert "error: out: " in capsys.readouterr().err
    with pytest.raises(SettingsError, match=r"holds no koz_policy\.c"):
        CLibrary(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(("to", "missing"), [("onnx", "onnx"), ("stablehlo", "flatbuffers")])
def test_a_missing_extra_says_what_to_install(to, missing, tmp_path):
    code = (
        f"import sys; sys.modules['{missing}'] = None\n"
        "from koz_jax.cli.main import main\n"
        f"sys.exit(main(['export', 'phase2', '--to', '{to}', '--out', {str(tmp_path)!r}]))"
    )
    done = tiny.run_python("-c", code)
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {missing}: cannot be imported; install it with: pip install 'koz_jax[{to}]'")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_library_needs_no_jax():
    code = "import sys, koz_jax.export.library; print([name for name in ('jax', 'flax') if name in sys.modules])"
    done = tiny.run_python("-c", code)
    assert done.stdout == "[]\n"


def test_what_no_export_has_written_is_not_overwritten(agent, tmp_path):
    (tmp_path / "Makefile").write_text("all: my own\n")
    before = tiny.contents(tmp_path)
    with pytest.raises(SettingsError, match=r"out: .*Makefile was not written by an export"):
        write_files(tmp_path, export(agent, "c"))
    assert tiny.contents(tmp_path) == before


def test_every_format_is_exported_anew_in_its_place(agent, tmp_path):
    for to in ("c", "onnx", "stablehlo", "c", "onnx", "stablehlo"):
        write_files(tmp_path, export(agent, to))
    assert (tmp_path / "koz_policy.c").is_file() and (tmp_path / "koz_policy.onnx").is_file()


@pytest.mark.parametrize("value", [0.1, 1e-5, -2.0, 0.016608869656920433, 3.4e38])
def test_constants_are_the_shortest_that_read_back(value):
    text = number(value)
    assert text.endswith("f") and np.float32(text[:-1]) == np.float32(value)
    assert len(text) <= len("-1.23456789e-38f")
