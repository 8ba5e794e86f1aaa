"""Execute the notebooks and write them as ``.ipynb``: ``python notebooks/build.py``.

The ``.py`` files are the only sources (Jupytext's percent format).  ``KOZ_JAX_BUDGET=small`` makes what is executed
cheap, for CI: the notebooks themselves know nothing of it.
"""

from __future__ import annotations

import argparse
import base64
import concurrent.futures
import io
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jupytext
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbformat import NotebookNode, validate, writes
from PIL import Image

from koz_jax.cli.exit_status import exit_status
from koz_jax.errors import KozError, SettingsError
from koz_jax.storage import files, runtime

HERE = Path(__file__).resolve().parent
# Small enough for a code host to show; most pictures are below half of it.
LARGEST_PICTURE = 200_000  # bytes
LARGEST_TEXT = 10_000  # characters
# Pictures must not be shrunk by a page of this width; figures have no letters below 7.5 points, so that this resolution
# makes them 9 pixels high.
WIDEST_PICTURE = 700  # pixels
LEAST_DPI = 86.4

# What a small budget puts in place of what a notebook says.
_CHEAPER = {
    'preset("short")': 'preset("smoke")',
    'preset("fast")': 'preset("smoke")',
    "cases=500": "cases=100",
    "cases=5_000": "cases=100",
    "cases = 2_000": "cases = 100",
    "cases=10_000": "cases=100",
    "cases=200": "cases=100",
}


class NotebookError(KozError):
    """A notebook fails, or has an output that should not be kept."""


def main(argv: list[str]) -> int:
    """Build all notebooks, or those that are named.  Returns the exit status."""
    names = [source.stem for source in sorted(HERE.glob("[0-9]*.py"))]
    parser = argparse.ArgumentParser(prog="notebooks/build.py", description=__doc__)
    parser.add_argument("notebooks", nargs="*", metavar="NAME", help=f"by default all: {', '.join(names)}")
    parser.add_argument("--out", type=Path, default=HERE, help="folder of the .ipynb files; by default this one")
    parser.add_argument("--jobs", type=int, default=1, help="how many to execute at a time; by default one")
    args = parser.parse_args(argv)
    return exit_status(lambda: _build(args.notebooks or names, names, args.out, args.jobs))


def _build(chosen: list[str], names: list[str], out: Path, jobs: int) -> int:
    for name in chosen:
        if name not in names:
            raise SettingsError(f"notebooks: unknown notebook {name!r}; allowed: {', '.join(names)}")
    if jobs < 1:
        raise SettingsError(f"jobs: must be 1 or more, got {jobs}")
    runtime.keep_programs()
    # The kernel of this environment, whatever others the user has.
    os.environ["JUPYTER_PREFER_ENV_PATH"] = "1"

    def build(name: str) -> None:
        start = time.perf_counter()
        notebook = execute(HERE / f"{name}.py", cheaply=os.environ.get("KOZ_JAX_BUDGET") == "small")
        files.write_text(out / f"{name}.ipynb", writes(notebook) + "\n")
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)

    begin = time.perf_counter()
    with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
        list(pool.map(build, chosen))
    print(f"{len(chosen)} notebooks in {time.perf_counter() - begin:.0f} s")
    return 0


def execute(source: Path, cheaply: bool = False) -> NotebookNode:
    """Run a notebook from top to bottom in a fresh process, in an empty folder.

    cheaply: with less training and fewer cases than it says.

    Raises:
        NotebookError: a cell fails, or leaves too large an output or a figure without its picture.

    """
    notebook = jupytext.read(source)
    for cell in notebook.cells:
        for said, cheaper in _CHEAPER.items() if cheaply else ():
            cell.source = cell.source.replace(said, cheaper)
    notebook.metadata = NotebookNode(kernelspec=_KERNEL, language_info={"name": "python"})
    with tempfile.TemporaryDirectory(prefix="koz_jax-notebook-") as folder:
        client = NotebookClient(
            notebook,
            timeout=None,
            kernel_name=_KERNEL["name"],
            record_timing=False,
            startup_timeout=300,
            extra_arguments=["--IPKernelApp.log_level=ERROR"],
            resources={"metadata": {"path": folder}},
        )
        try:
            client.execute()
        except (CellExecutionError, RuntimeError) as error:  # the latter where the kernel does not start, or dies
            raise NotebookError(f"{source.name}: {error}") from None
    for number, cell in enumerate(notebook.cells):
        cell.id = f"{number:02d}"  # Jupytext's are random, and would change with every build
        if cell.cell_type == "code":
            cell.outputs = [_checked(output, source.name) for output in cell.outputs if _is_kept(output, source.name)]
    validate(notebook)
    return notebook


_KERNEL = {"name": "python3", "display_name": "Python 3", "language": "python"}


def _is_kept(output: Any, name: str) -> bool:
    """Warnings and progress are for who builds, not for who reads."""
    if output.output_type == "stream" and output.name == "stderr":
        print(f"{name}: {output.text.strip()}", file=sys.stderr)
        return False
    return True


def _checked(output: Any, name: str) -> Any:
    data = output.get("data", {})
    if data.get("text/plain", "").startswith("<Figure") and "image/png" not in data:
        raise SettingsError(
            f"{name}: a figure shows as {data['text/plain']}; begin the notebook with %matplotlib inline"
        )
    picture = _shrunk(base64.b64decode(data.get("image/png", "")))
    if picture:
        data["image/png"] = base64.b64encode(picture).decode()
    text = len(str(output.get("text", "")))
    if len(picture) > LARGEST_PICTURE or text > LARGEST_TEXT:
        raise SettingsError(
            f"{name}: an output is too large: a picture of {len(picture)} bytes, a text of {text} characters"
        )
    if picture:
        _check_readable(picture, name)
    return output


def _shrunk(picture: bytes) -> bytes:
    """Write a large PNG again with a palette; thousands of points on each other have thousands of colours."""
    if len(picture) <= LARGEST_PICTURE:
        return picture
    with Image.open(io.BytesIO(picture)) as image:
        content = io.BytesIO()
        few_colours = image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        few_colours.save(content, "png", optimize=True, dpi=image.info["dpi"])
    return content.getvalue()


def _check_readable(picture: bytes, name: str) -> None:
    with Image.open(io.BytesIO(picture)) as image:
        dpi = float(image.info.get("dpi", (0.0, 0.0))[0])
        if image.width > WIDEST_PICTURE or dpi < LEAST_DPI:
            raise SettingsError(
                f"{name}: letters of a picture would be too small: must be at most {WIDEST_PICTURE} pixels wide, at"
                f" {LEAST_DPI:g} dpi or more; got {image.width} at {dpi:.1f}"
            )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
