"""Interactive 3-D replay of maneuvers as one HTML file that opens offline.

``python -m koz_jax.replay`` is the command; from Python::

    from koz_jax.replay.maneuver import fly
    from koz_jax.replay.page import write_replay

    flown = [fly(load_agent(name), scenario.paper_test()) for name in ("phase1", "phase2")]
    write_replay(Path("replay.html"), flown, "the paper's scenario")
"""
