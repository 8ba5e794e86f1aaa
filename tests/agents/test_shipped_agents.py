"""What the package ships must do what the README says, measured anew with a seed that no training used."""

import jax
import numpy as np
import pytest
from support import oracle

from koz_jax.agents.agent import load_agent
from koz_jax.agents.record import shipped_agents
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import TaskConfig
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases, rollout
from koz_jax.evaluation.summary import PAPER_TABLE, summarise
from koz_jax.task import scenario

CASES = MonteCarloConfig(cases=2000, seed=12)


@pytest.fixture(scope="module")
def phase2_summary():
    agent = load_agent("phase2")
    return summarise(cases.fly_cases(agent.controller, agent.task, CASES))


def test_the_shipped_agents_are_those_of_the_papers_spacecraft_one_for_several_zones_and_one_for_any_spacecraft():
    assert shipped_agents() == ("phase1", "phase2", "phase2-sac", "universal", "zones3")


@pytest.mark.parametrize(("name", "phase"), [("phase1", 1), ("phase2", 2), ("universal", 2)])
def test_an_agent_knows_where_it_comes_from(name, phase):
    provenance = load_agent(name).provenance
    assert provenance.command.startswith("python train.py")
    assert len(provenance.commit) == 40, "an agent is trained from a clean commit"
    assert provenance.table["cases"] == 10_000
    assert provenance.phase == phase


@pytest.mark.slow
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


ANY_SPACECRAFT = TaskConfig(spread=SpreadConfig(spacecraft=True, step_shares=(0.02, 0.05)))


@pytest.mark.slow
def test_the_agent_for_any_spacecraft_flies_random_ones_at_every_urgency():
    """More haste costs effort and saves time; success does not depend on it."""
    found = []
    for urgency in (0.0, 0.5, 1.0):
        agent = load_agent("universal").with_urgency(urgency)
        results = cases.fly_cases(agent.controller, ANY_SPACECRAFT, MonteCarloConfig(cases=200, seed=12))
        assert np.mean(results.success) >= 0.99
        found.append(summarise(results))
    times, efforts = ([getattr(one, f"{name}_mean") for one in found] for name in ("settling_time", "control_effort"))
    assert times == sorted(times, reverse=True) and efforts == sorted(efforts)
    assert times[0] > 1.3 * times[2] and efforts[2] > 3.0 * efforts[0]


@pytest.mark.slow
def test_the_agent_for_any_spacecraft_keeps_a_rate_limit():
    limited = TaskConfig.model_validate({"spacecraft": {"max_rate_deg": 5.0}})
    controller, config = load_agent("universal").controller, MonteCarloConfig(seed=12)
    drawn = cases.draw_case(TaskConfig(), config, 3)
    flown, free = (
        jax.jit(rollout.fly)(cases.environment(task, config), controller, drawn) for task in (limited, TaskConfig())
    )
    assert flown.pointing_error[-1] <= oracle.SETTLED and np.all(flown.zone_margin > 0.0)
    assert np.linalg.norm(flown.state.body.omega_BN_B, axis=1).max() < np.deg2rad(5.0) * 1.01
    assert np.linalg.norm(free.state.body.omega_BN_B, axis=1).max() > np.deg2rad(6.0)


@pytest.mark.slow
def test_an_urgency_is_refused_where_nobody_listens_and_where_it_is_none():
    with pytest.raises(SettingsError, match="urgency: phase2 was trained for one trade of time against effort; got"):
        load_agent("phase2").with_urgency(0.5)
    with pytest.raises(SettingsError, match=r"urgency: must be in \[0, 1\], got nan"):
        load_agent("universal").with_urgency(float("nan"))
