"""The origin in the form: set where the arm is, checked by the edges, moved by what was found."""

from __future__ import annotations

from typing import cast

from app.collect.origin import OriginNote, residual_words
from app.link import Link
from backend.core.faults import StaleSampleError
from backend.devices.protocols import Arm
from widgets.target_panel import TargetPanel

AGE_S = 1.0
"""A pose that is older is not where the arm is."""


class OriginField:
    """x and y of the origin, and the note of the last check."""

    def __init__(self, target: TargetPanel) -> None:
        self._target = target
        self.note: OriginNote | None = None

    def show_note(self, note: OriginNote | None) -> None:
        """Show what the last check found."""
        self.note = note
        usable = note is not None and not note.used
        self._target.show_residual(residual_words(note), usable=usable)

    def take_residual(self) -> None:
        """Add the residual of the last check, once."""
        if self.note is not None and not self.note.used:
            x, y = self._target.origin
            x.setValue(x.value() + self.note.residual_mm[0])
            y.setValue(y.value() + self.note.residual_mm[1])
            self.show_note(self.note.taken())

    def set_here(self, link: Link | None) -> None:
        """Set it to where the arm is now: the operator jogged it over the centre of the bottom."""
        arm = None if link is None else link.devices.get("arm")
        if link is None or arm is None:
            return
        try:
            _, pose_mm = cast("Arm", arm).poses.latest(link.clock_s(), AGE_S)
        except StaleSampleError:
            return
        for field, value_mm in zip(self._target.origin, pose_mm.tolist(), strict=False):
            field.setValue(value_mm)
        self.show_note(None)
