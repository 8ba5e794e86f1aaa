"""Everything that a run, a maneuver or a Monte Carlo produces, as figures for print (PNG and PDF) and as a short GIF.

The modules that draw need matplotlib (``pip install "koz_jax[viz]"``); ``geometry`` and the functions that compute what
is drawn do not.
"""
