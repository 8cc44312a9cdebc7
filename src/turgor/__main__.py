"""`python -m turgor`: the command line."""

import sys

from turgor.cli import main

if __name__ == "__main__":
    sys.exit(main())
