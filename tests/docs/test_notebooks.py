"""Notebooks are for who reads them: what only builds or checks them stands elsewhere."""

import importlib.util
import io

import pytest
from support.tiny import ROOT

from koz_jax.errors import SettingsError

Image = pytest.importorskip("PIL.Image")
for needed in ("jupytext", "nbclient"):
    pytest.importorskip(needed)

SOURCES = sorted((ROOT / "notebooks").glob("[0-9]*.py"))


@pytest.fixture(scope="module")
def build():
    """``notebooks/build.py`` as a module."""
    spec = importlib.util.spec_from_file_location("build", ROOT / "notebooks" / "build.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)
@pytest.mark.parametrize("plumbing", ["KOZ_JAX_BUDGET", "os.environ", "pyright", "noqa", "assert ", "set_dpi"])
def test_no_plumbing_in_a_notebook(source, plumbing):
    assert plumbing not in source.read_text()


def test_what_a_small_budget_replaces_is_there(build):
    texts = [source.read_text() for source in SOURCES]
    for said in build._CHEAPER:
        assert any(said in text for text in texts), said


def picture(width, dpi, noise=False):
    image = Image.effect_noise((width, 600), 200.0).convert("RGB") if noise else Image.new("RGB", (width, 600))
    content = io.BytesIO()
    image.save(content, "png", dpi=(dpi, dpi))
    return content.getvalue()


@pytest.mark.parametrize(("width", "dpi"), [(701, 100), (640, 80), (960, 60)])
def test_letters_too_small_to_read_are_refused(build, width, dpi):
    with pytest.raises(SettingsError, match="x: letters of a picture would be too small"):
        build._check_readable(picture(width, dpi), "x")
    build._check_readable(picture(700, 100), "x")


def test_large_pictures_become_smaller_and_keep_their_colours(build):
    large = picture(700, 100, noise=True)
    assert len(large) > build.LARGEST_PICTURE
    small = build._shrunk(large)
    assert len(small) < len(large)
    with Image.open(io.BytesIO(small)) as image:
        assert image.size == (700, 600) and image.info["dpi"][0] == pytest.approx(100.0, abs=0.1)
    assert build._shrunk(picture(100, 100)) == picture(100, 100)
