"""`python -m benchmarks.paper FIGURE ...` is `forcegp reproduce FIGURE ...`."""

import sys

from forcegp.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["reproduce", *sys.argv[1:]]))
