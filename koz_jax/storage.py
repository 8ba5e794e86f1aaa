"""Files that are whole or not there: arrays with checksums and JSON, written atomically, read without executing code."""

import hashlib
import json
import os
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import serialization, traverse_util

from koz_jax.errors import UserError

FORMAT = 1


def write_text(path: Path, text: str) -> None:
    """Write a file in one step: readers see the old content or the new, never a part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    with open(fresh, "w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(fresh, path)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file in one step."""
    write_text(path, json.dumps(content, indent=2) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object, or say which file is not one."""
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise UserError(f"{path}: cannot be read as JSON: {error}") from None
    if not isinstance(content, dict):
        raise UserError(f"{path}: must hold a JSON object, got {type(content).__name__}")
    return content


def _to_arrays(tree: Any) -> dict[str, np.ndarray]:
    def plain(leaf: Any) -> np.ndarray:
        is_key = isinstance(leaf, jax.Array) and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.asarray(jax.random.key_data(leaf) if is_key else leaf)

    state = serialization.to_state_dict(jax.tree.map(plain, tree))
    return traverse_util.flatten_dict(state, sep="/")  # pyright: ignore[reportReturnType]


def save_tree(folder: Path, tree: Any, record: Mapping[str, Any]) -> None:
    """Write a pytree and a JSON record as a folder, replacing an older one in one rename.

    The folder holds ``arrays.npz`` and ``record.json``; the record gains the format number and the arrays' checksum.
    """
    fresh, old = (folder.with_name(f".{folder.name}.{state}") for state in ("new", "old"))
    for left_over in (fresh, old):
        shutil.rmtree(left_over, ignore_errors=True)
    fresh.mkdir(parents=True)
    try:
        with open(fresh / "arrays.npz", "wb") as file:
            np.savez(file, allow_pickle=False, **_to_arrays(tree))
            file.flush()
            os.fsync(file.fileno())
        digest = _sha256(fresh / "arrays.npz")
        write_json(fresh / "record.json", {"format": FORMAT, **record, "arrays_sha256": digest})
        if folder.exists():
            os.replace(folder, old)
        os.replace(fresh, folder)
        shutil.rmtree(old, ignore_errors=True)
    except BaseException:
        shutil.rmtree(fresh, ignore_errors=True)
        raise


def read_record(folder: Path) -> dict[str, Any]:
    """The JSON record of a saved folder, its format checked."""
    record = read_json(folder / "record.json")
    if record.get("format") != FORMAT:
        raise UserError(f"{folder / 'record.json'}: format must be {FORMAT}, got {record.get('format')!r}")
    return record


def load_tree(folder: Path, template: Any) -> Any:
    """Read a pytree back into the structure of ``template`` (arrays or shape structs).

    Raises:
        UserError: the arrays are missing, damaged, or do not have the names, shapes and types of the template.
    """
    path = folder / "arrays.npz"
    expected = read_record(folder).get("arrays_sha256")
    if not path.is_file():
        raise UserError(f"{path}: no such file")
    if _sha256(path) != expected:
        raise UserError(f"{path}: damaged: its checksum is not the one in record.json")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (ValueError, OSError, zipfile.BadZipFile) as error:
        raise UserError(f"{path}: cannot be read as arrays: {error}") from None
    return _from_arrays(arrays, template, path)


def _from_arrays(arrays: dict[str, np.ndarray], template: Any, path: Path) -> Any:
    def is_key(leaf: Any) -> bool:
        return jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)

    def stored(leaf: Any) -> Any:
        return jax.eval_shape(jax.random.key_data, leaf) if is_key(leaf) else leaf

    plain = jax.tree.map(stored, template)
    wanted = traverse_util.flatten_dict(serialization.to_state_dict(plain), sep="/")
    if wanted.keys() != arrays.keys():
        missing, extra = sorted(wanted.keys() - arrays.keys()), sorted(arrays.keys() - wanted.keys())
        raise UserError(f"{path}: holds other arrays than expected: missing {missing[:3]}, unexpected {extra[:3]}")
    for name, leaf in wanted.items():
        found = arrays[name]
        if found.shape != leaf.shape or found.dtype != leaf.dtype:
            raise UserError(
                f"{path}: {name} must be {leaf.dtype}{leaf.shape}, got {found.dtype}{found.shape}"
            )
    tree = serialization.from_state_dict(plain, traverse_util.unflatten_dict(arrays, sep="/"))
    return jax.tree.map(
        lambda leaf, value: jax.random.wrap_key_data(value) if is_key(leaf) else jax.numpy.asarray(value),
        template,
        tree,
    )


def _sha256(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
