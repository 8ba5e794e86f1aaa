"""Train an agent: ``python train.py`` is ``koz train``."""

import sys

from koz_jax.cli.train import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
