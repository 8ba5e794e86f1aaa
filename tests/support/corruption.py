"""Damage to the files of a run: each must be named, or the good checkpoint before it used, and said so."""

import contextlib
import io
import logging
import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np

from koz_jax.agents.agent import load_agent
from koz_jax.config.training import TrainConfig
from koz_jax.errors import KozError
from koz_jax.runs import checkpoint
from koz_jax.runs.folder import RunFolder
from koz_jax.storage import archive, pytrees

Damage = Callable[[Path, random.Random], None]


def flip(path: Path, draw: random.Random) -> None:
    content = bytearray(path.read_bytes())
    content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
    path.write_bytes(content)


def truncate(path: Path, draw: random.Random) -> None:
    os.truncate(path, draw.randrange(1, path.stat().st_size))


def empty(path: Path, _: random.Random) -> None:
    os.truncate(path, 0)


def remove(path: Path, _: random.Random) -> None:
    path.unlink()


def foreign(path: Path, draw: random.Random) -> None:
    """Another file in its place: random bytes, a text, a picture's beginning, an array, an archive."""
    contents = [draw.randbytes(1000), b"not what you think", b"\x89PNG\r\n\x1a\n" + bytes(50), b"[1, 2]", b'{"a": 1}']
    file = io.BytesIO()
    np.savez(file, a=np.zeros(3))
    path.write_bytes(draw.choice([*contents, file.getvalue()]))


def _resave(path: Path, change: Callable[[dict[str, np.ndarray]], None], **record: object) -> None:
    """Save a folder anew, checksums and all, with other arrays or another record."""
    with np.load(path.parent / "arrays.npz") as file:
        arrays = {name: file[name] for name in file.files}
    change(arrays)
    content = archive.read_record(path.parent)
    archive.save_arrays(path.parent, arrays, {**content, **record})


def wrong_version(path: Path, draw: random.Random) -> None:
    _resave(path, lambda _: None, format=draw.choice([0, 3, 99, "2", None]))


def wrong_shape(path: Path, draw: random.Random) -> None:
    def change(arrays: dict[str, np.ndarray]) -> None:
        name = draw.choice(sorted(arrays))
        arrays[name] = draw.choice([arrays[name][None], arrays[name].astype(np.float16), np.zeros((7, 7), np.float32)])

    _resave(path, change)


def other_arrays(path: Path, draw: random.Random) -> None:
    def change(arrays: dict[str, np.ndarray]) -> None:
        name = draw.choice(sorted(arrays))
        arrays[f"{name}x"] = arrays.pop(name)

    _resave(path, change)


DAMAGES: tuple[Damage, ...] = (
    flip,
    flip,
    flip,
    truncate,
    empty,
    remove,
    foreign,
    wrong_version,
    wrong_shape,
    other_arrays,
)


def same(one: object, other: object) -> bool:
    leaves, others = (jax.tree.leaves(pytrees.key_data(tree)) for tree in (one, other))
    return all(np.array_equal(x, y, equal_nan=True) for x, y in zip(leaves, others, strict=True))


@contextlib.contextmanager
def warnings_of(logger: logging.Logger) -> Iterator[list[str]]:
    """Collect what is warned of."""
    said: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: said.append(record.getMessage())
    logger.addHandler(handler)
    try:
        yield said
    finally:
        logger.removeHandler(handler)


def corruptions(count: int, reference: RunFolder, config: TrainConfig, work: Path) -> tuple[str, bool]:
    """Damage a copy of a run ``count`` times.  Returns a line of text, and whether all went as it should."""
    draw = random.Random(2)
    whole = [checkpoint.load(reference, config).state]
    whole.append(archive.load_tree(reference.checkpoints()[1], checkpoint.template(config)))
    agent = load_agent(reference.agent("phase2"))
    counts = dict.fromkeys(("named", "named and the one before used", "without effect"), 0)
    wrong: list[str] = []
    for number in range(count):
        folder = RunFolder(work / "damaged")
        shutil.rmtree(folder.path, ignore_errors=True)
        shutil.copytree(reference.path, folder.path)
        of_agent = draw.random() < 0.5
        saved = folder.agent("phase2") if of_agent else folder.checkpoints()[0]
        path, damage = saved / draw.choice(["arrays.npz", "record.json"]), DAMAGES[number % len(DAMAGES)]
        damage(path, draw)
        try:
            with warnings_of(logging.getLogger("koz_jax")) as said:
                if of_agent:
                    found = load_agent(saved)
                    outcome = "without effect" if same(found.controller, agent.controller) else "WRONG"
                    outcome = outcome if found.task == agent.task else "WRONG"
                else:
                    state = checkpoint.load(folder, config).state
                    before = same(state, whole[1]) and str(saved) in "".join(said)
                    outcome = "named and the one before used" if before else "WRONG"
                    if same(state, whole[0]) and not said:
                        outcome = "without effect"
        except KozError as error:
            outcome = "named" if str(saved) in str(error) else "WRONG"
        except Exception as error:
            outcome = f"WRONG {error!r}"
        if outcome in counts and not (outcome == "without effect" and damage is not flip):
            counts[outcome] += 1
        else:
            wrong.append(f"{damage.__name__} of {path.relative_to(folder.path)}: {outcome}")
    text = ", ".join(f"{number} {name}" for name, number in counts.items())
    return f"{count}: {text}; {len(wrong)} wrong {wrong[:3] or ''}", not wrong
