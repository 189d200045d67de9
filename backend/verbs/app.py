"""Open the window."""

from __future__ import annotations

import argparse
import importlib
from importlib.util import find_spec

from backend.core.faults import InputError
from backend.verbs.screen import Screen

NAME = "app"
HELP = "open the window"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.epilog = "All other arguments go to the window: see 'python -m app --help'."
    parser.set_defaults(handed_on=[])


def run(args: argparse.Namespace, screen: Screen) -> int:
    """Open the window and return its exit code."""
    return open_window(args.handed_on)


def open_window(arguments: list[str]) -> int:
    """Hand over to the window; returns its exit code, ``InputError`` if Qt is not installed."""
    if find_spec("PySide6") is None:
        raise InputError(
            "The window needs Qt, which is not installed.",
            "PySide6",
            "Run 'make setup', or work without a window: 'touchdown stack'.",
        )
    # The backend knows nothing of the window (import contract): this one door opens by name.
    window = importlib.import_module("app.__main__")
    return int(window.main(arguments))
