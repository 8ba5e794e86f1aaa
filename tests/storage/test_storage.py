"""Saved trees: they come back as they were, or an error names the file; a crash leaves what was there."""

import json
import os
import pickle
import shutil
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from koz_jax.errors import SettingsError, StorageError
from koz_jax.storage import archive, files


def sample() -> dict[str, Any]:
    """A tree of everything that a training state holds."""
    params = {"dense": {"kernel": jnp.arange(6.0).reshape(2, 3) / 7, "bias": jnp.full((3,), jnp.nan)}}
    optimizer = optax.chain(optax.clip(1.0), optax.adam(1e-3))
    return {
        "params": params,
        "optimizer": optimizer.init(params),
        "key": jax.random.key(7),
        "keys": jax.random.split(jax.random.key(8), 3),
        "done": jnp.array([True, False]),
        "steps": jnp.int32(-3),
        "best": jnp.float32(-jnp.inf),
        "list": [jnp.zeros((0, 4)), (jnp.uint32(5), None)],
    }


def template(tree: Any) -> Any:
    return jax.eval_shape(lambda: tree)


def assert_same(found: Any, expected: Any) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert one.dtype == other.dtype
        if jnp.issubdtype(one.dtype, jax.dtypes.prng_key):
            one, other = jax.random.key_data(one), jax.random.key_data(other)
        np.testing.assert_array_equal(one, other, strict=True)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """A folder with a small tree, ``small()``."""
    archive.save_tree(tmp_path / "state", small(), {"note": "first"})
    return tmp_path / "state"


def small(offset: float = 0.0) -> dict[str, jax.Array]:
    return {"a": jnp.arange(100.0) + offset, "b": jnp.int32(3)}


def replace_arrays(folder: Path, content: bytes) -> None:
    """Put other bytes in the place of the arrays, with a checksum that fits."""
    (folder / "arrays.npz").write_bytes(content)
    record = json.loads((folder / "record.json").read_text())
    record["arrays_sha256"] = archive._sha256(folder / "arrays.npz")
    (folder / "record.json").write_text(json.dumps(archive._signed(record)))


def npz(path: Path, **arrays: Any) -> bytes:
    np.savez(path, **arrays)
    return path.read_bytes()


def refusal(folder: Path, tree: Any = None) -> str:
    """The message with which a folder is refused."""
    with pytest.raises(StorageError) as caught:
        archive.load_tree(folder, template(small() if tree is None else tree))
    return str(caught.value)


def test_round_trip(tmp_path):
    tree = sample()
    archive.save_tree(tmp_path / "deep" / "state", tree, {"note": "x"})
    assert_same(archive.load_tree(tmp_path / "deep" / "state", template(tree)), tree)
    assert archive.read_record(tmp_path / "deep" / "state")["note"] == "x"
    assert sorted(path.name for path in (tmp_path / "deep").rglob("*")) == ["arrays.npz", "record.json", "state"]


def test_a_restored_key_draws_the_same_numbers(tmp_path):
    archive.save_tree(tmp_path / "state", {"key": jax.random.key(7)}, {})
    key = archive.load_tree(tmp_path / "state", template({"key": jax.random.key(0)}))["key"]
    np.testing.assert_array_equal(jax.random.normal(key, (5,)), jax.random.normal(jax.random.key(7), (5,)))


def test_arrays_are_named_by_their_place(tmp_path):
    archive.save_tree(tmp_path / "state", sample(), {})
    with np.load(tmp_path / "state" / "arrays.npz") as file:
        assert {"params/dense/kernel", "optimizer/1/0/mu/dense/bias", "key", "list/1/0"} <= set(file.files)


def test_a_second_save_replaces_the_first(saved):
    archive.save_tree(saved, small(1.0), {"note": "second"})
    assert_same(archive.load_tree(saved, template(small())), small(1.0))
    assert archive.read_record(saved)["note"] == "second"
    assert [path.name for path in saved.parent.iterdir()] == ["state"]


