"""The console command: its sub-commands, what finding them costs, and how it names itself."""

import re
import subprocess
import sys

import pytest
from support import tiny
from support.drawn import metrics_log

import koz_jax
from koz_jax.agents.record import shipped_agents
from koz_jax.cli import invocation
from koz_jax.cli.exit_status import exit_status
from koz_jax.cli.main import COMMANDS, main
from koz_jax.config.presets.named import PRESETS
from koz_jax.control.registry import BUILT_IN
from koz_jax.errors import SettingsError
from koz_jax.evaluation.monte_carlo import _log


def modules_after(code: str) -> set[str]:
    """Top-level packages that a program has imported at its end."""
    done = tiny.run_python("-c", f"import sys\n{code}\nprint(*{{name.split('.')[0] for name in sys.modules}})")
    assert done.returncode == 0, done.stderr
    return {*done.stdout.splitlines()[-1].split()}


def test_the_help_names_every_command_and_imports_nothing(capsys):
    for argv in (["--help"], ["-h"], []):
        assert main(argv) == 0
        text = capsys.readouterr().out
        assert all(name in text and told in text for name, told in COMMANDS.items())
    loaded = modules_after("from koz_jax.cli.main import main; main(['--help'])")
    assert not loaded & {"jax", "numpy", "pydantic", "tyro", "flax", "matplotlib"}


@pytest.mark.slow
def test_the_help_of_commands_imports_no_jax():
    code = (
        "from koz_jax.cli.main import COMMANDS, main\n"
        "for name in COMMANDS:\n"
        "    try: main([name, '--help'])\n"
        "    except SystemExit as end: assert end.code == 0, name\n"
        "main(['agents'])"
    )
    assert not modules_after(code) & {"jax", "flax", "optax", "brax", "matplotlib"}


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"koz_jax {koz_jax.__version__}\n"
    assert re.match(r"\d", koz_jax.__version__)


def test_an_unknown_command_is_refused(capsys):
    assert main(["vew"]) == 2
    assert capsys.readouterr().err == f"error: command: must be one of {', '.join(COMMANDS)}; got 'vew'\n"


def help_of(capsys, name: str) -> str:
    assert tiny.status(name, "--help") == 0
    return re.sub(r"[\s│|]", "", capsys.readouterr().out)


@pytest.mark.parametrize("name", ["evaluate", "fly", "view"])
def test_registered_controllers_and_agents_are_in_the_help(capsys, name):
    text = help_of(capsys, name)
    for known in (*BUILT_IN, *shipped_agents(), "path/to/file.py:CLASS"):
        assert known in text


@pytest.mark.slow
def test_registered_names_are_in_the_help_of_the_others(capsys):
    assert all(name in help_of(capsys, "train") for name in PRESETS)
    assert all(name in help_of(capsys, "export") for name in shipped_agents())
    assert tiny.status("agents") == 0
    assert all(name in capsys.readouterr().out.replace("\n", " ").split() for name in shipped_agents()[:1])


@pytest.mark.parametrize(
    ("begun", "train", "view"),
    [
        ("/usr/bin/koz", "koz train", "koz view"),
        ("train.py", "python train.py", "python -m koz_jax view"),
        ("../my work/eval_mc.py", "python '../my work/train.py'", "python -m koz_jax view"),
        ("/x/koz_jax/__main__.py", "python -m koz_jax train", "python -m koz_jax view"),
        ("/x/pytest/__main__.py", "koz train", "koz view"),
        ("", "koz train", "koz view"),
    ],
)
def test_messages_name_the_command_that_was_typed(monkeypatch, begun, train, view):
    monkeypatch.setattr(sys, "argv", [begun])
    assert (invocation.command("train"), invocation.command("view")) == (train, view)
    assert invocation.typed("train", ["--run", "my run"]) == f"{train} --run 'my run'"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("begun", "named"),
    [(["eval_mc.py"], "python eval_mc.py"), (["-m", "koz_jax", "evaluate"], "python -m koz_jax evaluate")],
)
def test_every_way_to_begin_it_leads_to_the_same_command(begun, named):
    done = tiny.run_python(*begun, "--help")
    assert done.returncode == 0 and f"usage: {named} [-h]" in done.stdout
    done = tiny.run_python(*begun, "--cases", "none")
    assert done.returncode == 2 and "error: cases: Input should be a valid integer" in done.stderr


def test_warnings_of_the_package_are_lines_on_stderr(capsys):
    def work() -> int:
        _log.warning("%s is odd", "this")
        return 0

    assert exit_status(work) == 0
    assert capsys.readouterr().err == "warning: this is odd\n"


def test_every_line_of_an_error_is_marked(capsys):
    def work() -> int:
        raise SettingsError("a: must be b, got c\nd: must be e, got f")

    assert exit_status(work) == 2
    assert capsys.readouterr().err == "error: a: must be b, got c\nerror: d: must be e, got f\n"


def test_public_names_are_listed_for_completion():
    assert {"Reorientation", "monte_carlo", "train", "__version__"} <= {*dir(koz_jax)}
    assert {*koz_jax.__all__} <= {*dir(koz_jax)}
    assert all(getattr(koz_jax, name) is not None for name in koz_jax.__all__)


WITHOUT_MATPLOTLIB = (
    "import sys; sys.modules['matplotlib'] = None; from koz_jax.cli.main import main; sys.exit(main({}))"
)


@pytest.mark.slow
@pytest.mark.parametrize("argv", [["evaluate", "--figures", "out"], ["curves", "{run}", "--out", "out"]])
def test_without_matplotlib_the_error_says_what_to_install(argv, tmp_path):
    run = metrics_log(tmp_path / "run")
    told = [word.format(run=run) for word in argv]
    done = tiny.run_python("-c", WITHOUT_MATPLOTLIB.format(told), cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("error: matplotlib: cannot be imported; install it with: pip install 'koz_jax[viz]'")
    assert len(done.stderr.splitlines()) == 1 and not (tmp_path / "out").exists()


def test_help_that_nobody_reads_ends_quietly():
    command = [sys.executable, "-m", "koz_jax", "--help"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=tiny.environment(), cwd=tiny.ROOT
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141
