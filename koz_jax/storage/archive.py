"""Folders of checked arrays with a JSON record: written whole or not at all, read without executing code."""

import contextlib
import hashlib
import json
import os
import shutil
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from koz_jax.errors import DamagedFileError, StorageError
from koz_jax.storage.files import read_json, write_json
from koz_jax.storage.pytrees import from_arrays, to_arrays

FORMAT = 2

_OLD_FORMAT = 1  # its records have no checksum

_FILES = {"arrays.npz", "record.json"}


def save_tree(folder: Path, tree: Any, record: Mapping[str, Any]) -> None:
    """Write a pytree and a JSON record as a folder, replacing an older one only when the new one is whole.

    The folder holds ``arrays.npz`` and ``record.json``; the record gains the format number, the arrays' checksum and
    its own.

    Raises:
        StorageError: the folder cannot be written, or holds something else that would be lost.

    """
    save_arrays(folder, to_arrays(tree), record)


def save_arrays(folder: Path, arrays: Mapping[str, np.ndarray], record: Mapping[str, Any]) -> None:
    """``save_tree`` for a tree that is on the host already (see ``to_arrays``)."""
    fresh, old = _sibling(folder, "new"), _sibling(folder, "old")
    try:
        if folder.exists() and (not folder.is_dir() or {path.name for path in folder.iterdir()} - _FILES):
            raise StorageError(
                f"{folder}: holds something else than {' and '.join(sorted(_FILES))}; choose another folder"
            )
        if not folder.exists() and old.is_dir():
            os.replace(old, folder)  # a crash came between the two renames of _put_in_place
        for left_over in (fresh, old):
            shutil.rmtree(left_over, ignore_errors=True)
        fresh.mkdir(parents=True)
        with open(fresh / "arrays.npz", "wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
            file.flush()
            os.fsync(file.fileno())
        digest = _sha256(fresh / "arrays.npz")
        write_json(fresh / "record.json", _signed({"format": FORMAT, **record, "arrays_sha256": digest}))
        _put_in_place(fresh, folder, old)
    except StorageError:
        raise
    except OSError as error:
        raise StorageError(f"{folder}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def _put_in_place(fresh: Path, folder: Path, old: Path) -> None:
    if folder.exists():
        os.replace(folder, old)
    try:
        os.replace(fresh, folder)
    except OSError:
        if old.exists():
            os.replace(old, folder)
        raise
    _sync(folder.parent)
    shutil.rmtree(old, ignore_errors=True)


def _sync(folder: Path) -> None:
    """Make renames inside a folder last through a power cut; a system that cannot do so for folders is let off."""
    with contextlib.suppress(OSError):
        entries = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(entries)
        finally:
            os.close(entries)


def _signed(record: Mapping[str, Any]) -> dict[str, Any]:
    """Add to a record the checksum of its content, which does not depend on how the JSON is laid out."""
    content = {name: value for name, value in record.items() if name != "record_sha256"}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return {**content, "record_sha256": hashlib.sha256(text.encode()).hexdigest()}


def _sibling(folder: Path, state: str) -> Path:
    return folder.with_name(f".{folder.name}.{state}")


def _whole(folder: Path) -> Path:
    """Find the folder, or its predecessor where a crash came between the two renames of ``_put_in_place``."""
    old = _sibling(folder, "old") if folder.name else folder
    return old if os.path.isdir(old) and not os.path.exists(folder) else folder


def is_saved(folder: Path) -> bool:
    """Whether a folder is one of ``save_tree``; also for paths that cannot exist."""
    return os.path.isfile(_whole(folder) / "record.json")


def read_record(folder: Path) -> dict[str, Any]:
    """Read the JSON record of a saved folder, and check its format and its checksum."""
    path = _whole(folder) / "record.json"
    record = read_json(path)
    found = record.get("format")
    if type(found) is not int or found not in (_OLD_FORMAT, FORMAT):
        raise DamagedFileError(f"{path}: format must be {FORMAT} (or {_OLD_FORMAT}, the older one), got {found!r}")
    if (found == FORMAT or "record_sha256" in record) and _signed(record) != record:
        raise DamagedFileError(f"{path}: damaged: its content does not have the checksum written in it")
    return record


def load_tree(
    folder: Path, template: Any, upgrade: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]] | None = None
) -> Any:
    """Read a pytree back into the structure of ``template`` (arrays or shape structs).

    upgrade: makes arrays by today's names of those in the folder, which may be of an older version.

    Raises:
        DamagedFileError: the arrays are missing, damaged, or do not have the names, shapes and types of the template.

    """
    arrays = read_arrays(folder)
    return from_arrays(arrays if upgrade is None else upgrade(arrays), template, _whole(folder) / "arrays.npz")


def read_arrays(folder: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a saved folder by their names, without jax.

    Raises:
        DamagedFileError: the arrays are missing or damaged.

    """
    path = _whole(folder) / "arrays.npz"
    expected = read_record(folder).get("arrays_sha256")
    if not path.is_file():
        raise StorageError(f"{path}: no such file")
    if _sha256(path) != expected:
        raise DamagedFileError(f"{path}: damaged: its checksum is not the one in record.json")
    return _read_arrays(path)


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        content = np.load(path, allow_pickle=False)
        if not isinstance(content, np.lib.npyio.NpzFile):
            raise ValueError("it is no archive of arrays")
        with content as file:
            arrays = {name: file[name] for name in file.files}
        # What is no array inside the archive comes back as bytes.
        if not all(isinstance(array, np.ndarray) for array in arrays.values()):
            raise ValueError("the archive holds other things than arrays")
        return arrays
    except (ValueError, OSError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise DamagedFileError(f"{path}: cannot be read as arrays: {error}") from None


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
