"""Register of measured figures and their targets.

Add a figure by writing a function in a module of this folder and naming the module in ``MODULES``
of ``run.py``::

    from tests.bench.registry import Figure, figure

    @figure("tracking")
    def tracker_speed() -> list[Figure]:
        return [Figure("tracker, median per frame", 0.8, "ms", "<= 1 (must 2)", ok=True)]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured figure. ``ok`` None: not measured here (``note`` says why)."""

    name: str
    value: float | str | None
    unit: str
    target: str
    ok: bool | None
    note: str = ""


Measure = Callable[[], list[Figure]]
REGISTER: dict[str, tuple[str, Measure]] = {}


def figure(group: str) -> Callable[[Measure], Measure]:
    """Register a function that measures one or more figures; ``group`` selects it by name."""

    def register(measure: Measure) -> Measure:
        if measure.__name__ in REGISTER:
            raise ValueError(f"two figures are called {measure.__name__}")
        REGISTER[measure.__name__] = (group, measure)
        return measure

    return register
