"""Command line of the window."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path


def parser() -> argparse.ArgumentParser:
    """Return the command-line arguments of the window. Does not import Qt."""
    made = argparse.ArgumentParser(prog="touchdown app", description="Open the window.")
    made.add_argument("--theme", choices=("dark", "light", "contrast", "system"),
                      help="start in this theme; system: as the desktop")  # fmt: skip
    made.add_argument("--page", choices=("operate", "collect", "train", "stack", "review"),
                      help="open with this workspace in front")  # fmt: skip
    made.add_argument("--bench", metavar="FILE", type=Path,
                      help="lab file, or settings of the simulated bench (TOML)")  # fmt: skip
    made.add_argument("--inject", metavar="FAULT", action="append", default=[],
                      help="fault of the simulated bench such as force_torque:stop@30, "
                      "in seconds of its clock")  # fmt: skip
    made.add_argument("--notify", metavar="COMMAND",
                      help="command that calls a person on a fault, on a question and at the end "
                      "of a run; its last arguments are a title and a text")  # fmt: skip
    made.add_argument("--live", nargs="?", const="127.0.0.1:8765", metavar="HOST:PORT",
                      help="serve streams and events to Foxglove (at 127.0.0.1:8765)")  # fmt: skip
    made.add_argument("--replay", metavar="RUN", type=Path, help="review this recorded run")
    made.add_argument("--reset-layout", action="store_true", help="forget the window settings")
    made.add_argument("--size", metavar="WxH", type=_size, help="size of the window, in pixels")
    made.add_argument("--grab", metavar="FILE.png", type=Path,
                      help="start a run, save a picture of the window and end")  # fmt: skip
    made.add_argument("--after", metavar="S", type=float, default=20.0,
                      help="with --grab: seconds to wait (20)")  # fmt: skip
    return made


INSTALL = 'pip install "touchdown[app]"'


def incompatibility(python: tuple[int, int], pyside: str) -> str | None:
    """Return an error for an incompatible pair of Python and PySide6, else None.

    6.12.0 loses reference counts of True and None on CPython before 3.12 and aborts; 6.9.1 draws no
    curves (pyqtgraph issue 3326).
    """
    broken = pyside == "6.9.1" or (pyside == "6.12.0" and python < (3, 12))
    if not broken:
        return None
    version = ".".join(map(str, python))
    return f"PySide6 {pyside} does not work with Python {version}. Install another: {INSTALL}"


def main(argv: Sequence[str] | None = None) -> int:
    """Open the window; return the exit status. Status 3: Qt is missing or cannot be used."""
    args = parser().parse_args(argv)
    if args.grab and not _display():
        os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
    if find_spec("PySide6") is None or find_spec("pyqtgraph") is None:
        wrong: str | None = f"The window needs Qt and pyqtgraph. Install them: {INSTALL}"
    else:
        import PySide6

        wrong = incompatibility(sys.version_info[:2], PySide6.__version__)
    if wrong is None and not _display() and "QT_QPA_PLATFORM" not in os.environ:
        wrong = "There is no display. Without one use 'make demo' or 'touchdown stack'."
    if wrong is not None:
        sys.stderr.write(f"touchdown: {wrong}\n")
        return 3
    from PySide6.QtWidgets import QApplication

    from touchdown.app.splash import Splash

    application = QApplication.instance() or QApplication(sys.argv[:1])
    assert isinstance(application, QApplication)
    application.setApplicationName("Touchdown")
    application.setDesktopFileName("touchdown")
    # Shown before the slow imports: seconds on a busy computer.
    splash = Splash()
    splash.tell("Loading the program")
    from touchdown.app.start import run

    return run(args, application, splash)


def _display() -> bool:
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError("write it as 1600x940") from None
    return width, height


if __name__ == "__main__":
    sys.exit(main())
