"""`python -m turgor.bench`, which does what `turgor bench` does."""

import sys

from turgor.bench import main

if __name__ == "__main__":
    sys.exit(main())
