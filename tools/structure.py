"""Print how the package is built: folders from the ground up, the imports between them, and what is longest.

    python tools/structure.py

Everything is read from the source, nothing is imported; the test of the architecture asks the same functions.
"""

import ast
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PACKAGE = "koz_jax"
ROOT = Path(__file__).resolve().parent.parent / PACKAGE

# A folder (or a module beside them) imports from itself and from what stands before it.  The last is the package's own
# face: its ``__init__`` and ``__main__``, which nothing may import.
FLOORS = (
    *(
        "errors",
        "devices",
        "config",
        "task",
        "sac",
        "learners",
        "storage",
        "control",
        "learning",
        "evaluation",
        "agents",
    ),
    *("runs", "adapters", "export", "figures", "viewer", "cli", PACKAGE),
)

MAX_BOXES, MAX_MODULES, MAX_FILE, MAX_FUNCTION = 20, 13, 300, 50


class Sized(NamedTuple):
    """Something with a length."""

    lines: int
    name: str


def modules() -> dict[str, Path]:
    """Every module of the package by its dotted name; that of a folder is its ``__init__``."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def tree_of(path: Path) -> ast.Module:
    """Syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def folder_of(module: str) -> str:
    """Box at the top level that a module is in."""
    parts = module.split(".")
    return PACKAGE if len(parts) == 1 or parts[1].startswith("__") else parts[1]


def imports_of(module: str, path: Path, known: dict[str, Path]) -> set[str]:
    """Modules of the package that a file imports, also in functions and for type checkers."""
    found: set[str] = set()
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            source = ".".join([*above, *([node.module] if node.module else [])])
            # "from koz_jax.task import reward" imports a module, "from koz_jax.task.reward import terms" a name of one.
            found |= {name if (name := f"{source}.{alias.name}") in known else source for alias in node.names}
    return {name for name in found if name.split(".")[0] == PACKAGE}


def imports() -> dict[str, set[str]]:
    """What each module imports of the package."""
    known = modules()
    return {module: imports_of(module, path, known) for module, path in known.items()}


def arrows(graph: dict[str, set[str]]) -> Counter[tuple[str, str]]:
    """How many imports go from one folder to another."""
    pairs = ((folder_of(module), folder_of(name)) for module, names in graph.items() for name in names)
    return Counter(pair for pair in pairs if pair[0] != pair[1])


def upward(graph: dict[str, set[str]]) -> list[str]:
    """Imports that go up, or to or from a folder without a floor."""

    def floor(module: str) -> int:
        folder = folder_of(module)
        return FLOORS.index(folder) if folder in FLOORS else -1

    return [
        f"{module} -> {name}"
        for module, names in graph.items()
        for name in sorted(names)
        if min(floor(module), floor(name)) < 0 or floor(name) > floor(module)
    ]


def cycle(graph: dict[str, set[str]]) -> list[str]:
    """Modules that import each other in a circle; empty if none do."""
    done: set[str] = set()

    def visit(module: str, way: list[str]) -> list[str]:
        if module in way:
            return [*way[way.index(module) :], module]
        if module in done:
            return []
        found = next(filter(None, (visit(name, [*way, module]) for name in sorted(graph.get(module, ())))), [])
        done.add(module)
        return found

    return next(filter(None, (visit(module, []) for module in graph)), [])


def functions(module: str, path: Path) -> Iterator[Sized]:
    """Functions and methods of a file, with their lengths from ``def`` to the last line."""
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield Sized((node.end_lineno or node.lineno) - node.lineno + 1, f"{module}.{node.name}")


def files() -> list[Sized]:
    """Files of the package with their lengths, the longest first."""
    found = (Sized(len(path.read_text(encoding="utf-8").splitlines()), name) for name, path in modules().items())
    return sorted(found, reverse=True)


def folder_sizes() -> Counter[str]:
    """Number of modules of each folder, its ``__init__`` not counted; a folder inside another counts for itself."""
    found = ((folder_of(name), path) for name, path in modules().items() if path.name != "__init__.py")
    return Counter(box if path.parent in (ROOT, ROOT / box) else f"{box}/{path.parent.name}" for box, path in found)


def box_sizes() -> Counter[str]:
    """Number of modules of each box at the top level, with those of folders inside it; ``__init__`` is not counted."""
    return Counter(folder_of(name) for name, path in modules().items() if path.name != "__init__.py")


def boxes() -> list[str]:
    """What a visitor sees in the package: folders, and modules beside them."""
    return sorted({folder_of(name) for name in modules()})


def main() -> int:
    """Print; the exit status is 1 where an arrow runs up or modules import each other in a circle."""
    graph, sizes = imports(), box_sizes()
    between, lengths = arrows(graph), Counter[str]()
    for size in files():
        lengths[folder_of(size.name)] += size.lines
    print(f"{'floor':>5}  {'folder':<11}{'modules':>8}{'lines':>7}  imports from")
    for floor, folder in enumerate(FLOORS):
        below = ", ".join(f"{name} {between[folder, name]}" for name in FLOORS if between[folder, name]) or "-"
        print(f"{floor:>5}  {folder:<11}{sizes[folder]:>8}{lengths[folder]:>7}  {below}")
    up, circle = upward(graph), cycle(graph)
    longest = max(size for name, path in modules().items() for size in functions(name, path))
    largest, most = files()[0], folder_sizes().most_common(1)[0]
    print(f"arrows that run up: {len(up)}", *up, sep="\n  ")
    print(f"circles: {' -> '.join(circle) or 'none'}")
    print(f"boxes at the top: {len(boxes())} (at most {MAX_BOXES})")
    print(f"most modules in a folder: {most[1]} in {most[0]} (at most {MAX_MODULES})")
    print(f"longest file: {largest.lines} lines, {largest.name} (at most {MAX_FILE})")
    print(f"longest function: {longest.lines} lines, {longest.name} (at most {MAX_FUNCTION})")
    return 1 if up or circle else 0


if __name__ == "__main__":
    sys.exit(main())
