"""A page of boresight traces: one sphere for each maneuver, with the way that each controller took."""

import itertools
import math
from collections.abc import Mapping
from typing import Literal

from koz_jax.evaluation.rollout import History
from koz_jax.figures import geometry, palette, sphere, style
from koz_jax.figures.style import Figure, Line2D

_COLUMNS = 3
_PIXELS = 400  # of each shaded sphere

_COLORS = (palette.BLACK, palette.BLUE, palette.GREEN, palette.ORANGE, palette.PURPLE, palette.SKY, palette.GREY)
Dash = Literal["solid", "dashed", "dotted"]
_DASHES: tuple[Dash, ...] = ("solid", "dashed", "dotted")

# Of every trace by its number: all colours solid, then all of them dashed.
_LOOKS: list[tuple[str, Dash]] = [(color, dash) for dash in _DASHES for color in _COLORS]


@style.look()
def draw(flown: Mapping[str, Mapping[str, History]], title: str = "") -> Figure:
    """Draw the traces.  flown: histories by maneuver and by who flew; zones are drawn as they are at the start."""
    rows = math.ceil(len(flown) / _COLUMNS)
    figure = style.new_figure(3.1 * _COLUMNS, 3.2 * rows + 1.2)
    panels = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    everybody = list(dict.fromkeys(itertools.chain.from_iterable(flown.values())))
    looks = dict(zip(everybody, itertools.cycle(_LOOKS), strict=False))
    for axes in panels:
        axes.set_axis_off()
    for axes, (case, histories) in zip(panels, flown.items(), strict=False):
        axes.set_title(case)
        scene = geometry.sphere_traces(next(iter(histories.values())))
        sphere.draw_scene(axes, scene, _PIXELS)
        for by, history in histories.items():
            trace_N = geometry.boresight_trace(history)
            front, back = geometry.front_and_back(scene.view.project(trace_N))
            color, dash = looks[by]
            axes.plot(*back.T, color=color, linewidth=0.6, alpha=0.4, linestyle=dash, zorder=3)
            axes.plot(*front.T, color=color, linewidth=1.3, linestyle=dash, zorder=4)
        sphere.mark(axes, scene.view, scene.trace_N[0], "x", palette.START, "start")
    handles = [Line2D([], [], color=color, linestyle=dash, label=by) for by, (color, dash) in looks.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, handlelength=2.8)
    figure.suptitle(title)
    return figure
