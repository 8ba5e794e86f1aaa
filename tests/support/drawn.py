"""What is drawn in tests: a maneuver, outcomes of cases, the log of a run."""

import csv
import functools
import itertools
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from koz_jax.agents.agent import load_agent
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.registry import load_controller
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


CUBESAT = TaskConfig.model_validate(
    {
        "spacecraft": {
            "inertia": ((0.05, 0.0, 0.0), (0.0, 0.06, 0.0), (0.0, 0.0, 0.02)),
            "torque_limit": 0.004,
            "boresight": (0.0, 0.0, 1.0),
        },
        "scenario": {"min_zones": 3, "max_zones": 3},
        "step_seconds": 0.2,
    }
)


@functools.cache
def flown_cubesat() -> tuple[History, CaseResult, TaskConfig]:
    """A case with three zones, flown by a 6U CubeSat."""
    drawn = cases.draw_case(CUBESAT, MonteCarloConfig(), 3)
    return *cases.fly_scenario(load_controller("pd", CUBESAT), drawn), CUBESAT


def crowded_labels(figure: Figure) -> list[tuple[str, str]]:
    """Pairs of tick labels of a figure that touch, or nearly so."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    boxes = []
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            labels = [tick.label1 for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
            labels += [axis.get_offset_text()]
            shown = [label for label in labels if label.get_visible() and label.get_text()]
            boxes += [(label.get_text(), label.get_window_extent(renderer).padded(1.0)) for label in shown]
    assert boxes
    return [(one, other) for (one, a), (other, b) in itertools.combinations(boxes, 2) if a.overlaps(b)]


def outcomes(count: int, seed: int = 0, all_settle: bool = False, effort: float = 1.0) -> CaseResult:
    """Random outcomes in all verdicts, also settled nowhere and violated.  effort: factor to a large spacecraft's."""
    draw = np.random.default_rng(seed)
    settled, violated = draw.uniform(size=count) > 0.1, draw.uniform(size=count) < 0.1
    settled |= all_settle
    terms = [draw.normal(size=count) for _ in reward.PAPER_WEIGHTS.__dataclass_fields__]
    leaves: dict[str, Any] = {
        "initial_angle": draw.uniform(1.4, 3.1, count),
        "reward_terms": jax.tree.unflatten(jax.tree.structure(reward.PAPER_WEIGHTS), terms),
        "settling_time": np.where(settled, draw.normal(25.0, 4.0, count), np.nan),
        "control_effort": effort * draw.gamma(9.0, 8.0, count),
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
