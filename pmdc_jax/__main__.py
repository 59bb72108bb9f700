"""`python -m pmdc_jax`, the same as `pmdc`."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
