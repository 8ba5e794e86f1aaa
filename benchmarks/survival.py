"""What a run survives, and what it refuses: kills, damaged files, full disks, numbers that are none, bad settings.

    python benchmarks/survival.py

Trains a run of seconds undisturbed, then many more of the same that are not left alone.  Prints a table, and exits
with 1 if anything came out otherwise than it should.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import numpy as np  # noqa: E402
from support import bad_settings, corruption, faults  # noqa: E402
from support.tiny import CONFIG, FLAGS  # noqa: E402

from koz_jax.runs.folder import RunFolder  # noqa: E402

# An accepted command line may ask for more work than anybody waits for; it is then asked to stop.
_RUN_S = 90.0


def train_command(*argv: object) -> list[str]:
    return [sys.executable, str(ROOT / "train.py"), *map(str, argv), "--cases", "12"]


def environment(cache: Path) -> dict[str, str]:
    """Programs compiled once serve all runs; one device, so that all have the same."""
    return {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PLATFORMS": "cpu",
    }


def run(command: list[str], cache: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, env=environment(cache), capture_output=True, text=True, check=False)


def differences(found: RunFolder, expected: RunFolder) -> list[str]:
    """Files of a run that are not the same to the last bit as those of another."""
    saved = [path.relative_to(expected.path) for path in expected.path.rglob("arrays.npz")]
    different = []
    for path in sorted(saved):
        if not (found.path / path).is_file():
            different.append(f"{path} (missing)")
            continue
        with np.load(found.path / path) as one, np.load(expected.path / path) as other:
            if one.files != other.files or any(one[name].tobytes() != other[name].tobytes() for name in one.files):
                different.append(str(path))
    log = Path("metrics.csv")
    if (found.path / log).read_bytes() != (expected.path / log).read_bytes():
        different.append(str(log))
    return different


def killed(folder: Path, cache: Path, draw: random.Random, longest_s: float) -> bool:
    """Begin or go on with a run, and kill it at a random moment of its training.  Returns whether it was killed."""
    begun = (folder / "config.json").exists()
    command = train_command("--resume", folder) if begun else train_command("--run", folder, *FLAGS)
    log = folder / "metrics.csv"
    before = log.stat().st_mtime_ns if log.exists() else 0
    with subprocess.Popen(
        command, env=environment(cache), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as process:
        # Most of such a short run is its start; kills are to hit the training.
        while process.poll() is None and (not log.exists() or log.stat().st_mtime_ns == before):
            time.sleep(0.002)
        try:
            process.wait(draw.uniform(0.0, longest_s))
            assert process.returncode == 0, command
            return False
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            return True


def kills(count: int, reference: RunFolder, cache: Path, work: Path) -> tuple[str, bool]:
    """Kill runs ``count`` times, going on after each; every finished run must equal the undisturbed one."""
    draw = random.Random(1)
    done = finished = 0
    different: list[str] = []
    folder = RunFolder(work / "killed0")
    while done < count:
        if killed(folder.path, cache, draw, 1.0):
            done += 1
        else:
            different += differences(folder, reference)
            finished += 1
            folder = RunFolder(work / f"killed{finished}")
    if folder.config.exists():
        completed = run(train_command("--resume", folder.path), cache)
        assert completed.returncode == 0, completed.stderr
        different += differences(folder, reference)
        finished += 1
    text = f"{done} SIGKILLs in {finished} runs, each run finished: {len(different)} files differ {different[:3] or ''}"
    return text, not different


def full_disk(reference: RunFolder, cache: Path, work: Path) -> tuple[str, bool]:
    """Train on a small disk until it is full, make it larger and go on; then resume on a read-only one."""
    disk = work / "disk"
    disk.mkdir()
    size = sum(path.stat().st_size for path in (reference.path / "checkpoints").rglob("*.npz"))  # two checkpoints
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={int(1.7 * size)}", "tmpfs", disk], capture_output=True, check=False
    )
    if mounted.returncode:
        return "not measured: no disk can be mounted here", True
    try:
        folder = RunFolder(disk / "run")
        stopped = run(train_command("--run", folder.path, *FLAGS), cache)
        lines = [line for line in stopped.stderr.splitlines() if line.startswith("error: ")]
        clear = stopped.returncode == 2 and "Traceback" not in stopped.stderr and len(lines) == 1
        kept = [path.name for path in folder.checkpoints()]
        remount(disk, "rw,size=1g")
        remount(disk, "ro")
        refused = run(train_command("--resume", folder.path), cache)
        clear &= refused.returncode == 2 and "Traceback" not in refused.stderr and "Read-only" in refused.stderr
        remount(disk, "rw")
        resumed = run(train_command("--resume", folder.path), cache)
        different = differences(folder, reference) if resumed.returncode == 0 else [resumed.stderr[-300:]]
        text = (
            f"full: {lines[0] if lines else stopped.stderr[-400:]!r}, checkpoints kept {kept};"
            f" read-only: {refused.stderr.strip().splitlines()[-1]!r}; with more room resumed, {len(different)} files"
            " differ"
        )
        return text, clear and not different and bool(kept)
    finally:
        subprocess.run(["umount", disk], check=False)


def filled_disk(reference: RunFolder, cache: Path, work: Path) -> tuple[str, bool]:
    """Fill the disk with another file while a run trains on it; then make room and go on."""
    disk = work / "filled"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", disk], check=False).returncode:
        return "not measured: no disk can be mounted here", True
    try:
        folder = RunFolder(disk / "run")
        log = folder.path / "metrics.csv"
        with subprocess.Popen(
            train_command("--run", folder.path, *FLAGS), env=environment(cache), stderr=subprocess.PIPE, text=True
        ) as process:
            while process.poll() is None and not log.exists():
                time.sleep(0.002)
            fill(disk / "other")
            try:
                errors = process.communicate(timeout=_RUN_S)[1]
            except subprocess.TimeoutExpired:
                process.kill()
                return f"hangs: {process.communicate()[1][-400:]}", False
        lines = [line for line in errors.splitlines() if line.startswith("error: ")]
        clear = process.returncode == 2 and "Traceback" not in errors and len(lines) == 1
        (disk / "other").unlink()
        resumed = run(train_command("--resume", folder.path), cache)
        different = differences(folder, reference) if resumed.returncode == 0 else [resumed.stderr[-300:]]
        text = f"filled by another: {lines or errors[-400:]}; with room again resumed, {len(different)} files differ"
        return text, clear and not different
    finally:
        subprocess.run(["umount", disk], check=False)


def fill(path: Path) -> None:
    """Write a file until the disk is full."""
    with open(path, "wb", buffering=0) as file:
        for size in (2**20, 2**12, 1):
            try:
                while True:
                    file.write(bytes(size))
            except OSError:
                continue


def remount(disk: Path, options: str) -> None:
    subprocess.run(["mount", "-o", f"remount,{options}", disk], check=True)


def bad_lines(count: int, cache: Path, work: Path) -> tuple[str, bool]:
    """Refuse or accept generated command lines, then run those that were accepted, at most ``_RUN_S`` each."""
    tried = bad_settings.refusals(count, work)
    ends: list[str] = []
    wrong: list[str] = []
    for number, line in enumerate(tried.accepted):
        folder = work / f"accepted-{number}"
        folder.mkdir()
        command = [sys.executable, str(ROOT / f"{line.command}.py"), *line.argv]
        with subprocess.Popen(
            command, cwd=folder, env=environment(cache), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        ) as process:
            try:
                errors = process.communicate(timeout=_RUN_S)[1]
                ends.append("refused by name after all" if process.returncode == 2 else "finished")
            except subprocess.TimeoutExpired:
                process.terminate()
                errors = process.communicate()[1]
                ends.append("stopped")
        # Training stops with 0; a flight, also that at the end of a training, ends by the signal.
        if process.returncode not in (0, 2, -signal.SIGTERM) or "Traceback" in errors:
            wrong.append(f"{process.returncode} from {command[1:]}: {errors[-300:]}")
    counts = ", ".join(f"{ends.count(end)} {end}" for end in sorted(set(ends)))
    text = f"{tried.text}; of the accepted {counts}, {len(wrong)} wrong"
    return "\n  ".join([text, *wrong]), tried.sound and not wrong


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--corruptions", type=int, default=200)
    parser.add_argument("--bad", type=int, default=500, help="bad configurations and command lines")
    args = parser.parse_args(argv)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    sound = True
    with tempfile.TemporaryDirectory() as folder:
        work, cache = Path(folder), Path(folder) / "compiled"
        reference = RunFolder(work / "undisturbed")
        done = run(train_command("--run", reference.path, *FLAGS), cache)
        assert done.returncode == 0, done.stderr
        jobs: dict[str, Callable[[], tuple[str, bool]]] = {
            "kills": lambda: kills(args.kills, reference, cache, work),
            "full and read-only disk": lambda: full_disk(reference, cache, work),
            "disk filled by another": lambda: filled_disk(reference, cache, work),
            "corruptions": lambda: corruption.corruptions(args.corruptions, reference, CONFIG, work),
            "no numbers": lambda: faults.faults(CONFIG, work),
            "bad settings": lambda: bad_lines(args.bad, cache, work),
        }
        for name, job in jobs.items():
            start = time.perf_counter()
            text, passed = job()
            sound &= passed
            print(f"{name}: {'ok' if passed else 'FAILED'}, {time.perf_counter() - start:.0f} s: {text}", flush=True)
    return 0 if sound else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
