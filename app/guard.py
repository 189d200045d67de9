"""Refuses pairs of Python and Qt that are known to crash or to draw nothing."""

from __future__ import annotations

INSTALL = 'pip install "PySide6-Essentials>=6.8,!=6.9.1,<6.12"'


def bad_pair(python: tuple[int, int], pyside: str) -> str | None:
    """Return one line on what is wrong with this pair, or None.

    6.12.0 loses reference counts of True and None on CPython before 3.12 and aborts; 6.9.1 draws
    no curves (pyqtgraph issue 3326).
    """
    broken = pyside == "6.9.1" or (pyside == "6.12.0" and python < (3, 12))
    if not broken:
        return None
    version = ".".join(map(str, python))
    return f"PySide6 {pyside} does not work with Python {version}. Install another: {INSTALL}"
