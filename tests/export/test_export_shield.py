"""The exported shield decides as the core's does, and holds where it is the one that flies."""

import dataclasses
import re
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from pydantic import ValidationError
from support import tiny

from koz_jax.agents.agent import Agent, load_agent
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig, UncertaintyConfig
from koz_jax.config.training import TrainConfig
from koz_jax.control import shield
from koz_jax.control.base import Controller
from koz_jax.control.registry import load_controller
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases, monte_carlo, rollout
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.export.c import SHIELD_FILES
from koz_jax.export.files import export, write_files
from koz_jax.export.golden import Golden, Situation, golden, situations
from koz_jax.export.library import CLibrary
from koz_jax.task.environment import Reorientation, model_from_config
from koz_jax.task.state import EnvState, Model, torque_limits

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")

CONFIG = ShieldConfig(margin_deg=0.2)
COUNT = 4000


@pytest.fixture(scope="module")
def agent():
    return load_agent("phase1")


@pytest.fixture(scope="module")
def library(agent, tmp_path_factory):
    folder = tmp_path_factory.mktemp("shield")
    write_files(folder, export(agent, "c", CONFIG))
    return CLibrary(folder)


@pytest.fixture(scope="module")
def vectors(agent) -> Golden:
    return golden(agent, COUNT, seed=4)


def requests(limits: tuple[float, ...] = (2.0, 2.0, 2.0)) -> np.ndarray:
    """Torques anywhere in the box."""
    return np.random.default_rng(0).uniform(np.negative(limits), limits, (COUNT, 3)).astype(np.float32)


def check_alike(agent: Agent, library: CLibrary, vectors: Golden) -> None:
    """Check that C and the core allow the same torques."""
    model = model_from_config(agent.task)
    made, boresight_B = shield.from_config(CONFIG, model), jnp.array(agent.task.spacecraft.boresight)
    limits = agent.task.spacecraft.torque_limits

    @jax.jit
    @jax.vmap
    def expect(drawn: Situation, torque_B: jax.Array) -> jax.Array:
        at = drawn.state(model, boresight_B)
        return made.filter(at.body, torque_B, at.scenario.constraints, torque_limits(at, model), model)

    requested = requests(limits)
    expected = np.asarray(expect(situations(agent, COUNT, seed=4), requested))
    found = library.shield(vectors.situation, requested)
    passed = np.all(expected == requested, axis=1)
    assert np.sum(passed) > 100 and np.sum(~passed) > 100, "some requests pass and some do not"
    # The same candidate, but for situations within rounding of a threshold.
    same = np.all(np.abs(found - expected) < 1e-3, axis=1)
    assert np.mean(same) > 0.998 and np.mean(same[~passed]) > 0.95
    assert np.array_equal(found[passed & same], requested[passed & same])
    assert np.all(np.abs(found) <= np.array(limits, np.float32))


def test_it_decides_as_the_core_does(agent, library, vectors):
    check_alike(agent, library, vectors)


@pytest.mark.slow
def test_it_decides_as_the_core_does_where_every_axis_has_its_own_limit(agent, vectors, tmp_path):
    spacecraft = agent.task.spacecraft.model_copy(update={"torque_limit": (2.0, 1.0, 0.3)})
    other = dataclasses.replace(agent, task=agent.task.model_copy(update={"spacecraft": spacecraft}))
    write_files(tmp_path, export(other, "c", CONFIG))
    check_alike(other, CLibrary(tmp_path), vectors)


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
        row = jax.numpy.concatenate([*told, state.q_e0_previous[None]])
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


def test_what_is_not_a_number_never_passes(library, vectors):
    nothing = np.full((COUNT, 3), np.nan, np.float32)
    found = library.shield(vectors.situation, nothing)
    assert np.all(np.isfinite(found)) and np.all(np.abs(found) <= 2.0)


def test_the_command_line_asks_for_it(tmp_path, capsys):
    tiny.untrained_agent().save(tmp_path / "agent")
    where = [str(tmp_path / "agent"), "--out", str(tmp_path / "c")]
    assert tiny.status("export", *where, "--to", "c", "--shield", "--shield-margin-deg", "0.5") == 0
    assert "Keeps 0.5 deg from every zone" in (tmp_path / "c" / "koz_shield.h").read_text()
    assert CLibrary(tmp_path / "c").has_shield
    capsys.readouterr()
    for flags, reason in (
        (["--to", "onnx", "--shield"], "error: shield: is exported as C only"),
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
        CLibrary(tmp_path / "c").shield(np.zeros((1, 16)), np.zeros((1, 3)))


@pytest.mark.parametrize("config", [CONFIG, ShieldConfig(error_bounds=UncertaintyConfig(inertia_error=0.05))])
def test_its_self_test_passes_and_notices_another_margin(agent, tmp_path, config):
    write_files(tmp_path, export(agent, "c", config))
    done = tiny.make_test(tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "golden vectors of the shield: 100" in done.stdout and done.stdout.count("passed") == 2
    source = (tmp_path / "koz_shield.c").read_text()
    changed = re.sub(r"(shield_margin = )[^;]*;", r"\g<1>0.2f;", source)
    assert changed != source
    (tmp_path / "koz_shield.c").write_text(changed)
    done = tiny.make_test(tmp_path)
    assert done.returncode != 0 and "FAILED" in done.stdout


def test_a_shield_of_another_controller_is_not_compiled_in(agent, tmp_path):
    shield_of_phase1 = {name: text for name, text in export(agent, "c", CONFIG).items() if name in SHIELD_FILES}
    write_files(tmp_path, export(load_agent("zones3"), "c"))
    for name, content in shield_of_phase1.items():
        (tmp_path / name).write_bytes(content)
    with pytest.raises(SettingsError, match="different exports"):
        CLibrary(tmp_path)


def test_rows_that_c_would_read_beyond_are_refused(library):
    situations, torques = np.zeros((2, 16)), np.zeros((2, 3))
    for one, other, message in (
        (np.zeros((2, 5)), torques, r"situations: must have shape \(batch, 16\), got \(2, 5\)"),
        (situations, np.zeros((2, 1)), r"torques: must have shape \(batch, 3\), got \(2, 1\)"),
        (situations, np.zeros((3, 3)), "torques: must be one for each of 2 situations, got 3"),
    ):
        with pytest.raises(SettingsError, match=message):
            library.shield(one, other)


def test_it_cannot_withstand_what_there_is_no_torque_for(agent):
    config = ShieldConfig(error_bounds=UncertaintyConfig(disturbance_torque=2.0))
    with pytest.raises(SettingsError, match=r"disturbance_torque: must be below .* of 2\.0 N m .*, got 2\.0"):
        export(agent, "c", config)
    with pytest.raises(SettingsError, match="disturbance_torque"):
        monte_carlo.monte_carlo(agent, 1, shield=config)
    shielding = {"enabled": True, "shield": config.model_dump()}
    with pytest.raises(ValidationError, match="disturbance_torque"):
        TrainConfig.model_validate(tiny.merged(tiny.CONFIG.model_dump(), {"shielding": shielding}))
