"""The command line as a module: ``python -m touchdown VERB``."""

import sys

from touchdown.backend.cli import main

if __name__ == "__main__":
    sys.exit(main())
