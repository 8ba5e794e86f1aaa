"""Judge a controller by Monte Carlo: ``python eval_mc.py`` is ``koz evaluate``."""

import sys

from koz_jax.cli.evaluate import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
