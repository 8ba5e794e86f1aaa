"""Environments in processes of their own: they fly, or are refused at once; they never wait for ever."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")

TOGETHER = """
import gymnasium, sys, warnings
import koz_jax.adapters.gym_env
warnings.simplefilter("ignore")
if sys.argv[1] == "after":
    import jax.numpy as jnp
    jnp.zeros(3).block_until_ready()
envs = gymnasium.make_vec("koz_jax/Reorientation-v0", num_envs=2, vectorization_mode="async")
try:
    seen, _ = envs.reset(seed=0)
    alone = gymnasium.make("koz_jax/Reorientation-v0")
    print(all((alone.reset(seed=i)[0] == seen[i]).all() for i in range(2)))
    envs.close()
except Exception as error:
    print(type(error).__name__, str(error), sep=": ")
"""

ALONE = """
import multiprocessing, os
from koz_jax.errors import SettingsError
import jax.numpy as jnp
from koz_jax.adapters.sb3_env import ReorientationVecEnv
from koz_jax.adapters.brax_env import ReorientationEnv
begun = ReorientationVecEnv(3)
begun.reset()
def flies():
    for use in (lambda: ReorientationVecEnv(3).reset(), ReorientationEnv, lambda: begun.step([[0.0] * 3] * 3)):
        try: use()
        except SettingsError as error: print("spawn" in str(error), flush=True)
child = multiprocessing.get_context("fork").Process(target=flies)
child.start()
child.join(60)
print("hangs" if child.is_alive() else "ended")
child.kill()
"""


def said(code: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    return done.stdout.strip() or done.stderr


@pytest.mark.slow
def test_processes_that_are_forked_before_jax_begins_fly_as_any_other():
    assert said(TOGETHER, "before") == "True"


@pytest.mark.slow
def test_processes_that_are_forked_later_are_refused_in_one_line_that_names_spawn():
    line = said(TOGETHER, "after")
    assert line.startswith("SettingsError: processes: must be spawned, not forked"), line
    assert 'vector_kwargs={"context": "spawn"}' in line and "\n" not in line


@pytest.mark.slow
def test_every_adapter_is_refused_in_a_fork():
    assert said(ALONE).split() == ["True"] * 3 + ["ended"]
