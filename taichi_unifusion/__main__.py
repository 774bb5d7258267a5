"""`python -m taichi_unifusion`: the same as `unifusion`."""

import sys

from .cli.start import main

if __name__ == "__main__":
    sys.exit(main())
