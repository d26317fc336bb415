"""`python evaluate.py ...` is `jprimfit evaluate ...`."""

import sys

from jprimfit.apps.main import main

if __name__ == "__main__":
    sys.exit(main(["evaluate", *sys.argv[1:]]))
