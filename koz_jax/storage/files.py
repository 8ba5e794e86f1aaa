"""Files that are whole or not there: text, bytes and JSON, written atomically."""

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from koz_jax.errors import DamagedFileError, SettingsError, StorageError


def check_writable(name: str, path: Path) -> None:
    """Refuse a file that cannot be written, before the work whose results it is for.

    Raises:
        SettingsError: it cannot; the message begins with ``name``, the setting that gave the path.

    """
    try:
        if path.exists() and not path.is_file():
            raise SettingsError(f"{name}: {path} must be a new or an ordinary file")
        if not path.parent.is_dir():
            raise SettingsError(f"{name}: the folder {path.parent} of {path} does not exist")
        probe = _temporary(path)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise SettingsError(f"{name}: {path} cannot be written: {error.strerror or error}") from None


def make_folder(name: str, path: Path) -> None:
    """Make a folder for results, or refuse it before the work whose results it is for.

    Raises:
        SettingsError: it cannot be made or written to; the message begins with ``name``, the setting that gave the
            path.

    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = _temporary(path / "probe")
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise SettingsError(f"{name}: the folder {path} cannot be written: {error.strerror or error}") from None


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
        raise StorageError(f"{path}: cannot be written: {error.strerror or error}") from error
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
        raise StorageError(f"{path}: no such file") from None
    except (OSError, ValueError, RecursionError) as error:
        raise DamagedFileError(f"{path}: cannot be read as JSON: {error}") from None
    if not isinstance(content, dict):
        raise DamagedFileError(f"{path}: must hold a JSON object, got {type(content).__name__}")
    return content
