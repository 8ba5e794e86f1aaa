"""What is drawn in tests: a maneuver, outcomes of cases, the log of a run."""

import csv
import functools
from pathlib import Path
from typing import Any

import jax
import numpy as np

from koz_jax.agents.agent import load_agent
from koz_jax.config.task import TaskConfig
from koz_jax.evaluation import cases
from koz_jax.evaluation.rollout import CaseResult, History
from koz_jax.figures import learning
from koz_jax.task import reward, scenario
from support import tiny


@functools.cache
def flown(agent: str = "") -> tuple[History, CaseResult, TaskConfig]:
    """The paper's test scenario, flown by a shipped agent, or for 2 s by one that nobody trained."""
    flying = load_agent(agent) if agent else tiny.untrained_agent()
    return *cases.fly_scenario(flying, scenario.paper_test()), flying.task


def outcomes(count: int, seed: int = 0) -> CaseResult:
    """Random outcomes in all verdicts, also settled nowhere and violated."""
    draw = np.random.default_rng(seed)
    settled, violated = draw.uniform(size=count) > 0.1, draw.uniform(size=count) < 0.1
    terms = [draw.normal(size=count) for _ in reward.PAPER_WEIGHTS.__dataclass_fields__]
    leaves: dict[str, Any] = {
        "initial_angle": draw.uniform(1.4, 3.1, count),
        "reward_terms": jax.tree.unflatten(jax.tree.structure(reward.PAPER_WEIGHTS), terms),
        "settling_time": np.where(settled, draw.normal(25.0, 4.0, count), np.nan),
        "control_effort": draw.gamma(9.0, 8.0, count),
        "control_accuracy": np.where(settled, 1e-3, 1.0) * draw.uniform(size=count),
        "min_margin": np.where(violated, -0.1, 0.1),
        "settled": settled,
        "violated": violated,
        **tiny.unshielded(len(settled)),
    }
    return CaseResult(**leaves)


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between unit vectors (..., 3), in double precision."""
    return np.rad2deg(2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def metrics_log(
    folder: Path, factor: float = 1.0, updates: tuple[int, ...] = (10, 20, 30, 40), refined: int = 2
) -> Path:
    """A run folder with a log: two updates out of four in phase 1, then iterations of refinement."""
    folder.mkdir()
    rows = [
        dict(zip(learning.COLUMNS, [n, 1 + (i >= 1), "", *[factor * (i + 1)] * 6], strict=True))
        for i, n in enumerate(updates)
    ]
    rows += [
        dict(zip(learning.COLUMNS, [updates[-1] + n + 1, "", 8.5, *[factor * 9] * 6], strict=True))
        for n in range(refined)
    ]
    with open(folder / "metrics.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, learning.COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return folder
