"""Presenter of the side view: commanded arm, grip width, and the fall after a release."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from app.link import Link
from backend.core.facts import Fact, Released, RunStarted, TrialStarted
from backend.core.faults import InputError, StaleSampleError
from backend.core.flow import Fall, FloatArray
from backend.devices.protocols import Arm, Device, Gripper
from backend.objects.catalogue import Piece
from widgets.panel import Panel
from widgets.side_view import SideBody, SideScene, SideView

EVERY = 2
"""Drawn on every second tick: 15 pictures a second are smooth for an arm."""


class SidePresenter:
    """Follows the arm; after a release the piece stays or falls where it was let go."""

    def __init__(
        self,
        link: Link,
        view: SideView,
        panel: Panel,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link, self._view, self._panel, self._now_s = link, view, panel, now_s
        self._piece: Piece | None = None
        self._bottoms: tuple[SideBody, ...] = ()
        self._let_go: SideBody | None = None
        self._fall: Fall | None = None
        self._fall_s = 0.0
        self._stands: bool | None = None
        self._tick = 0

    def take(self, fact: Fact) -> None:
        """Note what is in the scene and what was let go."""
        if isinstance(fact, RunStarted):
            self._piece = self._known(fact.piece)
            names = fact.bottom.split("+")
            self._bottoms = _tower([p for p in map(self._known, names) if p is not None])
        elif isinstance(fact, TrialStarted):
            self._let_go = self._fall = self._stands = None
        elif isinstance(fact, Released):
            self._let_go = self._held()
            self._stands, self._fall, self._fall_s = fact.stands, fact.fall, self._now_s()

    def draw(self) -> None:
        """Show the present scene."""
        self._tick += 1
        if not self._view.isVisible() or self._piece is None or self._tick % EVERY:
            return
        piece = self._let_go
        caption = ""
        if piece is None:
            piece = self._held()
        else:
            caption = "stands" if self._stands else "fell"
            if not self._stands:
                piece = self._fallen(piece, self._piece.name)
        self._panel.detail.setText(caption or (f"x {piece.x_mm:+.1f} mm" if piece else ""))
        self._view.show_scene(
            SideScene(
                self._bottoms,
                piece,
                self._piece.grip_height_mm or 0.0,
                self._jaws() if self._let_go is None else None,
                self._names(),
            )
        )

    def _names(self) -> str:
        assert self._piece is not None
        return f"{self._piece.title} on {' on '.join(b.name for b in reversed(self._bottoms))}"

    def _known(self, name: str) -> Piece | None:
        try:
            return self._link.catalogue.piece(name)
        except InputError:
            return None

    def _held(self) -> SideBody | None:
        device = self._link.devices.get("arm")
        if device is None or self._piece is None:
            return None
        try:
            _, pose = _arm(device).poses.latest(self._link.clock_s(), math.inf)
        except StaleSampleError:
            return None
        piece = self._piece
        x, z = round(float(pose[0]), 2), round(float(pose[2]) - (piece.grip_height_mm or 0.0), 2)
        return SideBody(piece.name, piece.face.half_extents_mm[0], _top_half_mm(piece),
                        piece.height_mm, x, z)  # fmt: skip

    def _jaws(self) -> float | None:
        device = self._link.devices.get("gripper")
        if device is None or self._piece is None:
            return None
        return max(0.5 * _gripper(device).status().width_mm, _top_half_mm(self._piece))

    def _fallen(self, still: SideBody, name: str) -> SideBody:
        """Return a body along its recorded fall, seen along y; unmoved without a record.

        The record holds the centre of each body's lower face in m and its quaternion.
        """
        fall = self._fall
        if fall is None or len(fall.t_s) == 0 or name not in fall.names:
            return still
        elapsed_s = self._now_s() - self._fall_s
        index = int(np.searchsorted(fall.t_s - fall.t_s[0], elapsed_s))
        pose = fall.pose[min(index, len(fall.t_s) - 1), fall.names.index(name)]
        return replace(
            still,
            x_mm=round(1e3 * float(pose[0]), 2),
            z_mm=round(1e3 * float(pose[2]), 2),
            tilt_rad=round(tilt_about_y(pose[3:]), 4),
        )


def tilt_about_y(quaternion: FloatArray) -> float:
    """Angle in rad by which the body's z axis leans towards x (w x y z quaternion)."""
    w, x, y, z = (float(v) for v in quaternion)
    return math.atan2(2 * (x * z + w * y), 1 - 2 * (x * x + y * y))


def _tower(pieces: list[Piece]) -> tuple[SideBody, ...]:
    bodies: list[SideBody] = []
    top_mm = 0.0
    for piece in reversed(pieces):
        half = piece.face.half_extents_mm[0]
        bodies.append(SideBody(piece.title, half, half, piece.height_mm, 0.0,
                               top_mm - piece.height_mm))  # fmt: skip
        top_mm -= piece.height_mm
    return tuple(reversed(bodies))


def _top_half_mm(piece: Piece) -> float:
    return 0.5 * piece.width_mm


def _arm(device: Device) -> Arm:
    return device  # type: ignore[return-value]


def _gripper(device: Device) -> Gripper:
    return device  # type: ignore[return-value]
