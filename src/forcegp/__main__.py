"""`python -m forcegp`: the same as the command `forcegp`."""

import sys

from forcegp.cli.main import main

sys.exit(main())
