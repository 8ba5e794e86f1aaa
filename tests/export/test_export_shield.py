"""The exported shield decides as the core's does, and holds where it is the one that flies."""

import dataclasses
import functools
import re
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from pydantic import ValidationError
from support import oracle, tiny

from koz_jax.agents.agent import Agent, load_agent
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.training import TrainConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.control.base import Controller
from koz_jax.control.registry import load_controller
from koz_jax.control.shield import filter as shield
from koz_jax.control.shield.filter import Shield
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases, monte_carlo, rollout
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.export.c_source.shield import SHIELD_FILES
from koz_jax.export.files import export, write_files
from koz_jax.export.golden import Situation, rows
from koz_jax.export.library import CLibrary
from koz_jax.export.shield_golden import shield_golden, shield_situations
from koz_jax.task.environment import Reorientation, model_from_config
from koz_jax.task.state import EnvState, Model, torque_limits

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")

CONFIG = ShieldConfig(margin_deg=0.2)
ROBUST = ShieldConfig(
    error_bounds=UncertaintyConfig(
        inertia_error=0.1, disturbance_torque=0.02, attitude_noise_deg=0.01, rate_noise_deg=0.001
    )
)
COUNT = 4000


@pytest.fixture(scope="module")
def agent():
    return load_agent("phase1")


@pytest.fixture(scope="module")
def exported(agent) -> dict[str, bytes]:
    return export(agent, "c", CONFIG)


@pytest.fixture(scope="module")
def vectors(agent) -> np.ndarray:
    return rows(shield_situations(agent, CONFIG, COUNT, seed=4)[0])


def requests(limits: tuple[float, ...] = (2.0, 2.0, 2.0)) -> np.ndarray:
    """Torques anywhere in the box."""
    return np.random.default_rng(0).uniform(np.negative(limits), limits, (COUNT, 3)).astype(np.float32)


def check_alike(agent: Agent, library: CLibrary, config: ShieldConfig = CONFIG) -> None:
    """Check that C and the core allow the same torques, everywhere, at the edge of a zone and inside."""
    model = model_from_config(agent.task)
    made, boresight_B = shield.from_config(config, model), jnp.array(agent.task.spacecraft.boresight)
    limits = agent.task.spacecraft.torque_limits
    requested = requests(limits)
    drawn, kind = shield_situations(agent, config, COUNT, seed=4)
    expected = np.asarray(expect(made, model, boresight_B, drawn, requested))
    found = library.shield(rows(drawn), requested)
    passed = np.all(expected == requested, axis=1)
    # The same candidate, but for situations within rounding of a threshold.
    same = np.all(np.abs(found - expected) < 1e-3, axis=1)
    for each in np.unique(kind):
        there = kind == each
        assert np.sum(~passed & there) > 20
        assert np.mean(same[there]) > 0.985 and np.mean(same[there & ~passed]) > 0.95
    assert np.sum(passed) > COUNT // 10, "some requests pass and some do not"
    assert np.array_equal(found[passed & same], requested[passed & same])
    assert np.all(np.abs(found) <= np.array(limits, np.float32))


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, None, None, 0, 0))
def expect(made: Shield, model: Model, boresight_B: jax.Array, drawn: Situation, torque_B: jax.Array) -> jax.Array:
    at = drawn.state(model, boresight_B)
    return made.filter(at.body, torque_B, at.scenario.constraints, torque_limits(at, model), model)


@pytest.mark.slow
def test_it_decides_as_the_core_does(agent, library):
    check_alike(agent, library)


def of_the_task(agent: Agent, **spacecraft: object) -> Agent:
    """The same agent on another spacecraft."""
    changed = agent.task.spacecraft.model_copy(update=spacecraft)
    return dataclasses.replace(agent, task=agent.task.model_copy(update={"spacecraft": changed}))


