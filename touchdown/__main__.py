"""The program ``touchdown``, also ``python -m touchdown VERB``."""

import os
import signal
import sys


def main() -> int:
    """Run the command line; Ctrl-C before it is imported ends the program with exit code 130."""
    usual = signal.getsignal(signal.SIGINT)
    if usual is signal.default_int_handler:
        # Nothing is open yet. An exception in an import could be replaced by another one.
        signal.signal(signal.SIGINT, lambda *_: os._exit(130))
    from touchdown.backend.cli import main as run

    signal.signal(signal.SIGINT, usual)
    return run()


if __name__ == "__main__":
    sys.exit(main())
