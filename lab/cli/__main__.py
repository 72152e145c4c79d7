"""`python -m lab.cli`: the same as `calibench`."""

import sys

from lab.cli import main

if __name__ == "__main__":
    sys.exit(main())