@pytest.mark.slow
def test_it_decides_as_the_core_does_where_every_axis_has_its_own_limit(agent, tmp_path):
    other = of_the_task(agent, torque_limit=(2.0, 1.0, 0.3))
    write_files(tmp_path, export(other, "c", CONFIG))
    check_alike(other, CLibrary(tmp_path))
    done = tiny.make_test(tmp_path)
    assert done.returncode == 0 and done.stdout.count("passed") == 2, done.stdout + done.stderr


@pytest.mark.slow
def test_it_decides_as_the_core_does_where_it_withstands_errors(agent, tmp_path):
    write_files(tmp_path, export(agent, "c", ROBUST))
    check_alike(agent, CLibrary(tmp_path), ROBUST)


@pytest.mark.slow
def test_it_decides_as_the_core_does_where_there_is_a_rate_limit(agent, tmp_path):
    """Some of the situations are above it, and some requests would lead there."""
    limited = of_the_task(agent, max_rate_deg=3.0)
    write_files(tmp_path, export(limited, "c", CONFIG))
    check_alike(limited, CLibrary(tmp_path))


@pytest.mark.slow
def test_it_decides_as_the_core_does_where_cones_turn(agent, tmp_path):
    config = ShieldConfig(cone_rate_deg=0.5)
    write_files(tmp_path, export(agent, "c", config))
    assert "cone_rate = 0.0087" in (tmp_path / "koz_shield.c").read_text()
    assert "turn by up to 0.5 deg/s" in (tmp_path / "koz_shield.h").read_text()
    check_alike(agent, CLibrary(tmp_path), config)
    done = tiny.make_test(tmp_path)
    assert done.returncode == 0 and done.stdout.count("passed") == 2, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("config", [CONFIG, ROBUST], ids=["plain", "robust"])
def test_golden_vectors_are_of_every_kind(agent, config):
    drawn = shield_golden(agent, config, 100)
    assert len(drawn.allowed) == 100 and 20 < np.sum(drawn.safe) < 80
    q_BN, omega, _, axis, half_angle = np.split(drawn.situation.astype(np.float64), (4, 7, 11, 14), axis=1)
    look = np.array([oracle.rotation(q).apply(oracle.BORESIGHT) for q in q_BN])
    margin = np.rad2deg(oracle.angle_between(look, axis) - half_angle[:, 0])
    slow = np.linalg.norm(omega @ oracle.INERTIA, axis=1) < 2.0 * 2.0 * 0.1
    passed = np.all(drawn.allowed == drawn.requested, axis=1)
    for there in (slow & (np.abs(margin) < 1.0), slow & (margin < -1.0)):
        assert np.sum(there) > 20 and np.sum(passed & there) < np.sum(there)


@pytest.mark.slow
def test_out_of_a_zone_from_rest(library):
    """120 deg about z, 1 deg inside a zone: no torque would leave the telescope on the Sun."""
    row = np.zeros((1, 15))
    row[0, [0, 3]] = np.cos(np.pi / 3.0), np.sin(np.pi / 3.0)
    row[0, 7] = 1.0
    bearing = np.deg2rad(101.0)
    row[0, 11:] = np.cos(bearing), np.sin(bearing), 0.0, np.deg2rad(20.0)
    margins = []
    for _ in range(400):
        margins.append(oracle.margins(row[0, :4], oracle.BORESIGHT, row[:, 11:14], row[:, 14])[0])
        torque = library.shield(row, np.zeros((1, 3)))
        row[:, :4], row[:, 4:7] = oracle.propagate_many(row[:, :4], row[:, 4:7], torque.astype(float), 0.1)
    assert margins[0] == pytest.approx(np.deg2rad(-1.0), abs=1e-6)
    assert np.min(margins) > margins[0] - 1e-6 and margins[-1] > np.deg2rad(0.05)


