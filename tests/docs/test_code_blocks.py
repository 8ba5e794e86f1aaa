"""README and the documentation tell the truth: Python blocks run, command lines exist, links lead somewhere."""

import contextlib
import functools
import io
import itertools
import re
import shlex
from pathlib import Path
from typing import NamedTuple

import pytest
from support.tiny import ROOT

import koz_jax
from koz_jax.cli import main as koz

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
NAMES = [str(page.relative_to(ROOT)) for page in PAGES]

# <!-- test: skip, REASON -->  or  <!-- test: file NAME -->  before a block
BLOCK = re.compile(r"(?:^<!-- test: (?P<mark>.*?) -->\n)?^```(?P<language>\w+)\n(?P<code>.*?)^```$", re.M | re.S)
LINK = re.compile(r"\]\((?!https?:)([^)#\s]+)(?:#[^)\s]*)?\)")
FLAG = re.compile(r"--[a-z][\w.-]*")
CASES = re.compile(r"\bcases=\d[\d_]*")


class Block(NamedTuple):
    mark: str
    language: str
    code: str


def blocks(page, language):
    found = (Block(match["mark"] or "", match["language"], match["code"]) for match in BLOCK.finditer(page.read_text()))
    return [block for block in found if block.language == language]


WITH_PYTHON = [
    pytest.param(page, id=page.name, marks=() if page.name == "README.md" else pytest.mark.slow)
    for page in PAGES
    if blocks(page, "python")
]


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_PYTHON)
def test_python_blocks_run(page, tmp_path, monkeypatch):
    """One after another with the same names, in an empty folder; over few cases, as they run without optimisation."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    names = {"__name__": "__main__"}
    for number, block in enumerate(blocks(page, "python")):
        kind, _, rest = block.mark.partition(" ")
        if kind == "skip,":
            assert rest, "a block is skipped for a reason"
            compile(block.code, page.name, "exec")
            continue
        if kind == "file":
            Path(rest).write_text(block.code)
        with contextlib.redirect_stdout(io.StringIO()):
            exec(compile(CASES.sub("cases=10", block.code), f"{page.name}, block {number}", "exec"), names)


@functools.cache
def flags_of(command):
    """All flags in the help of a sub-command of koz."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit), pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "300")
        koz.main([command, "--help"])
    return set(FLAG.findall(text.getvalue())) | {"--help"}


@functools.cache
def flags_in(script):
    """All flags that the source of a script declares: arguments of argparse, fields of a class for tyro."""
    source = script.read_text()
    fields = re.findall(r"^    (\w+): .*=", source, re.M)
    return set(re.findall(r'"(--[\w-]+)"', source)) | {f"--{name.replace('_', '-')}" for name in fields} | {"--help"}


def command_lines(page):
    """Commands in the page's shell blocks, and those of koz that stand in the text."""
    in_blocks = [
        line for block in blocks(page, "sh") for line in block.code.replace("\\\n", " ").splitlines() if line.strip()
    ]
    prose = BLOCK.sub("", page.read_text())
    in_text = [" ".join(code.split()) for code in re.findall(r"`((?:koz|python) [^`]+)`", prose)]
    for line in [*in_blocks, *in_text]:
        words = shlex.split(line, comments=True)
        yield list(itertools.dropwhile(lambda word: re.match(r"\w+=", word), words))


def check_koz(command, words):
    assert command in koz.COMMANDS or command in ("--help", "COMMAND"), command
    if command in koz.COMMANDS:
        given = {found.group() for word in words if (found := FLAG.match(word))}
        assert given <= flags_of(command), (command, given - flags_of(command))


SHIMS = {"train.py": "train", "eval_mc.py": "evaluate", "fly.py": "fly"}


def check_python(words):
    script = words[0]
    if script in SHIMS:
        check_koz(SHIMS[script], words[1:])
    elif script.endswith(".py") and "/" in script:
        assert (ROOT / script).is_file(), script
        given = {found.group() for word in words[1:] if (found := FLAG.match(word))}
        assert given <= flags_in(ROOT / script), (script, given - flags_in(ROOT / script))


def make_targets():
    return set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))


def check_make(words):
    targets = {word for word in words if "=" not in word}
    assert targets <= make_targets(), targets - make_targets()


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "CHANGELOG.md"], ids=lambda page: page.name)
def test_command_lines_exist(page):
    for words in command_lines(page):
        if not words:
            continue
        program, *others = words
        if program == "koz" and others:
            check_koz(others[0], others[1:])
        elif re.fullmatch(r"(\S*/)?python3?", program) and others and others[0] not in ("-m", "-c"):
            check_python(others)
        elif program == "make" and others:
            check_make(others)


def test_every_command_is_described():
    text = (ROOT / "docs" / "index.md").read_text()
    assert all(f"`koz {command}`" in text for command in koz.COMMANDS)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page):
    for target in LINK.findall(page.read_text()):
        assert (page.parent / target).exists(), target


def test_included_files_are_there():
    for page in PAGES:
        for name in re.findall(r'^--8<-- "([^"]+)"$', page.read_text(), re.M):
            assert (ROOT / "docs" / name).is_file() or (ROOT / name).is_file(), name


def test_every_folder_and_public_name_is_on_an_api_page():
    package = ROOT / "koz_jax"
    folders = {path.parent.name for path in package.glob("*/__init__.py")}
    pages = {page.stem for page in (ROOT / "docs" / "api").glob("*.md")} - {"index"}
    assert folders == pages
    index = (ROOT / "docs" / "api" / "index.md").read_text()
    assert [name for name in koz_jax.__all__ if f"[`{name}`]" not in index] == []


def test_readme_is_one_page_and_soon_shows_python():
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 110
    assert "```python" in lines[:60]


def test_the_site_loads_nothing_from_elsewhere():
    """Fonts, icons and scripts are in the site; no page has a picture of another host."""
    configuration = (ROOT / "mkdocs.yml").read_text()
    assert "font: false" in configuration
    assert not re.search(r"https?://", configuration)
    for page in PAGES:
        assert not re.search(r"!\[[^]]*\]\(https?:", page.read_text()), page
