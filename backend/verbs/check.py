"""One finding of ``touchdown doctor``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Check:
    """What was looked at and found.

    ``ok`` is False only for what stops Touchdown from working; something optional that is absent
    is ``ok`` with a ``fix`` that says how to get it. ``fix`` is empty if there is nothing to do.
    """

    name: str
    ok: bool
    detail: str
    fix: str = ""

    @property
    def word(self) -> str:
        """OK, NOTE (optional thing absent) or FAIL."""
        if not self.ok:
            return "FAIL"
        return "NOTE" if self.fix else "OK"


Examine = Callable[[], Check]