class Guarded(struct.PyTreeNode):
    """Another controller with the C shield in its way."""

    inner: Controller
    library: CLibrary = struct.field(pytree_node=False)

    def begin(self, state: EnvState, model: Model, key: jax.Array):
        return self.inner.begin(state, model, key)

    def decide(self, state: EnvState, model: Model, memory):
        action, memory = self.inner.decide(state, model, memory)
        zones, body = state.scenario.constraints, state.body
        told = (body.q_BN, body.omega_BN_B, state.scenario.q_DN, zones.axis_N.ravel(), zones.half_angle)
        row = jax.numpy.concatenate(told)
        shape = jax.ShapeDtypeStruct((3,), np.float32)
        limit = torque_limits(state, model).box_B
        allowed = jax.pure_callback(self._ask, shape, row, limit * action, vmap_method="broadcast_all")
        return allowed / limit, memory

    def _ask(self, rows: np.ndarray, torques: np.ndarray) -> np.ndarray:
        allowed = self.library.shield(np.atleast_2d(rows), np.atleast_2d(torques))
        return allowed.reshape(np.shape(torques))


@pytest.mark.slow
def test_it_holds_against_one_who_steers_into_the_zone(agent, library):
    env = Reorientation.from_config(agent.task).replace(episode_steps=300)
    adversary = load_controller("adversary").controller
    config = MonteCarloConfig(cases=24, seed=1)

    @jax.jit
    @jax.vmap
    def fly(case: jax.Array) -> tuple[CaseResult, ...]:
        drawn = cases.draw_case(agent.task, config, case)
        key = jax.random.key(1)
        return tuple(
            rollout.run_case(env, who, drawn, substeps=4, key=key) for who in (adversary, Guarded(adversary, library))
        )

    bare, guarded = fly(np.arange(config.cases))
    assert np.all(np.asarray(bare.violated))
    assert not np.any(np.asarray(guarded.violated))


@pytest.mark.slow
def test_what_is_not_a_number_never_passes(library, vectors):
    nothing = np.full((COUNT, 3), np.nan, np.float32)
    found = library.shield(vectors, nothing)
    assert np.all(np.isfinite(found)) and np.all(np.abs(found) <= 2.0)


@pytest.mark.slow
def test_of_a_situation_that_is_no_situation_it_makes_no_torque(library, vectors):
    for column in range(vectors.shape[1]):
        broken = vectors[:1].copy()
        broken[0, column] = np.nan
        np.testing.assert_array_equal(library.shield(broken, np.ones((1, 3))), np.zeros((1, 3)))


@pytest.mark.slow
def test_only_directions_count(library, vectors):
    """An axis of the wrong length must not be a false "safe"."""
    longer = vectors.copy()
    longer[:, :4] *= -2.0
    longer[:, 11:14] *= 1000.0
    same = np.all(np.abs(library.shield(longer, requests()) - library.shield(vectors, requests())) < 1e-3, axis=1)
    assert np.mean(same) > 0.99


@pytest.mark.slow
def test_the_command_line_asks_for_it(tmp_path, capsys):
    tiny.untrained_agent().save(tmp_path / "agent")
    where = [str(tmp_path / "agent"), "--out", str(tmp_path / "c")]
    assert tiny.status("export", *where, "--to", "c", "--shield", "--shield-margin-deg", "0.5") == 0
    assert "Keeps 0.5 deg from every zone" in (tmp_path / "c" / "koz_shield.h").read_text()
    assert CLibrary(tmp_path / "c").has_shield
    capsys.readouterr()
    for flags, reason in (
        (["--to", "onnx", "--shield"], "error: shield: is exported as C only"),
        (["--to", "c", "--robust"], "error: robust: is of the shield, and needs --shield"),
        (["--to", "c", "--shield", "--robust"], "error: robust: needs an error to withstand"),
        (["--to", "c", "--shield", "--inertia-error", "0.1"], "error: inertia_error: is for the shield to withstand"),
        (
            ["--to", "c", "--shield", "--robust", "--disturbance-torque", "5"],
            "error: disturbance_torque: must be below",
        ),
        (["--to", "c", "--shield-margin-deg", "0.5"], "error: shield_margin_deg: needs --shield"),
        (
            ["--to", "c", "--shield", "--shield-margin-deg", "0"],
            "error: shield_margin_deg: Input should be greater than 0",
        ),
    ):
        assert tiny.status("export", *where, *flags) == 2
        assert reason in capsys.readouterr().err
    # Without one, none of an earlier export stays to be compiled in.
    assert tiny.status("export", *where, "--to", "c") == 0
    assert not list((tmp_path / "c").glob("koz_shield*"))
    with pytest.raises(SettingsError, match="exported without"):
        CLibrary(tmp_path / "c").shield(np.zeros((1, 15)), np.zeros((1, 3)))