@pytest.mark.parametrize("name", ["arrays.npz", "record.json"])
def test_a_missing_or_empty_file_is_named(saved, name):
    path = saved / name
    path.write_bytes(b"")
    assert str(path) in refusal(saved)
    path.unlink()
    assert refusal(saved) == f"{path}: no such file"


def test_a_missing_folder_is_named(tmp_path):
    assert refusal(tmp_path / "nowhere") == f"{tmp_path / 'nowhere' / 'record.json'}: no such file"


def test_every_flipped_bit_and_truncation_is_noticed(saved):
    path = saved / "arrays.npz"
    whole = path.read_bytes()
    for position in range(0, len(whole), 97):
        path.write_bytes(whole[:position] + bytes([whole[position] ^ 1]) + whole[position + 1 :])
        assert refusal(saved) == f"{path}: damaged: its checksum is not the one in record.json"
    for length in (1, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        assert "damaged" in refusal(saved)
    path.write_bytes(whole)
    archive.load_tree(saved, template(small()))


@pytest.mark.slow
def test_a_flipped_bit_of_any_byte_of_the_record_is_noticed_or_changes_nothing(tmp_path):
    record = {"note": "first", "scale": 1e-05, "sizes": (16, 16), "text": "a,b\n1,0.5\n"}
    archive.save_tree(tmp_path / "state", small(), record)
    path = tmp_path / "state" / "record.json"
    whole, content = path.read_bytes(), archive.read_record(tmp_path / "state")
    harmless = 0
    for position in range(len(whole)):
        flipped = whole[position] ^ 1 << position % 8
        path.write_bytes(whole[:position] + bytes([flipped]) + whole[position + 1 :])
        try:
            found = archive.read_record(tmp_path / "state")
        except StorageError as error:
            assert str(error).startswith(str(path))
        else:
            assert found == content  # such as 1E-05 for 1e-05
            harmless += 1
    assert harmless <= 2


def test_a_record_does_not_depend_on_how_it_is_laid_out(saved):
    path = saved / "record.json"
    path.write_text(json.dumps(json.loads(path.read_text())))
    assert archive.read_record(saved)["note"] == "first"


def test_a_record_of_the_format_without_checksum_is_read(saved):
    path = saved / "record.json"
    record = json.loads(path.read_text())
    del record["record_sha256"]
    path.write_text(json.dumps(record | {"format": 1}))
    assert_same(archive.load_tree(saved, template(small())), small())
    path.write_text(json.dumps(record))
    assert "damaged" in refusal(saved)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "cannot be read as JSON"),
        ("{", "cannot be read as JSON"),
        ("[" * 100_000, "cannot be read as JSON"),
        ("[1]", "must hold a JSON object, got list"),
        ("1" * 10_000, "cannot be read as JSON"),
        ("{}", "format must be 2 (or 1, the older one), got None"),
        ('{"format": 3}', "format must be 2 (or 1, the older one), got 3"),
        ('{"format": true}', "format must be 2 (or 1, the older one), got True"),
        ('{"format": 2}', "damaged: its content does not have the checksum written in it"),
        ('{"format": 1, "record_sha256": ""}', "damaged: its content does not have the checksum written in it"),
        ('{"format": 1}', "checksum"),
    ],
)
def test_a_wrong_record_is_refused(saved, content, reason):
    (saved / "record.json").write_text(content)
    message = refusal(saved)
    assert message.startswith(str(saved)) and reason in message


def test_a_record_that_is_no_text_is_refused(saved):
    (saved / "record.json").write_bytes(b"\xff\xfe\x00")
    assert f"{saved / 'record.json'}: cannot be read as JSON" in refusal(saved)


