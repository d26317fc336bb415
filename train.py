"""`python train.py ...` is `jprimfit train ...`."""

import sys

from jprimfit.apps.main import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