@pytest.mark.slow
def test_the_command_line_asks_for_a_robust_one(tmp_path):
    tiny.untrained_agent().save(tmp_path / "agent")
    errors = {
        "inertia-error": "0.1",
        "disturbance-torque": "0.02",
        "attitude-noise-deg": "0.01",
        "rate-noise-deg": "0.001",
    }
    flags = [text for name, error in errors.items() for text in (f"--{name}", error)]
    where = [str(tmp_path / "agent"), "--to", "c", "--out", str(tmp_path / "c")]
    assert tiny.status("export", *where, "--shield", "--robust", *flags) == 0
    head = (tmp_path / "c" / "koz_shield.h").read_text()
    for stated in ("0.1 of the inertia", "0.02 N m of constant", "0.01 deg per axis", "0.001 deg/s per axis"):
        assert stated in head
    done = tiny.make_test(tmp_path / "c")
    assert done.returncode == 0 and done.stdout.count("passed") == 2, done.stdout + done.stderr


@pytest.mark.slow
def test_its_self_test_passes_and_notices_another_margin(exported, tmp_path):
    write_files(tmp_path, exported)
    done = tiny.make_test(tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "golden vectors of the shield: 100" in done.stdout and done.stdout.count("passed") == 2
    source = (tmp_path / "koz_shield.c").read_text()
    changed = re.sub(r"(shield_margin = )[^;]*;", r"\g<1>0.2f;", source)
    assert changed != source
    (tmp_path / "koz_shield.c").write_text(changed)
    done = tiny.make_test(tmp_path)
    assert done.returncode != 0 and "FAILED" in done.stdout


@pytest.mark.slow
def test_a_shield_of_another_controller_is_not_compiled_in(exported, tmp_path):
    write_files(tmp_path, export(load_agent("zones3"), "c"))
    for name in SHIELD_FILES:
        (tmp_path / name).write_bytes(exported[name])
    with pytest.raises(SettingsError, match="different exports"):
        CLibrary(tmp_path)


@pytest.mark.slow
def test_rows_that_c_would_read_beyond_are_refused(library):
    situations, torques = np.zeros((2, 15)), np.zeros((2, 3))
    for one, other, message in (
        (np.zeros((2, 5)), torques, r"situations: must have shape \(batch, 15\), got \(2, 5\)"),
        (situations, np.zeros((2, 1)), r"torques: must have shape \(batch, 3\), got \(2, 1\)"),
        (situations, np.zeros((3, 3)), "torques: must be one for each of 2 situations, got 3"),
    ):
        with pytest.raises(SettingsError, match=message):
            library.shield(one, other)
    with pytest.raises(SettingsError, match="memories: must be one for each of 2 situations, got 1"):
        library.observe(situations, np.zeros((1, 4)))


def test_it_cannot_withstand_what_there_is_no_torque_for(agent):
    config = ShieldConfig(error_bounds=UncertaintyConfig(disturbance_torque=2.0))
    with pytest.raises(SettingsError, match=r"disturbance_torque: must be below .* of 2\.0 N m .*, got 2\.0"):
        export(agent, "c", config)
    with pytest.raises(SettingsError, match="disturbance_torque"):
        monte_carlo.monte_carlo(agent, 1, shield=config)
    shielding = {"enabled": True, "shield": config.model_dump()}
    with pytest.raises(ValidationError, match="disturbance_torque"):
        TrainConfig.model_validate(tiny.merged(tiny.CONFIG.model_dump(), {"shielding": shielding}))
