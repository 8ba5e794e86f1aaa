"""Which module may know which, read from the imports; and what importing costs."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import koz_jax

PACKAGE = Path(koz_jax.__file__).parent
MODULES = {
    ".".join(("koz_jax", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
LEARNING = {f"koz_jax.{name}" for name in ("training", "trainer", "refine", "agent", "evaluation", "curriculum")}
PHYSICS = ("rotations", "dynamics", "keep_out", "scenario", "env", "reward", "observation")


def imported_at(path, module):
    """Modules of the project that a file imports anywhere in it, relative imports and those of functions too."""
    found = set()
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            source = ".".join([*above, *([node.module] if node.module else [])])
            # "from koz_jax import env" imports a module, "from koz_jax.env import step" a name of one.
            found |= {name if (name := f"{source}.{alias.name}") in MODULES else source for alias in node.names}
    return {name for name in found if name.split(".")[0] == "koz_jax"}


IMPORTS = {module: imported_at(path, module) for module, path in MODULES.items()}


def reachable(module):
    """Everything of the project that a module needs, directly or not."""
    seen, waiting = set(), {module}
    while waiting:
        name = waiting.pop()
        seen.add(name)
        waiting |= IMPORTS.get(name, set()) - seen
    return seen - {module}


def test_imports_are_found():
    assert {"koz_jax.curriculum", "koz_jax.sac.replay", "koz_jax.config"} <= IMPORTS["koz_jax.training"]
    assert IMPORTS["koz_jax.rotations"] == set()


def test_sac_knows_nothing_outside_itself():
    sac = [module for module in MODULES if module.startswith("koz_jax.sac")]
    assert len(sac) >= 5
    for module in sac:
        assert all(name == "koz_jax.sac" or name.startswith("koz_jax.sac.") for name in IMPORTS[module]), module


@pytest.mark.parametrize("name", PHYSICS)
def test_physics_knows_nothing_of_learning(name):
    found = reachable(f"koz_jax.{name}")
    assert not found & LEARNING
    assert not any(module.startswith("koz_jax.sac") for module in found)


def test_settings_and_errors_are_at_the_bottom():
    assert IMPORTS["koz_jax.errors"] == set()
    assert reachable("koz_jax.config") <= {
        *("koz_jax.errors", "koz_jax.settings", "koz_jax.shield_config", "koz_jax.task_config")
    }


def test_no_module_needs_itself():
    for module in MODULES:
        if module != "koz_jax":  # its imports are for type checkers only, and lazy
            assert all(module not in reachable(name) for name in IMPORTS[module] - {"koz_jax"}), module


def test_only_the_training_modules_see_both_learning_and_physics():
    both = {
        module
        for module, names in IMPORTS.items()
        if "koz_jax.env" in names and any(name.startswith("koz_jax.sac") for name in names)
    }
    assert both <= {"koz_jax.training", "koz_jax.task", "koz_jax.refine", "koz_jax.agent"}


@pytest.mark.parametrize(
    "module", ["koz_jax", "koz_jax.config", "koz_jax.presets", "koz_jax.errors", "koz_jax.numpy_policy"]
)
def test_importing_settings_costs_no_jax(module):
    heavy = ("jax", "flax", "optax", "brax", "matplotlib")
    code = f"import sys, {module}; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_public_names_of_the_package_exist():
    for name in koz_jax.__all__:
        assert getattr(koz_jax, name) is not None
    with pytest.raises(AttributeError):
        koz_jax.no_such_name  # noqa: B018


def undocumented(node, prefix):
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
    tree = ast.parse(MODULES[module].read_text())
    assert ast.get_docstring(tree), module
    assert list(undocumented(tree, module)) == []
