"""A controller of one's own in a file: flown with and without the shield, and refused in a line where it cannot fly."""

import contextlib
import csv
import dataclasses
import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from support import tiny

from koz_jax.config.task import TaskConfig
from koz_jax.control import from_file
from koz_jax.control.registry import NamedController, as_task_controller, load_controller
from koz_jax.errors import SettingsError
from koz_jax.evaluation.cases import fly_scenario
from koz_jax.evaluation.monte_carlo import monte_carlo
from koz_jax.task.scenario import paper_test

MINE = '''
import jax.numpy as jnp
import numpy as np
from flax import struct
from koz_jax.control.base import Memoryless
from koz_jax.task.state import attitude_error, torque_limits


class Mine(Memoryless):
    """A spring and a damper."""

    spring: float = 60.0
    damper: float = 120.0

    def decide(self, state, model, memory):
        torque_B = -self.spring * attitude_error(state)[1:] - self.damper * state.body.omega_BN_B
        return jnp.clip(torque_B / torque_limits(state, model).box_B, -1.0, 1.0), memory


class Numpy(Memoryless):
    def decide(self, state, model, memory):
        return np.clip(-np.asarray(state.body.omega_BN_B), -1.0, 1.0), memory


class Branching(Memoryless):
    def decide(self, state, model, memory):
        return (jnp.ones(3) if state.angle > 1.0 else jnp.zeros(3)), memory


class NoTree:
    def begin(self, state, model, key): ...

    def decide(self, state, model, memory):
        return jnp.zeros(3), memory


class TooMany(Memoryless):
    def decide(self, state, model, memory):
        return jnp.zeros(4), memory


class Growing(struct.PyTreeNode):
    def begin(self, state, model, key):
        return jnp.zeros(1)

    def decide(self, state, model, memory):
        return jnp.zeros(3), jnp.zeros(2)


class Undecided(Memoryless):
    pass


class Needy(Memoryless):
    gain: float

    def decide(self, state, model, memory):
        return jnp.zeros(3), memory


class Wrong(Memoryless):
    def decide(self, state, model, memory):
        return state.nothing, memory
'''


@pytest.fixture
def file(tmp_path) -> Path:
    path = tmp_path / "own.py"
    path.write_text(MINE)
    return path


