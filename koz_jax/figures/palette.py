"""Colours of figures and of the 3-D page, by what they stand for.  Imports nothing.

Most are Okabe and Ito's: told apart also by readers who do not see all colours.
"""

BLACK = "#000000"
BLUE = "#0072B2"
SKY = "#56B4E9"
GREEN = "#009E73"
ORANGE = "#E69F00"
VERMILLION = "#D55E00"
PURPLE = "#CC79A7"
GREY = "#7F7F7F"

TRACE = BLACK  # of the boresight
TRACE_INSIDE = "#A50026"  # a zone
ZONE = VERMILLION
SHORTEST = BLUE
START = BLUE
TARGET = GREEN

SPHERE = "#C9D3DC"
GRID = "#9AA7B3"

# Curves of the three body axes, from dark to light, so that they differ also without colours.
BODY_AXES = (BLUE, VERMILLION, ORANGE)

# The axes themselves, in scenes where blue and vermillion stand for a path and a zone.
SCENE_AXES = {"x": ORANGE, "y": PURPLE, "z": SKY}
