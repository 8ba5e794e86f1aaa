"""Fly one maneuver and draw it: ``python fly.py`` is ``koz fly``."""

import sys

from koz_jax.cli.fly import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
