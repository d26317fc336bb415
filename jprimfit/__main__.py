"""`python -m jprimfit` is the command `jprimfit`."""

import sys

from jprimfit.apps.main import main

if __name__ == "__main__":
    sys.exit(main())
