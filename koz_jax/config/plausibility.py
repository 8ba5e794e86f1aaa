"""Whether the numbers of a task fit together: wrong units are told before anything is computed.  Imports no jax."""

from __future__ import annotations

import logging
import math
from typing import NamedTuple

from koz_jax.config.actuators.agility import Agility, agilities, rate_at_start, senseless_momenta
from koz_jax.config.task import TaskConfig
from koz_jax.config.training import TrainConfig
from koz_jax.errors import SettingsError

# [rad] Turn within a single step, from rest by full torque, above which a held torque can no longer steer.
MAX_TURN_PER_STEP = 1.0

_log = logging.getLogger(__name__)


class Finding(NamedTuple):
    """Something that is wrong with a task."""

    text: str  # names the setting and the number
    hopeless: bool  # nothing can be learned; otherwise it is only suspicious


def findings(task: TaskConfig, min_angle_deg: float, max_angle_deg: float) -> list[Finding]:
    """Find what cannot be, or can hardly be meant.  min_angle_deg, max_angle_deg: initial deviations that are drawn."""
    slowest, *_, quickest = agilities(task.spacecraft)
    found = []
    for agility, angle_deg, hopeless in ((quickest, min_angle_deg, True), (slowest, max_angle_deg, False)):
        least = agility.turn_seconds(angle_deg)
        if least > task.episode_seconds:
            found.append(
                Finding(
                    f"task.spacecraft: a turn by {angle_deg:g} deg takes {least:.3g} s or more ({agility}), and"
                    f" episode_seconds is {task.episode_seconds:g}; are the units kg m^2 and N m?",
                    hopeless,
                )
            )
            break
    found += _too_slow(task, slowest, max_angle_deg) if not found else []
    per_step = quickest.acceleration * task.step_seconds**2
    if per_step > MAX_TURN_PER_STEP:
        found.append(
            Finding(
                f"task.spacecraft: full torque over one step of {task.step_seconds:g} s gives a turn of {per_step:.3g}"
                f" rad a step ({quickest}), too much to steer; are the units kg m^2 and N m? A shorter step_seconds"
                " helps",
                False,
            )
        )
    found += [Finding(f"task.spacecraft.{text}", False) for text in senseless_momenta(task.spacecraft)]
    return [*found, *_undrawn(task, max_angle_deg)]


def _too_slow(task: TaskConfig, slowest: Agility, angle_deg: float) -> list[Finding]:
    """A turn that takes too long at the largest rate; not all controllers keep one, so something can be learned."""
    rate = rate_at_start(task.spacecraft)
    least = slowest.turn_seconds(angle_deg, rate)
    if least <= task.episode_seconds:
        return []
    what = "max_rate_deg" if task.spacecraft.max_rate_deg is not None else "what its actuators can stop"
    return [
        Finding(
            f"task.spacecraft: a turn by {angle_deg:g} deg takes {least:.3g} s or more at {math.degrees(rate):.3g}"
            f" deg/s, the largest rate ({what}), and episode_seconds is {task.episode_seconds:g}",
            False,
        )
    ]


def _undrawn(task: TaskConfig, max_angle_deg: float) -> list[Finding]:
    """Half angles that are asked for and cannot be drawn: the zone is between start and target, and holds neither."""
    asked, separation = task.scenario.max_half_angle_deg, task.scenario.separation_deg
    largest = 0.5 * max_angle_deg - separation
    if asked <= largest:
        return []
    return [
        Finding(
            f"task.scenario.max_half_angle_deg: is never drawn above {max(largest, 0.0):g} deg, since a zone keeps"
            f" {separation:g} deg from start and target, which are at most {max_angle_deg:g} deg apart; got {asked:g}",
            asked > 90.0 - separation,
        )
    ]


def check(task: TaskConfig, min_angle_deg: float, max_angle_deg: float) -> None:
    """Refuse a task of which nothing can be learned, and warn of what is suspicious.

    Raises:
        SettingsError: it is hopeless; the message has the number.

    """
    found = findings(task, min_angle_deg, max_angle_deg)
    hopeless = [finding.text for finding in found if finding.hopeless]
    if hopeless:
        raise SettingsError("\n".join(hopeless))
    for finding in found:
        _log.warning("%s", finding.text)


def check_training(config: TrainConfig) -> None:
    """Refuse a training of which nothing can come, and warn of what is suspicious.

    Raises:
        SettingsError: the task is hopeless; the message has the number.

    """
    check(config.task, config.eval_min_angle_deg, config.eval_max_angle_deg)
    slowest = agilities(config.task.spacecraft)[0]
    least = slowest.turn_seconds(config.eval_max_angle_deg)
    lengths = {"training_episode_seconds": config.training_episode_seconds}
    if config.refine.iterations:
        lengths["refine.horizon_seconds"] = config.refine.horizon_seconds
    for name, seconds in lengths.items():
        if seconds < least <= config.task.episode_seconds:
            _log.warning(
                "%s: is %g s, and a turn by %g deg takes %.3g s or more (%s); it should be longer",
                *(name, seconds, config.eval_max_angle_deg, least, slowest),
            )