class _Danger:
    """Unpickling this makes a folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.path),)


def test_pickled_arrays_are_never_executed(saved, tmp_path):
    harm = tmp_path / "harm"
    objects = np.array([_Danger(harm)], dtype=object)
    replace_arrays(saved, npz(tmp_path / "x.npz", a=objects, b=np.int32(3)))
    assert f"{saved / 'arrays.npz'}: cannot be read as arrays" in refusal(saved)
    replace_arrays(saved, pickle.dumps(_Danger(harm)))
    assert f"{saved / 'arrays.npz'}: cannot be read as arrays" in refusal(saved)
    assert not harm.exists()


def test_objects_are_not_saved_either(tmp_path):
    with pytest.raises(ValueError, match="allow_pickle"):
        archive.save_tree(tmp_path / "state", {"a": np.array([{}], dtype=object)}, {})
    assert list(tmp_path.iterdir()) == []


def test_other_archives_are_refused_even_with_the_right_checksum(saved, tmp_path):
    a, b = np.arange(100, dtype=np.float32), np.array(3, np.int32)
    np.save(tmp_path / "plain.npy", a)
    with zipfile.ZipFile(tmp_path / "text.zip", "w") as archive:
        archive.writestr("a.npy", "no array")
        archive.writestr("b.npy", "no array")
    for content, reason in [
        (b"", "cannot be read as arrays"),
        (b"text", "cannot be read as arrays"),
        ((tmp_path / "plain.npy").read_bytes(), "cannot be read as arrays"),
        ((tmp_path / "text.zip").read_bytes(), "cannot be read as arrays"),
        (npz(tmp_path / "x.npz", a=a), "missing ['b']"),
        (npz(tmp_path / "x.npz", a=a, b=b, c=b), "unexpected ['c']"),
        (npz(tmp_path / "x.npz", a=a[:-1], b=b), "a must be float32(100,), got float32(99,)"),
        (npz(tmp_path / "x.npz", a=a[None], b=b), "a must be float32(100,), got float32(1, 100)"),
        (npz(tmp_path / "x.npz", a=a.astype(np.float64), b=b), "a must be float32(100,), got float64(100,)"),
        (npz(tmp_path / "x.npz", a=a, b=np.array(True)), "b must be int32(), got bool()"),
    ]:
        replace_arrays(saved, content)
        message = refusal(saved)
        assert message.startswith(f"{saved / 'arrays.npz'}: ") and reason in message


def test_a_key_of_another_shape_is_refused(tmp_path):
    archive.save_tree(tmp_path / "state", {"key": jax.random.key(7)}, {})
    assert "key must be uint32(3, 2), got uint32(2,)" in refusal(
        tmp_path / "state", {"key": jax.random.split(jax.random.key(0), 3)}
    )


def test_an_interrupted_save_leaves_the_old_state(saved, monkeypatch):
    def crash(file: Any, **_: Any) -> None:
        file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(archive.np, "savez", crash)
    with pytest.raises(KeyboardInterrupt):
        archive.save_tree(saved, small(1.0), {})
    monkeypatch.undo()
    assert_same(archive.load_tree(saved, template(small())), small())
    assert archive.read_record(saved)["note"] == "first"
    assert [path.name for path in saved.parent.iterdir()] == ["state"]


def test_a_full_disk_leaves_the_old_state(saved, monkeypatch):
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    for module, name in [(archive.np, "savez"), (archive.os, "fsync"), (archive.os, "replace")]:
        with monkeypatch.context() as patch:
            patch.setattr(module, name, full)
            with pytest.raises(StorageError, match="cannot be written: No space left on device"):
                archive.save_tree(saved, small(1.0), {})
        assert_same(archive.load_tree(saved, template(small())), small())
        assert [path.name for path in saved.parent.iterdir()] == ["state"]


def test_when_the_new_folder_cannot_be_put_in_place_the_old_one_comes_back(saved, monkeypatch):
    replace = os.replace

    def fails_for_the_new(source: Path, target: Path) -> None:
        if source == saved.with_name(".state.new"):
            raise OSError(5, "Input/output error")
        replace(source, target)

    monkeypatch.setattr(archive.os, "replace", fails_for_the_new)
    with pytest.raises(StorageError, match=r"state: cannot be written: Input/output error"):
        archive.save_tree(saved, small(1.0), {})
    assert_same(archive.load_tree(saved, template(small())), small())


def test_a_crash_between_the_renames_loses_nothing(saved):
    # What a power cut leaves between "old folder away" and "new folder in its place".
    os.replace(saved, saved.with_name(".state.old"))
    assert archive.is_saved(saved)
    assert_same(archive.load_tree(saved, template(small())), small())
    with pytest.raises(ValueError, match="allow_pickle"):  # a save that fails must not take the last copy with it
        archive.save_tree(saved, {"a": np.array([{}], dtype=object)}, {})
    assert_same(archive.load_tree(saved, template(small())), small())
    archive.save_tree(saved, small(1.0), {})
    assert_same(archive.load_tree(saved, template(small())), small(1.0))
    assert [path.name for path in saved.parent.iterdir()] == ["state"]


def test_left_overs_of_a_crash_are_no_obstacle(saved):
    shutil.copytree(saved, saved.with_name(".state.new"))
    shutil.copytree(saved, saved.with_name(".state.old"))
    archive.save_tree(saved, small(1.0), {})
    assert_same(archive.load_tree(saved, template(small())), small(1.0))
    assert [path.name for path in saved.parent.iterdir()] == ["state"]


def test_a_folder_with_other_things_is_not_overwritten(tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    (tmp_path / "file").write_text("work")
    for name in ("home", "file"):
        with pytest.raises(StorageError, match=rf"{name}: holds something else than arrays.npz and record.json"):
            archive.save_tree(tmp_path / name, small(), {})
    assert (tmp_path / "home" / "thesis.tex").read_text() == "years of work"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "home"]


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="state: cannot be written: Not a directory"):
        archive.save_tree(tmp_path / "file" / "state", small(), {})


def test_text_is_replaced_in_one_step(tmp_path, monkeypatch):
    path = tmp_path / "new" / "x.json"
    files.write_json(path, {"grade": "Größe", "a": 1})
    assert files.read_json(path) == {"grade": "Größe", "a": 1}

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(archive.os, "fsync", full)
    with pytest.raises(StorageError, match=r"x\.json: cannot be written: No space left on device"):
        files.write_text(path, "other")
    assert files.read_json(path)["a"] == 1
    assert [entry.name for entry in path.parent.iterdir()] == ["x.json"]


def test_nan_is_no_json(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        files.write_json(tmp_path / "x.json", {"a": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_a_link_is_followed_not_replaced(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "target")
    files.write_text(tmp_path / "link", "text")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_text() == "text"


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a folder in which not even root can write")
def test_an_unwritable_place_is_refused():
    with pytest.raises(SettingsError, match=r"^json: /proc/x\.json cannot be written: "):
        files.check_writable("json", Path("/proc/x.json"))
    with pytest.raises(StorageError, match=r"^/proc/x\.json: cannot be written: "):
        files.write_text(Path("/proc/x.json"), "text")


def test_writable_places_are_told_from_others(tmp_path):
    (tmp_path / "file").write_text("kept")
    files.check_writable("json", tmp_path / "new.json")
    files.check_writable("json", tmp_path / "file")
    assert (tmp_path / "file").read_text() == "kept"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    for path, reason in [
        (tmp_path, "must be a new or an ordinary file"),
        (Path("/dev/null"), "must be a new or an ordinary file"),
        (tmp_path / "nowhere" / "x.json", f"the folder {tmp_path / 'nowhere'} of"),
        (tmp_path / "file" / "x.json", "the folder"),
        (tmp_path / ("x" * 300), "cannot be written"),
    ]:
        with pytest.raises(SettingsError) as caught:
            files.check_writable("json", path)
        assert str(caught.value).startswith("json: ") and reason in str(caught.value) and str(path) in str(caught.value)
