"""Runs that only refine an agent that there is already."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny
from support.tiny import CONFIG

from koz_jax.agents.agent import load_agent
from koz_jax.config.presets.named import preset
from koz_jax.config.training import TrainConfig
from koz_jax.errors import SettingsError
from koz_jax.learning import curriculum
from koz_jax.runs import stages
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.trainer import train

ALONE = tiny.changed({"curriculum": {"phase1": {"updates": 0}, "phase2": {"updates": 0}}})


def _leaves(folder) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(load_agent(folder).controller.policy)]


@pytest.mark.slow
def test_the_agent_is_refined_and_what_is_not_better_is_not_kept(run, tmp_path):
    source = run.agent("phase2-sac")
    agent = train(ALONE, tmp_path / "run", start_from=source, progress=False)
    assert agent is not None
    assert agent.provenance.updates == 0 and agent.provenance.refinements_tried == CONFIG.refine.iterations
    refined = [np.asarray(leaf) for leaf in jax.tree.leaves(agent.controller.policy)]
    same = all(np.array_equal(one, two) for one, two in zip(refined, _leaves(source), strict=True))
    assert same == (agent.provenance.refinements == 0)
    # At a learning rate of nearly nothing no agent is better than the one that it began with by more than rounding.
    still = ALONE.refine.model_copy(update={"learning_rate": 1e-30})
    config = TrainConfig.model_validate(ALONE.model_copy(update={"refine": still}).model_dump())
    kept = train(config, tmp_path / "still", start_from=source, progress=False)
    assert kept is not None and kept.provenance.refinements == 0
    for one, two in zip(jax.tree.leaves(kept.controller.policy), _leaves(source), strict=True):
        np.testing.assert_array_equal(one, two)


@pytest.mark.slow
def test_it_goes_on_to_the_same_bits(run, tmp_path):
    folders = [RunFolder(tmp_path / name) for name in ("whole", "stopped")]
    for folder in folders:
        train(ALONE, folder.path, start_from=run.agent("phase2-sac"), progress=False)
    lost = folders[1].checkpoints()[0]
    lost.rename(tmp_path / "lost")
    train(ALONE, folders[1].path, resume=True, progress=False)
    for one, two in zip(*(_leaves(folder.path) for folder in folders), strict=True):
        np.testing.assert_array_equal(one, two)


def test_the_best_is_chosen_by_the_weights_at_the_end_of_the_curriculum():
    whole = preset("fast")
    alone = whole.model_dump()
    for phase in alone["curriculum"].values():
        phase["updates"] = 0
    weights = []
    for config in (whole, TrainConfig.model_validate(alone)):
        last = stages.plan(config)[-1]
        at = curriculum.difficulty(config.curriculum, jnp.int32(last.rewarded_as_at))
        weights.append(curriculum.reward_weights(at))
    for one, two in zip(*map(jax.tree.leaves, weights), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-4)


def test_without_an_agent_or_with_another_network_there_is_nothing_to_refine(run, tmp_path):
    with pytest.raises(SettingsError, match="start_from: must name an agent where curriculum has no updates, got none"):
        train(ALONE, tmp_path / "run", progress=False)
    with pytest.raises(SettingsError, match="start_from: network must be that of phase2"):
        train(ALONE, tmp_path / "run", start_from="phase2", progress=False)
    with pytest.raises(SettingsError, match="nowhere"):
        train(ALONE, tmp_path / "run", start_from=tmp_path / "nowhere", progress=False)
    assert list(tmp_path.iterdir()) == []
