"""Files that are whole or not there: checked arrays and JSON, written atomically, read without executing code.

jax is imported by those functions only that need it, so that agents can be read without it.
"""

import contextlib
import hashlib
import json
import os
import shutil
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from koz_jax.errors import UserError

FORMAT = 2
_OLD_FORMAT = 1  # its records have no checksum

_FILES = {"arrays.npz", "record.json"}


def check_writable(name: str, path: Path) -> None:
    """Refuse a file that cannot be written, before the work whose results it is for.

    Raises:
        UserError: it cannot; the message begins with ``name``, the setting that gave the path.

    """
    try:
        if path.exists() and not path.is_file():
            raise UserError(f"{name}: {path} must be a new or an ordinary file")
        if not path.parent.is_dir():
            raise UserError(f"{name}: the folder {path.parent} of {path} does not exist")
        probe = _temporary(path)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise UserError(f"{name}: {path} cannot be written: {error.strerror or error}") from None


def make_folder(name: str, path: Path) -> None:
    """Make a folder for results, or refuse it before the work whose results it is for.

    Raises:
        UserError: it cannot be made or written to; the message begins with ``name``, the setting that gave the path.

    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = _temporary(path / "probe")
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise UserError(f"{name}: the folder {path} cannot be written: {error.strerror or error}") from None


def write_text(path: Path, text: str) -> None:
    """``write_bytes`` for text, in UTF-8."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file in one step: readers see the old content or the new, never a part."""
    fresh = _temporary(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(fresh, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(fresh, path.resolve())
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):
            fresh.unlink()


def _temporary(path: Path) -> Path:
    """Where to write what will replace a file: beside it, on the same disk."""
    target = path.resolve()
    return target.with_name(f".{target.name}.{os.getpid()}")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file in one step."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object, or say which file is not one."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{path}: cannot be read as JSON: {error}") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: must hold a JSON object, got {type(content).__name__}")
    return content


def save_tree(folder: Path, tree: Any, record: Mapping[str, Any]) -> None:
    """Write a pytree and a JSON record as a folder, replacing an older one only when the new one is whole.

    The folder holds ``arrays.npz`` and ``record.json``; the record gains the format number, the arrays' checksum and
    its own.

    Raises:
        UserError: the folder cannot be written, or holds something else that would be lost.

    """
    save_arrays(folder, to_arrays(tree), record)


def save_arrays(folder: Path, arrays: Mapping[str, np.ndarray], record: Mapping[str, Any]) -> None:
    """``save_tree`` for a tree that is on the host already (see ``to_arrays``)."""
    fresh, old = _sibling(folder, "new"), _sibling(folder, "old")
    try:
        if folder.exists() and (not folder.is_dir() or {path.name for path in folder.iterdir()} - _FILES):
            raise UserError(
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
    except OSError as error:
        raise UserError(f"{folder}: cannot be written: {error.strerror or error}") from error
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
        raise UserError(f"{path}: format must be {FORMAT} (or {_OLD_FORMAT}, the older one), got {found!r}")
    if (found == FORMAT or "record_sha256" in record) and _signed(record) != record:
        raise UserError(f"{path}: damaged: its content does not have the checksum written in it")
    return record


def load_tree(folder: Path, template: Any) -> Any:
    """Read a pytree back into the structure of ``template`` (arrays or shape structs).

    Raises:
        UserError: the arrays are missing, damaged, or do not have the names, shapes and types of the template.

    """
    return _from_arrays(read_arrays(folder), template, _whole(folder) / "arrays.npz")


def read_arrays(folder: Path) -> dict[str, np.ndarray]:
    """Read the arrays of a saved folder by their names, without jax.

    Raises:
        UserError: the arrays are missing or damaged.

    """
    path = _whole(folder) / "arrays.npz"
    expected = read_record(folder).get("arrays_sha256")
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    if _sha256(path) != expected:
        raise UserError(f"{path}: damaged: its checksum is not the one in record.json")
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
        raise UserError(f"{path}: cannot be read as arrays: {error}") from None


def named_leaves(tree: Any) -> dict[str, Any]:
    """Leaves by their path in the tree, such as ``learner/policy/params/kernel``."""
    import jax

    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _is_key(leaf: Any) -> bool:
    import jax
    import jax.numpy as jnp

    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def key_data(tree: Any) -> Any:
    """Replace typed PRNG keys by their data."""
    import jax

    return jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, tree)


def to_arrays(tree: Any) -> dict[str, np.ndarray]:
    """Copy a tree to the host: arrays by name, typed PRNG keys as their data.

    A view would not do: the memory of a state is used again as soon as training goes on.
    """
    return {name: np.array(leaf) for name, leaf in named_leaves(key_data(tree)).items()}


def _from_arrays(arrays: dict[str, np.ndarray], template: Any, path: Path) -> Any:
    import jax
    import jax.numpy as jnp

    wanted = named_leaves(template)
    if wanted.keys() != arrays.keys():
        missing, extra = sorted(wanted.keys() - arrays.keys()), sorted(arrays.keys() - wanted.keys())
        raise UserError(f"{path}: holds other arrays than expected: missing {missing[:3]}, unexpected {extra[:3]}")
    leaves = []
    for name, leaf in wanted.items():
        stored = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
        found = arrays[name]
        if found.shape != stored.shape or found.dtype != stored.dtype:
            raise UserError(f"{path}: {name} must be {stored.dtype}{stored.shape}, got {found.dtype}{found.shape}")
        array = jnp.asarray(found)
        leaves.append(jax.random.wrap_key_data(array) if _is_key(leaf) else array)
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
