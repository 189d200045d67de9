"""Start of the application bundle: the command line; without arguments, the window.

Child processes of Touchdown start with ``-m MODULE`` or ``-c CODE``, as of an interpreter.
"""

import multiprocessing
import runpy
import sys


def main() -> int:
    """Run what the arguments name; return the exit code."""
    words = sys.argv[1:]
    if len(words) > 1 and words[0] == "-m":
        sys.argv = words[1:]
        runpy.run_module(words[1], run_name="__main__", alter_sys=True)
        return 0
    if len(words) > 1 and words[0] == "-c":
        sys.argv = ["-c", *words[2:]]
        exec(words[1], {"__name__": "__main__"})  # noqa: S102
        return 0
    from touchdown.__main__ import main as program

    sys.argv[1:] = words or ["app"]
    return program()


if __name__ == "__main__":
    multiprocessing.freeze_support()
    sys.exit(main())
