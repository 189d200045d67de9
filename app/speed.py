"""The speed override in the frame: one share for every move in air, by hand and in runs."""

from __future__ import annotations

from collections.abc import Callable

from app.link import Link
from app.workspace import Command
from widgets.top_bar import TopBar

START_PERCENT = 10
"""With hardware, until the operator says otherwise."""
STEP_PERCENT = 10


class SpeedOverride:
    """Carries the choice of the top bar to the bench; ``say`` confirms it in the foot."""

    def __init__(self, bar: TopBar, say: Callable[[str], None]) -> None:
        self._bar, self._say = bar, say
        self._link: Link | None = None
        bar.override.valueChanged.connect(self._choose)
        self.commands = (
            Command("slower", "Slower: speed override down", "Ctrl+Alt+-", self._slower),
            Command("faster", "Faster: speed override up", "Ctrl+Alt++", self._faster),
        )

    def attach(self, link: Link) -> None:
        """Show the override of this bench; hardware starts slowly."""
        self._link = None
        if not link.simulated:
            link.interlock.override_speed(START_PERCENT / 100)
        self._bar.override.setValue(round(100 * link.interlock.override))
        self._link = link

    def _choose(self, percent: int) -> None:
        if self._link is not None:
            self._link.interlock.override_speed(percent / 100)
            self._say(f"Speed override {percent} %.")

    def _slower(self) -> None:
        self._bar.override.setValue(self._bar.override.value() - STEP_PERCENT)

    def _faster(self) -> None:
        self._bar.override.setValue(self._bar.override.value() + STEP_PERCENT)
