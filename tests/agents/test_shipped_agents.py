"""What the package ships must do what the README says, measured anew with a seed that no training used."""

import numpy as np
import pytest

from koz_jax.agents.agent import load_agent
from koz_jax.agents.record import shipped_agents
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.evaluation import cases
from koz_jax.evaluation.summary import PAPER_TABLE, summarise
from koz_jax.task import scenario

CASES = MonteCarloConfig(cases=2000, seed=12)


@pytest.fixture(scope="module")
def phase2_summary():
    agent = load_agent("phase2")
    return summarise(cases.fly_cases(agent.controller, agent.task, CASES))


def test_the_shipped_agents_are_the_two_phases_phase_2_before_refinement_and_one_for_several_zones():
    assert shipped_agents() == ("phase1", "phase2", "phase2-sac", "zones3")


@pytest.mark.parametrize("name", ["phase1", "phase2"])
def test_an_agent_knows_where_it_comes_from(name):
    provenance = load_agent(name).provenance
    assert provenance.command.startswith("python train.py")
    assert len(provenance.commit) == 40, "an agent is trained from a clean commit"
    assert provenance.table["cases"] == 10_000
    assert provenance.phase == int(name[-1])


def test_phase_1_flies_through_the_zone_of_the_papers_scenario_and_phase_2_around_it():
    _, through = cases.fly_scenario(load_agent("phase1"), scenario.paper_test())
    _, around = cases.fly_scenario(load_agent("phase2"), scenario.paper_test(), config=MonteCarloConfig(substeps=4))
    assert through.settled and through.violated
    assert around.settled and not around.violated


@pytest.mark.slow
def test_phase_2_beats_every_row_of_the_papers_table(phase2_summary):
    ours, paper = phase2_summary, PAPER_TABLE
    assert ours.mean_reward > paper.mean_reward
    assert ours.settling_time_mean < paper.settling_time_mean
    assert ours.control_effort_mean < paper.control_effort_mean
    assert ours.control_accuracy_deg_mean < paper.control_accuracy_deg_mean
    assert ours.non_settled_rate < paper.non_settled_rate
    assert ours.violation_rate < paper.violation_rate
    assert ours.success_rate > paper.success_rate


@pytest.mark.slow
def test_phase_2_reproduces_its_own_table(phase2_summary):
    table = load_agent("phase2").provenance.table
    # Standard errors of the means: 2,000 cases here, 10,000 there.
    for mean in ("settling_time", "control_effort", "control_accuracy_deg"):
        error = float(table[f"{mean}_std"]) * np.sqrt(1 / CASES.cases + 1 / 10_000)
        assert abs(getattr(phase2_summary, f"{mean}_mean") - float(table[f"{mean}_mean"])) < 5 * error
    assert phase2_summary.success_rate >= float(table["success_rate"]) - 0.004


@pytest.mark.slow
def test_the_agent_for_several_zones_flies_around_three_of_them():
    agent = load_agent("zones3")
    task = agent.task.with_rules(zones=3)
    found = summarise(cases.fly_cases(agent.controller, task, CASES))
    assert found.success_rate >= 0.97
    assert found.violation_rate <= 0.005
