"""A short selection of the tests on every Python that is found: ``python tools/test_pythons.py``.

Python 3.11, 3.12 and 3.13 are looked for on the PATH and among pyenv's versions.  Each gets a fresh environment with
the wheel and the newest versions of what it needs; the lowest Python also one with the lowest versions that
``pyproject.toml`` allows.  Prints a table; exits with 1 where something fails.  Needs no package itself.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

from check_wheel import build_wheel

ROOT = Path(__file__).resolve().parent.parent
LOGS = ROOT / "build" / "pythons"
SUPPORTED = ("3.11", "3.12", "3.13")
SELECTION = ("tests/task", "tests/agents/test_numpy_policy.py", "tests/config")
SMOKE = ("koz", "evaluate", "--cases", "100")
LOWEST, NEWEST = "lowest", "newest"


def find_pythons() -> dict[str, str]:
    """Interpreters by version, such as 3.12."""
    found = {}
    for version in SUPPORTED:
        pyenv = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
        on_path = shutil.which(f"python{version}")
        for command in [*([on_path] if on_path else []), *map(str, reversed(pyenv))]:
            # A shim of pyenv may be there without its Python.
            if subprocess.run([command, "--version"], capture_output=True, check=False).returncode == 0:
                found[version] = command
                break
    return found


def lowest_versions() -> str:
    """Constraints that pin every dependency of the package to its lower bound."""
    dependencies = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    bounds = (re.fullmatch(r"([\w.-]+)>=([\w.]+)", dependency) for dependency in dependencies)
    # "flax>=0.12" allows 0.12.0, and nothing below it.
    return "".join(f"{bound[1]}=={bound[2]}\n" for bound in bounds if bound)


def run(command: list[str], log: Path, cwd: Path = ROOT) -> bool:
    """Run a command into a log.  Returns whether it succeeded."""
    with open(log, "a") as file:
        file.write(f"$ {' '.join(command)}\n")
        file.flush()
        return subprocess.run(command, stdout=file, stderr=subprocess.STDOUT, check=False, cwd=cwd).returncode == 0


def try_python(python: str, versions: str, folder: Path, wheel: Path, log: Path) -> str:
    """Install and test in a fresh environment, into a log.  Returns what came of it."""
    folder.mkdir(parents=True)
    # The tests of the checkout and their maneuver files, the package of the wheel: it is not on the path of a copy.
    for name in ("tests", "examples"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "pytest.ini").write_text("[pytest]\npythonpath = tests\nmarkers =\n    slow\n    gpu\n")
    environment = folder / "venv"
    pip = [str(environment / "bin" / "python"), "-m", "pip", "install", "-qq"]
    if versions == LOWEST:
        (folder / "lowest.txt").write_text(lowest_versions())
        pip += ["--constraint", str(folder / "lowest.txt")]
    if not run([python, "-m", "venv", str(environment)], log):
        return "no environment"
    if not run([*pip, str(wheel), "pytest", "hypothesis", "scipy"], log):
        return "not installed"
    tests = [str(environment / "bin" / "python"), "-m", "pytest", "-q", "-m", "not slow and not gpu", *SELECTION]
    passed = run(tests, log, folder)
    flown = run([str(environment / "bin" / SMOKE[0]), *SMOKE[1:]], log, folder)
    return "ok" if passed and flown else "tests failed" if not passed else "koz evaluate failed"


def installed(folder: Path) -> str:
    """Versions that were tried."""
    code = "from importlib.metadata import version as v; print(*(f'{n} {v(n)}' for n in ('jax', 'numpy', 'pydantic')))"
    command = [str(folder / "venv" / "bin" / "python"), "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def main() -> int:
    """Try all, print the table.  Returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="*", metavar="VERSION", help="such as 3.12; by default all that are found")
    parser.add_argument("--versions", choices=(NEWEST, LOWEST), help="by default both, the lowest on one Python")
    args = parser.parse_args()
    pythons = {version: path for version, path in find_pythons().items() if not args.only or version in args.only}
    if not pythons:
        print(f"none of Python {', '.join(args.only or SUPPORTED)} is found", file=sys.stderr)
        return 1
    LOGS.mkdir(parents=True, exist_ok=True)
    trials = [(version, NEWEST) for version in pythons] + [(min(pythons), LOWEST)]
    with tempfile.TemporaryDirectory(prefix="koz_jax-pythons-") as temporary:
        place = Path(temporary)
        wheel = build_wheel(place / "dist")
        failed = False
        print(f"{'python':8}{'versions':10}{'seconds':>8}  outcome")
        for version, versions in trials:
            if args.versions and versions != args.versions:
                continue
            start, folder = time.perf_counter(), place / f"{version}-{versions}"
            log = LOGS / f"{version}-{versions}.txt"
            log.unlink(missing_ok=True)
            outcome = try_python(pythons[version], versions, folder, wheel, log)
            seconds = time.perf_counter() - start
            print(f"{version:8}{versions:10}{seconds:8.0f}  {outcome} ({installed(folder)})", flush=True)
            if outcome != "ok":
                failed = True
                print(f"        see {log}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    os.environ.pop("PYTHONPATH", None)
    sys.exit(main())
