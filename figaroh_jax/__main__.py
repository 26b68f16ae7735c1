"""`python -m figaroh_jax`: the same as the command `figaroh-jax`."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
