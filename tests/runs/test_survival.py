"""Damage and nonsense at random: named or survived.  ``benchmarks/survival.py`` does the same in earnest."""

import shutil

import pytest
from support import bad_settings, corruption, tiny

from koz_jax.runs.folder import RunFolder


@pytest.mark.slow
def test_random_damage_is_named_or_survived(tmp_path):
    shutil.copytree(tiny.finished_run().path, tmp_path / "run")
    text, sound = corruption.corruptions(40, RunFolder(tmp_path / "run"), tiny.CONFIG, tmp_path)
    assert sound, text


@pytest.mark.slow
def test_generated_command_lines_are_refused_by_name_or_accepted(tmp_path):
    tried = bad_settings.refusals(25, tmp_path)
    assert tried.sound, tried.text
