"""The page: figures, the plotly library and a little script in one HTML file."""

import html
import importlib.resources
import json
import string
from pathlib import Path
from typing import Any

import numpy as np

from koz_jax.errors import SettingsError, missing_extra
from koz_jax.figures import geometry, wording
from koz_jax.storage import files
from koz_jax.viewer.maneuver import Clock, Frames, Maneuver, clock, frames, same_spacecraft
from koz_jax.viewer.scene import scene
from koz_jax.viewer.timeline import timelines

# Browsers draw no more 3-D scenes on one page, and the file stays small.
MOST = 8


def write_page(path: Path, maneuvers: list[Maneuver], title: str, seconds: float | None = None) -> None:
    """Write maneuvers, side by side, as one HTML file that needs no network.

    seconds: how much of them to show [s]; by default until soon after the last one has settled.
    """
    files.write_text(path, render(maneuvers, title, seconds))


def render(maneuvers: list[Maneuver], title: str, seconds: float | None = None) -> str:
    """Make the page that ``write_page`` writes."""
    check_count("maneuvers", len(maneuvers))
    at = clock(maneuvers, seconds)
    content = json.dumps(_content(maneuvers, at), allow_nan=False, separators=(",", ":"))
    return string.Template(_part("page.html")).substitute(
        title=html.escape(title),
        subtitle=html.escape(describe(maneuvers, at)),
        caution=html.escape(caution(maneuvers)),
        style=_part("page.css"),
        library=plotly_library(),
        # No text inside the data can end the element that holds it.
        content=content.replace("<", "\\u003c"),
        script=_part("page.js"),
    )


def check_count(name: str, count: int) -> None:
    """Refuse a page of no maneuver, or of too many.

    Raises:
        SettingsError: it is one; the message begins with ``name``, the setting that gave the count.

    """
    if not 1 <= count <= MOST:
        raise SettingsError(f"{name}: one page shows 1 to {MOST}, got {count}")


def plotly_library() -> str:
    """The source of plotly.js, from the installed package.

    Raises:
        MissingExtraError: plotly is not installed.

    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise missing_extra(error, "plotly", "viz") from None
    return get_plotlyjs()


def describe(maneuvers: list[Maneuver], at: Clock) -> str:
    """Tell in one line what is flown, and how much of it is shown."""
    first = maneuvers[0]
    parts = [f"{np.rad2deg(float(first.result.initial_angle)):.1f}° from the target"]
    zones = geometry.zones(first.history)
    named = zip(geometry.zone_names(zones), zones, strict=True)
    parts += [f"{name}, {zone.size}" for name, zone in named]
    longest = max(maneuver.seconds for maneuver in maneuvers)
    if longest > at.times[-1] + 1e-6:
        parts.append(f"the first {at.times[-1]:g} s of {longest:g} s")
    return ", ".join(parts)


def caution(maneuvers: list[Maneuver]) -> str:
    """Tell what maneuvers side by side do not compare; empty where they do."""
    if same_spacecraft(maneuvers):
        return ""
    others = [flown.label for flown in maneuvers if not _has_own_telescope(flown)]
    borrowed = f"; the scenario's telescope is not that of {', '.join(map(wording.short_name, others))}" * bool(others)
    return f"These spacecraft differ, so the maneuvers compare nothing: each has scales of its own{borrowed}."


def _has_own_telescope(flown: Maneuver) -> bool:
    return np.allclose(geometry.boresight(flown.history), flown.task.spacecraft.boresight, atol=1e-5)


def _part(name: str) -> str:
    return (importlib.resources.files("koz_jax.viewer") / name).read_text(encoding="utf-8")


def _content(maneuvers: list[Maneuver], at: Clock) -> dict[str, Any]:
    shown = [frames(maneuver, at) for maneuver in maneuvers]
    plots = timelines(maneuvers, shown, at)
    return {
        "frameSeconds": at.seconds,
        "frames": at.frames,
        "maneuvers": [_maneuver(*each) for each in zip(maneuvers, shown, plots, strict=True)],
    }


def _maneuver(flown: Maneuver, shown: Frames, timeline: dict[str, Any]) -> dict[str, Any]:
    return {
        "label": wording.short_name(flown.label),
        "verdicts": _verdicts(flown),
        "scene": scene(flown, shown),
        "timeline": timeline,
        "torqueUnit": wording.torque_unit(flown.task.spacecraft.torque_limits).name,
    }


def _verdicts(flown: Maneuver) -> list[dict[str, Any]]:
    """What the maneuver comes to, over its whole length: a text each, and whether it is good."""
    result = flown.result
    found = []
    if result.settled:
        found.append({"text": f"settled after {float(result.settling_time):.1f} s", "good": True})
    else:
        found.append({"text": f"not settled within {flown.seconds:g} s", "good": False})
    if geometry.zones(flown.history):
        smallest = f"smallest margin {np.rad2deg(float(result.min_margin)):.1f}°"
        clear = not bool(result.violated)
        found.append({"text": f"{'clear of' if clear else 'looked into'} the zone, {smallest}", "good": clear})
    effort = float(result.control_effort)
    found.append({"text": f"effort {wording.effort_unit(effort)(effort)}", "good": None})
    return found
