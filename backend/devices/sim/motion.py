"""A press in progress on the simulated arm."""

from __future__ import annotations

from collections.abc import Mapping

from backend.devices.motion import CommandedMotion
from backend.simulation.arm import Press


class SimPressMotion(CommandedMotion):
    """A press with its contact times."""

    def __init__(self, sent: Mapping[str, float], press: Press) -> None:
        super().__init__(sent)
        self._press = press

    @property
    def detected_s(self) -> float | None:
        """When contact was declared."""
        return self._press.detected_s

    @property
    def onset_s(self) -> float | None:
        """Back-dated time of first contact."""
        return self._press.onset_s
