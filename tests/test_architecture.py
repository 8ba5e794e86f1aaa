"""How the package is built, read from its source: floors, one definition of everything, sizes; what importing costs."""

import ast
import importlib.util
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import koz_jax

SCRIPT = Path(__file__).resolve().parent.parent / "tools" / "structure.py"


def _structure() -> ModuleType:
    """``tools/structure.py``, which prints what is tested here."""
    spec = importlib.util.spec_from_file_location("structure", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


structure = _structure()
MODULES: dict[str, Path] = structure.modules()
TREES: dict[str, ast.Module] = {module: structure.tree_of(path) for module, path in MODULES.items()}
IMPORTS: dict[str, set[str]] = structure.imports()

# Folder (or module beside the folders) -> floor.  Imports go to the same folder, or to a lower floor.
FLOORS = {
    "errors": 0,
    "devices": 1,
    "config": 2,
    "task": 3,
    "sac": 4,
    "learners": 5,
    "storage": 6,
    "control": 7,
    "learning": 8,
    "evaluation": 9,
    "agents": 10,
    "runs": 11,
    "adapters": 12,
    "export": 13,
    "figures": 14,
    "viewer": 15,
    "cli": 16,
    "koz_jax": 17,  # the public names and ``python -m koz_jax``
}

# What others import the package for, in the order of its first lines.
PUBLIC = [
    "Reorientation",
    "TaskConfig",
    "SpacecraftConfig",
    "ScenarioConfig",
    "ShieldConfig",
    "UncertaintyConfig",
    "MonteCarloConfig",
    "TrainConfig",
    "preset",
    "train",
    "Agent",
    "load_agent",
    "load_policy",
    "shipped_agents",
    "load_controller",
    "monte_carlo",
    "MonteCarlo",
    "fly_case",
    "fly_scenario",
    "maneuver",
    "ManeuverConfig",
    "load_maneuver",
    "fly",
    "summarise",
    "table",
    "KozError",
    "SettingsError",
    "StorageError",
    "DamagedFileError",
    "MissingExtraError",
]


def of_folder(*folders: str) -> list[str]:
    return [module for module in MODULES if structure.folder_of(module) in folders]


# --- floors ---


def test_imports_are_found():
    assert {"koz_jax.learning.curriculum", "koz_jax.sac.replay_buffer"} <= IMPORTS["koz_jax.learning.train_step"]
    assert "koz_jax.config.training" in IMPORTS["koz_jax.learning.train_step"]
    assert "koz_jax.control.base" in IMPORTS["koz_jax.control.registry"]  # for type checkers only
    assert IMPORTS["koz_jax.task.rotations"] == set()
    assert len(MODULES) > 80


def test_every_module_has_a_floor():
    assert {structure.folder_of(module) for module in MODULES} == set(FLOORS)
    assert list(FLOORS) == list(structure.FLOORS)


@pytest.mark.parametrize("module", MODULES)
def test_imports_go_to_the_same_folder_or_to_a_lower_floor(module):
    here = structure.folder_of(module)
    for name in IMPORTS[module]:
        there = structure.folder_of(name)
        assert there == here or FLOORS[there] < FLOORS[here], f"{module} imports {name}"


def test_no_modules_import_each_other_in_a_circle():
    assert structure.cycle(IMPORTS) == []


def test_what_is_computed_knows_nothing_of_runs_files_and_command_lines():
    for module in of_folder("task", "sac", "learners", "control", "learning"):
        assert not {structure.folder_of(name) for name in IMPORTS[module]} & {"storage", "runs", "cli"}, module


def test_learning_knows_nothing_of_spacecraft():
    for module in of_folder("sac", "learners"):
        assert {structure.folder_of(name) for name in IMPORTS[module]} <= {"sac", "learners"}, module


@pytest.mark.slow
def test_the_script_prints_floors_and_finds_no_fault():
    done = subprocess.run([sys.executable, SCRIPT], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "arrows that run up: 0" in done.stdout and "circles: none" in done.stdout
    for folder in FLOORS:
        assert f" {folder} " in done.stdout


def test_a_fault_is_found():
    """The checks themselves: an arrow up, a folder without a floor, a circle."""
    graph = {"koz_jax.task.state": {"koz_jax.runs.trainer"}, "koz_jax.errors": {"koz_jax.new.thing"}}
    assert structure.upward(graph) == [
        "koz_jax.task.state -> koz_jax.runs.trainer",
        "koz_jax.errors -> koz_jax.new.thing",
    ]
    circle = {"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}
    assert structure.cycle(circle) == ["b", "c", "b"]


# --- one of everything ---


def calls(tree: ast.AST) -> Iterator[tuple[str, ast.Call]]:
    """Calls in a tree with what is called, as it is written."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


def test_there_is_one_autoreset():
    """A branch on whether any episode is over, and a choice between new and old environments: once in the package."""
    branches = [
        module
        for module, tree in TREES.items()
        for name, call in calls(tree)
        if name.endswith("lax.cond") and call.args and ast.unparse(call.args[0]).startswith("jnp.any(")
    ]
    assert branches == ["koz_jax.task.environment"]
    choices = [module for module, tree in TREES.items() for name, _ in calls(tree) if name.endswith("select_envs")]
    assert choices == ["koz_jax.task.environment"]
    definitions = [
        f"{module}.{node.name}"
        for module, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and "autoreset" in node.name
    ]
    assert definitions == ["koz_jax.task.environment.autoreset", "koz_jax.task.environment.step_autoreset"]


def test_scenarios_are_drawn_in_one_place():
    found = [module for module, tree in TREES.items() for name, _ in calls(tree) if name == "scenario.sample"]
    assert found == ["koz_jax.task.environment"]
    assert not any(("koz_jax.task.scenario", "sample") in imported_from(tree) for tree in TREES.values())


def test_the_environment_is_made_in_one_way():
    """Nobody but ``from_config`` puts a ``Reorientation`` together."""
    found = [module for module, tree in TREES.items() for name, _ in calls(tree) if name == "Reorientation"]
    assert found == []


def imported_from(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """What is imported from where: pairs of a module and a name of it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, alias.name) for alias in node.names)


def defined(tree: ast.Module) -> Iterator[str]:
    """Public names that a module defines."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names = [node.name]
        elif isinstance(node, ast.Assign):
            names = [target.id for target in node.targets if isinstance(target, ast.Name)]
        else:
            names = [node.target.id] if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) else []
        yield from (name for name in names if not name.startswith("_"))


def test_a_public_name_has_one_definition_in_a_folder():
    """Or all but one are only ever used with their module in front, as ``reward.from_config`` and others are."""
    homes: dict[tuple[str, str], list[str]] = defaultdict(list)
    for module, tree in TREES.items():
        for name in defined(tree):
            homes[structure.folder_of(module), name].append(module)
    bare = {pair for tree in TREES.values() for pair in imported_from(tree)}
    several = {(folder, name): [home for home in at if (home, name) in bare] for (folder, name), at in homes.items()}
    assert {name: at for name, at in several.items() if len(at) > 1} == {}


def test_a_name_that_is_imported_without_its_module_means_one_thing_in_the_whole_package():
    meanings: dict[str, set[str]] = defaultdict(set)
    for tree in TREES.values():
        for source, name in imported_from(tree):
            if source in MODULES and f"{source}.{name}" not in MODULES:
                meanings[name].add(source)
    assert {name: sources for name, sources in meanings.items() if len(sources) > 1} == {}


def test_controllers_and_shield_never_see_the_truth():
    """What really flies has a type of its own, and nothing in ``control`` takes, imports or makes one."""
    assert "Truth" in defined(TREES["koz_jax.task.state"])
    for module in of_folder("control"):
        for node in ast.walk(TREES[module]):
            words = {
                ast.Name: lambda n: n.id,
                ast.Attribute: lambda n: n.attr,
                ast.arg: lambda n: n.arg,
                ast.alias: lambda n: n.name,
            }
            said = words[type(node)](node) if type(node) in words else ""
            assert said.lower() not in ("truth", "sample_truth", "nominal", "disturbance_b"), module


# --- sizes ---


def test_the_house_has_few_rooms():
    assert len(structure.boxes()) <= structure.MAX_BOXES == 20
    sizes = structure.folder_sizes()
    assert {folder: size for folder, size in sizes.items() if size > structure.MAX_MODULES} == {}
    assert structure.MAX_MODULES == 13


def test_no_file_is_long():
    assert structure.MAX_FILE == 300
    assert [file for file in structure.files() if file.lines > structure.MAX_FILE] == []


def test_no_function_is_long():
    assert structure.MAX_FUNCTION == 50
    found = [size for module, path in MODULES.items() for size in structure.functions(module, path)]
    assert [size for size in found if size.lines > structure.MAX_FUNCTION] == []


# --- what importing costs ---

LIGHT = [
    "koz_jax",
    "koz_jax.errors",
    *of_folder("config"),
    "koz_jax.task.observation_layout",
    "koz_jax.control.encoding",
    "koz_jax.control.registry",
    "koz_jax.agents.record",
    "koz_jax.agents.numpy_policy",
    "koz_jax.cli.main",
]


def loaded_by(module: str) -> list[str]:
    heavy = ("jax", "flax", "optax", "brax", "matplotlib", "torch")
    code = f"import sys, {module}; print(*[name for name in {heavy} if name in sys.modules])"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


@pytest.mark.slow
def test_importing_what_needs_no_jax_costs_none():
    """Together, in one process: none of them loads anything heavy."""
    assert loaded_by(", ".join(LIGHT)) == []


@pytest.mark.slow
def test_the_check_of_what_is_loaded_does_look():
    assert "jax" in loaded_by("koz_jax.task.rotations")


def test_folders_hold_nothing_but_their_modules():
    """An ``__init__`` below the top is a docstring, so that no import of a module costs its neighbours."""
    for module, path in MODULES.items():
        if path.name == "__init__.py" and module != "koz_jax":
            assert len(TREES[module].body) == 1 and ast.get_docstring(TREES[module]), module


# --- public names ---


def test_the_public_names_are_these():
    assert koz_jax.__all__ == PUBLIC


def test_public_names_of_the_package_exist():
    for name in koz_jax.__all__:
        assert getattr(koz_jax, name) is not None
    assert set(PUBLIC) <= set(dir(koz_jax))
    with pytest.raises(AttributeError):
        koz_jax.no_such_name  # noqa: B018


def undocumented(node: ast.AST, prefix: str) -> Iterator[str]:
    """Public functions, classes and methods without a docstring; what is nested in functions is nobody's business."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and not child.name.startswith("_"):
            name = f"{prefix}.{child.name}"
            if not ast.get_docstring(child):
                yield name
            if isinstance(child, ast.ClassDef):
                yield from undocumented(child, name)


@pytest.mark.parametrize("module", MODULES)
def test_everything_public_has_a_docstring(module):
    assert ast.get_docstring(TREES[module]), module
    assert list(undocumented(TREES[module], module)) == []