class Rows(NamedTuple):
    """What ``koz evaluate`` printed, and the rows of its file, of the same cases."""

    printed: str
    cases: list[dict[str, str]]


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> dict[str, Rows]:
    """Whole maneuvers by the file's first class, bare and shielded."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "own.py").write_text(MINE)
    dataclasses.replace(tiny.untrained_agent(), task=TaskConfig()).save(folder / "agent")
    argv = ["--agent", folder / "agent", "--controller", f"{folder / 'own.py'}:Mine", "--cases", tiny.CASES]
    found = {}
    for name, flags in (("bare", []), ("shielded", ["--shield"])):
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            assert tiny.status("evaluate", *argv, *flags, "--csv", folder / f"{name}.csv") == 0
        rows = csv.DictReader((folder / f"{name}.csv").read_text().splitlines())
        found[name] = Rows(printed.getvalue(), list(rows))
    return found


@pytest.mark.slow
def test_it_is_flown_with_and_without_the_shield(flown):
    bare, shielded = flown["bare"], flown["shielded"]
    assert "  Mine\n" in bare.printed and "  Mine + shield\n" in shielded.printed
    assert {row["intervention_rate"] for row in bare.cases} == {"0"}
    assert len(shielded.cases) == tiny.CASES and all(float(row["min_margin_deg"]) > 0 for row in shielded.cases)


@pytest.mark.slow
def test_the_shield_keeps_it_out_of_every_zone(flown):
    violated = [sum(row["violated"] == "1" for row in flown[name].cases) for name in ("bare", "shielded")]
    assert violated[0] > 0 == violated[1]


@pytest.mark.slow
def test_it_can_be_looked_at(file, agent, tmp_path, capsys):
    argv = ["--agent", agent, "--controller", f"{file}:Mine", "--shield", "--out"]
    assert tiny.status("fly", *argv, tmp_path / "figures") == 0
    assert tiny.status("view", *argv, tmp_path / "page.html") == 0
    assert "Mine + shield: 100.0 deg" in capsys.readouterr().out
    assert "Mine + shield" in (tmp_path / "page.html").read_text()


def test_it_decides_as_it_is_written(file):
    named = load_controller(f"{file}:Mine")
    assert named.name == "Mine"
    assert float(named.controller.spring) == 60.0  # pyright: ignore[reportAttributeAccessIssue]
    assert named.task == load_controller("pd").task


BAD = {
    "own.py:Numpy": ["cannot be traced", "use jax.numpy in place of numpy", "own.py, line"],
    "own.py:Branching": ["cannot be traced", "jax.numpy.where", "own.py, line"],
    "own.py:NoTree": ["must be a pytree", "koz_jax.control.base.Memoryless or flax.struct.PyTreeNode"],
    "own.py:TooMany": ["the action of own.py:TooMany must be 3 real numbers", "(4,)"],
    "own.py:Growing": ["the memory of own.py:Growing must keep its shapes", "float32[1]", "float32[2]"],
    "own.py:Undecided": ["has no method decide"],
    "own.py:Needy": ["cannot be made without arguments", "'gain'"],
    "own.py:Wrong": ["cannot decide: AttributeError", "nothing", "own.py, line"],
    "own.py:Nobody": ["own.py has no class 'Nobody'; it has Mine, Numpy"],
    "own.py:jnp": ["own.py has no class 'jnp'"],
    "own.py": ["must be FILE.py:CLASS, got own.py"],
    "other.py:Mine": ["other.py: no such file"],
    "broken.py:Mine": ["broken.py: cannot be imported: SyntaxError", "broken.py, line 1"],
    "alone.py:Mine": ["alone.py: cannot be imported: ModuleNotFoundError", "no_such_module", "alone.py, line 1"],
    "text.txt:Mine": ["must be a Python file"],
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_fly_is_refused_in_a_line(name, file, monkeypatch):
    monkeypatch.chdir(file.parent)
    (file.parent / "broken.py").write_text("x = (\n")
    (file.parent / "alone.py").write_text("import no_such_module\n")
    (file.parent / "text.txt").touch()
    with pytest.raises(SettingsError) as refused:
        load_controller(name)
    message = str(refused.value)
    assert message.startswith("controller: ") and len(message.splitlines()) == 1
    for words in BAD[name]:
        assert words in message


def python(file: Path, name: str) -> Any:
    """A class of the file, as a program that imports it has it."""
    return from_file._class(file, name)


@pytest.mark.slow
def test_in_python_a_controller_flies_as_it_is(file):
    """Without a name or a task it is called by its class, and flies the paper's task."""
    mine = python(file, "Mine")()
    task = TaskConfig(episode_seconds=2.0)
    bare = monte_carlo(mine, tiny.CASES, task=task)
    named = monte_carlo(NamedController("other", mine, task), tiny.CASES)
    assert (bare.agent, named.agent) == ("Mine", "other")
    np.testing.assert_array_equal(bare.results.control_effort, named.results.control_effort)
    assert as_task_controller(mine).task == TaskConfig()
    history, _ = fly_scenario(mine, paper_test(), task)
    assert len(history.zone_margin) == 21


PYTHON_BAD = {
    "Numpy": ["Numpy cannot be traced", "use jax.numpy in place of numpy", "own.py, line"],
    "Branching": ["cannot be traced", "jax.numpy.where"],
    "NoTree": ["must be a pytree", "koz_jax.control.base.Memoryless or flax.struct.PyTreeNode"],
    "TooMany": ["must be 3 real numbers", "(4,)"],
    "Undecided": ["begin and decide"],
}


@pytest.mark.parametrize("name", PYTHON_BAD)
def test_in_python_what_cannot_fly_is_refused_in_a_line(name, file):
    made = python(file, name)()
    task = TaskConfig(episode_seconds=2.0)
    for flown in (made, NamedController("mine", made, task)):
        if name == "Undecided" and flown is not made:
            continue
        for fly in (lambda flown=flown: monte_carlo(flown, 2), lambda flown=flown: fly_scenario(flown, paper_test())):
            with pytest.raises(SettingsError) as refused:
                fly()
            message = str(refused.value)
            assert len(message.splitlines()) == 1
            for words in PYTHON_BAD[name]:
                assert words in message


def test_what_is_no_controller_at_all_is_refused_by_name(file):
    with pytest.raises(SettingsError, match=r"must be an object, got the class Mine; give Mine\(\)"):
        monte_carlo(python(file, "Mine"), 2)
    for nothing in ("phase2", None, 3):
        with pytest.raises(SettingsError, match=rf"got {type(nothing).__name__}$"):
            monte_carlo(nothing, 2)  # pyright: ignore[reportArgumentType]
