"""Build the wheel, install it where nothing else is, and use it there: ``python tools/check_wheel.py``.

The environment and the working folder are new and empty; the versions are those of ``constraints.txt``.  Prints a line
per command; exits with 1 where one fails.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

# As many cases as an evaluation of that training has: what is compiled for one serves the other.
COMMANDS = (
    "koz --help",
    "koz agents",
    "koz evaluate --cases 200",
    "koz train --preset smoke --cases 200 --run run",
    "koz fly --case 7 --out figures",
    "koz export phase2 --to c --out c",
    "koz view --out view.html",
)


def build_wheel(folder: Path) -> Path:
    """Build the wheel of the checkout into a folder, from a copy: nothing of an earlier build gets in."""
    source = folder / "source"
    shutil.copytree(ROOT / "koz_jax", source / "koz_jax", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(source)]
    subprocess.run(command, check=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def install(environment: Path, wheel: Path, extra: str = "viz") -> None:
    """Make a fresh environment with the wheel and the tested versions."""
    venv.create(environment, with_pip=True)
    requirement = f"koz_jax[{extra}] @ {wheel.as_uri()}"
    pip = [str(environment / "bin" / "python"), "-m", "pip", "install", "-qq", "--no-compile"]
    subprocess.run([*pip, "--constraint", str(ROOT / "constraints.txt"), requirement], check=True)


def try_commands(environment: Path, folder: Path) -> bool:
    """Run every command in a folder.  Returns whether all succeeded."""
    variables = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    variables["PATH"] = f"{environment / 'bin'}{os.pathsep}{variables['PATH']}"
    succeeded = True
    for command in COMMANDS:
        start = time.perf_counter()
        done = subprocess.run(command.split(), cwd=folder, env=variables, capture_output=True, text=True, check=False)
        succeeded &= done.returncode == 0
        print(
            f"{'ok' if done.returncode == 0 else 'FAILED':7}{time.perf_counter() - start:6.1f} s  {command}", flush=True
        )
        if done.returncode:
            print(done.stdout + done.stderr)
    return succeeded


def main() -> int:
    """Build, install, try.  Returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--wheel", type=Path, help="take this wheel; by default one is built")
    given = parser.parse_args().wheel
    with tempfile.TemporaryDirectory(prefix="koz_jax-wheel-") as folder:
        place = Path(folder)
        wheel = given.resolve() if given else build_wheel(place / "dist")
        start = time.perf_counter()
        install(place / "venv", wheel)
        print(f"{'ok':7}{time.perf_counter() - start:6.1f} s  pip install {wheel.name}", flush=True)
        (place / "empty").mkdir()
        return 0 if try_commands(place / "venv", place / "empty") else 1


if __name__ == "__main__":
    sys.exit(main())
