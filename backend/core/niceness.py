"""How far work in bulk steps back behind the bench and the operator beside it."""

from __future__ import annotations

import os

NICENESS = 10


def step_back() -> None:
    """Bring this process to ``NICENESS``; one that stands further back already stays there."""
    if os.name == "posix":
        os.nice(max(0, NICENESS - os.nice(0)))
