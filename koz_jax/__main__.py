"""``python -m koz_jax``: the same as the console command ``koz``."""

import sys

from koz_jax.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
