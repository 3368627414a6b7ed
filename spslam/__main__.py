"""`python -m spslam`: the `spslam` command."""

import sys

from spslam.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
