"""`python -m pmdc_jax`, the same as `pmdc`."""

from .cli import main

if __name__ == "__main__":
    main()
