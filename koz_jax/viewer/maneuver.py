"""What the page shows: flown maneuvers, brought to common frames."""

import dataclasses
import math

import numpy as np

from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.base import TaskController
from koz_jax.evaluation import cases
from koz_jax.evaluation.rollout import CaseResult, History
from koz_jax.figures import geometry
from koz_jax.task.scenario import Scenario

# Smooth to the eye; more would only make the file larger.
_FRAME_SECONDS = 0.1
_MAX_FRAMES = 500

# How much of the quiet after the last maneuver has settled is shown [s].
_REST_SECONDS = 5.0


@dataclasses.dataclass(frozen=True)
class Maneuver:
    """One scenario as one controller flew it."""

    label: str
    task: TaskConfig
    history: History
    result: CaseResult

    @property
    def steps(self) -> int:
        """Time steps of the maneuver."""
        return len(self.history.zone_margin) - 1

    @property
    def seconds(self) -> float:
        """Length of the maneuver [s]."""
        return self.steps * self.task.step_seconds


@dataclasses.dataclass(frozen=True)
class Clock:
    """The frames of a page: frame i shows the instant i * seconds, the same for all maneuvers."""

    seconds: float  # [s] between frames
    frames: int

    @property
    def times(self) -> np.ndarray:
        """(frames,) [s]."""
        return self.seconds * np.arange(self.frames)


@dataclasses.dataclass(frozen=True)
class Frames:
    """One maneuver at the instants of a ``Clock``; leading axis: frames."""

    seconds: np.ndarray  # (frames,) [s] since the start
    q_BN: np.ndarray  # (frames, 4)
    boresight_N: np.ndarray  # (frames, 3)
    torque_B: np.ndarray  # (frames, 3) [N m]
    margin_deg: np.ndarray  # (frames,) to the nearest zone
    phi_deg: np.ndarray  # (frames,)


def fly(
    agent: TaskController,
    drawn: Scenario,
    label: str | None = None,
    *,
    task: TaskConfig | None = None,
    config: MonteCarloConfig | None = None,
    case: int = 0,
) -> Maneuver:
    """Fly one scenario with an agent or another controller.

    Args:
        agent: who flies.
        drawn: the maneuver.
        label: what to call it on the page; by default the agent's name.
        task: what is flown; by default what the agent was made for.
        config: under what conditions, such as the shield.
        case: index of the case whose random numbers are used.
    """
    flown = task or agent.task
    history, result = cases.fly_scenario(agent, drawn, flown, config, case)
    return Maneuver(label or agent.name, flown, history, result)


def same_spacecraft(maneuvers: list[Maneuver]) -> bool:
    """Whether all maneuvers are of one spacecraft; otherwise they compare nothing."""
    return all(maneuver.task.spacecraft == maneuvers[0].task.spacecraft for maneuver in maneuvers)


def clock(maneuvers: list[Maneuver], seconds: float | None = None) -> Clock:
    """Choose the frames of a page.

    seconds: how much of the maneuvers to show [s]; by default until soon after the last one has settled, and
    everything where one does not.
    """
    longest = max(maneuver.seconds for maneuver in maneuvers)
    if seconds is None:
        settling = [float(maneuver.result.settling_time) for maneuver in maneuvers]
        all_settled = all(math.isfinite(time) for time in settling)
        seconds = _REST_SECONDS * math.ceil(max(settling) / _REST_SECONDS + 1.0) if all_settled else longest
    shown = min(seconds, longest)
    step = min(maneuver.task.step_seconds for maneuver in maneuvers)
    # A whole number of steps apart; the tolerance keeps 0.1 s / 0.1 s from counting as more than one.
    stride = max(1, math.ceil(max(_FRAME_SECONDS, shown / _MAX_FRAMES) / step - 1e-6))
    return Clock(stride * step, math.ceil(shown / (stride * step) - 1e-6) + 1)


def frames(maneuver: Maneuver, at: Clock) -> Frames:
    """Take the instants of the clock; a maneuver that is over stays as it ended.

    Between its own steps the attitude and the torque are those of the step before, angles are interpolated.
    """
    steps = np.minimum(at.times / maneuver.task.step_seconds, maneuver.steps)
    instants = np.floor(steps + 1e-6).astype(int)
    history = maneuver.history

    def interpolated_deg(angles: np.ndarray) -> np.ndarray:
        return np.interp(steps, np.arange(maneuver.steps + 1), np.rad2deg(angles))

    return Frames(
        seconds=np.minimum(at.times, maneuver.seconds),
        q_BN=np.asarray(history.state.body.q_BN)[instants],
        boresight_N=geometry.boresight_trace(history)[instants],
        torque_B=np.asarray(history.torque_B)[instants],
        margin_deg=interpolated_deg(np.asarray(history.zone_margin)),
        phi_deg=interpolated_deg(np.asarray(history.pointing_error)),
    )
