"""Bench to scale, as shown on Operate and Stack."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from touchdown.app.shell.activity import arm_of, arm_position_mm, gripper_of
from touchdown.app.shell.bench_text import tower_text
from touchdown.backend import core
from touchdown.backend.bench import Session
from touchdown.backend.geometry import Piece
from touchdown.widgets import views
from touchdown.widgets.base import Panel, signed, tr

HOLD_S = 3.0  # time for which the end of a release stays visible, also into the next trial
EVERY = 2  # draw every second tick: 15 pictures a second look smooth
PROFILE_POINTS = 41  # of an upper face that is not flat
OUTLINE_POINTS = 48  # of a drawn circle
# The shown width grows in steps, to a limit, once the hand is farther from the bottom.
NEAR_MM, SPAN_STEP_MM, MOST_MM = 40.0, 40.0, 160.0


class BenchViewPresenter:
    """Shows hand, piece, bottoms and next step; after a release also the motion of the piece."""

    def __init__(
        self,
        bench: Session,
        view: views.SideView,
        panel: Panel,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._bench, self._view, self._panel, self._now_s = bench, view, panel, now_s
        self._piece: Piece | None = None
        self._bottoms: tuple[views.SideBody, ...] = ()
        self._table_mm, self._names = 0.0, ""
        self._let_go: views.SideBody | None = None
        self._fall: core.Fall | None = None
        self._fall_s = 0.0
        self._stands: bool | None = None
        self._tick = self._trial = self._let_go_in = 0
        self.next_mm: tuple[float, float] | None = None  # where the face goes next
        self._set(bench.usual.piece, bench.usual.bottoms)

    def take(self, event: core.Event) -> None:
        """Update scene and released piece."""
        if isinstance(event, core.RunStarted | core.TrialStarted | core.Released):
            self.next_mm = None
        if isinstance(event, core.RunStarted):
            self._set(event.piece, event.bottom.split("+"))
        elif isinstance(event, core.ActionChosen):
            held, (dx_mm, dy_mm) = self._held(), event.action.step_mm or (0.0, 0.0)
            if held is not None and event.action.kind == "shift":
                self.next_mm = held.x_mm + dx_mm, held.y_mm + dy_mm
        elif isinstance(event, core.TrialStarted):
            self._trial = event.trial
        elif isinstance(event, core.PhaseEntered) and event.phase == "rise":
            self._leave()
        elif isinstance(event, core.Released):
            if self._let_go is None or self._let_go_in != self._trial:
                self._leave()
            self._stands, self._fall, self._fall_s = event.stands, event.fall, self._now_s()

    def _set(self, piece: str, bottoms: Sequence[str]) -> None:
        known = self._bench.catalogue.pieces
        self._piece, self._let_go = known.get(piece), None
        self._stand_on([known[name] for name in bottoms if name in known])

    def _leave(self) -> None:
        """Leave the piece in place while the hand rises."""
        held = self._held()
        self._let_go = None if held is None else replace(held, z_mm=0.0)
        self._let_go_in, self._stands, self._fall = self._trial, None, None
        self._fall_s = self._now_s()

    def draw(self) -> None:
        """Redraw the scene."""
        self._tick += 1
        if not self._view.isVisible() or self._piece is None or self._tick % EVERY:
            return
        over = self._let_go_in != self._trial
        if over and self._now_s() - self._fall_s > HOLD_S:
            self._let_go = None
        hand = None if over and self._let_go is not None else self._hand()
        self._panel.detail.setText(self._words(hand))
        self._view.show_scene(self._scene(hand))

    def _words(self, hand: tuple[float, ...] | None) -> str:
        if self._let_go is None:
            return "" if hand is None else f"x {signed(hand[0], 1)}, y {signed(hand[1], 1)} mm"
        if self._stands is None:
            return tr("released")
        return tr("trial {}: {}", self._let_go_in, tr("stands") if self._stands else tr("fell"))

    def _scene(self, hand: tuple[float, ...] | None) -> views.SideScene:
        assert self._piece is not None
        gripper, span, bottoms = gripper_of(self._bench), views.USUAL_SPAN_MM, self._bottoms
        loose = self._bench.interlock.staged is not None  # the jaws still stand around the piece
        holds = gripper is None or gripper.status().holding or loose
        piece = self._let_go or (self._held() if holds else None)
        if hand is not None:
            off = max(abs(hand[0]), abs(hand[1])) - NEAR_MM
            more = min(max(SPAN_STEP_MM * math.ceil(off / SPAN_STEP_MM), 0.0), MOST_MM)
            span = span[0] - more, span[1] + more
        if self._let_go is not None and self._fall is not None and piece is not None:
            piece = self._fallen(piece)
            bottoms = tuple(self._fallen(body) for body in bottoms)
            span = self._span(piece)
        return views.SideScene(
            bottoms, piece, hand, self._jaws(), self._table_mm, self._names, span, self._turn(),
            self.next_mm,
        )  # fmt: skip

    def _span(self, piece: views.SideBody) -> tuple[float, float]:
        last = self._fallen(piece, at_end=True)
        x = np.concatenate([part[:, 0] for part in last.outlines_mm()])
        return min(-30.0, float(x.min()) - 8.0), max(30.0, float(x.max()) + 8.0)

    def _hand(self) -> tuple[float, ...] | None:
        at = arm_position_mm(self._bench)
        return None if at is None else tuple(round(float(v), 2) for v in at)

    def _held(self) -> views.SideBody | None:
        hand, piece = self._hand(), self._piece
        if hand is None or piece is None:
            return None
        turn = self._turn()
        # The centre of the face lies below the grasp pivot, along the hand.
        down = core.rotation_from_quaternion(turn)[:, 2] * (piece.grip_height_mm or 0.0)
        x_mm, y_mm, z_mm = (round(float(v), 2) for v in np.subtract(hand, down))
        return views.SideBody(piece.name, piece.face.half_extents_mm[0], 0.5 * piece.width_mm,
                        piece.height_mm, x_mm, z_mm, turn, y_mm=y_mm,
                        face=piece.face.path(OUTLINE_POINTS))  # fmt: skip

    def _turn(self) -> views.Quaternion:
        """Return the rotation of the hand from straight down."""
        arm = arm_of(self._bench)
        if arm is None:
            return views.UPRIGHT
        try:
            pose = arm.pose(math.inf)
        except core.StaleSampleError:
            return views.UPRIGHT
        vector = np.array([pose.rx_rad, pose.ry_rad, pose.rz_rad])
        angle = float(np.linalg.norm(vector))
        if angle == 0.0:
            return views.UPRIGHT
        x, y, z = (vector / angle * math.sin(0.5 * angle)).round(4).tolist()
        return round(math.cos(0.5 * angle), 4), x, y, z

    def _jaws(self) -> float:
        gripper = gripper_of(self._bench)
        if gripper is None or self._piece is None:
            return 0.0
        return max(0.5 * gripper.status().width_mm, 0.5 * self._piece.width_mm)

    def _fallen(self, still: views.SideBody, *, at_end: bool = False) -> views.SideBody:
        """Return a body along its recorded fall; unmoved without a record.

        The record holds the centre of each body's lower face in m and its quaternion. It knows only
        the lower outline of the piece: drawn with its wider upper part, the piece is raised until
        nothing is below the table.
        """
        fall = self._fall
        if fall is None or len(fall.t_s) == 0 or still.name not in fall.names:
            return still
        elapsed_s = math.inf if at_end else self._now_s() - self._fall_s
        index = min(int(np.searchsorted(fall.t_s - fall.t_s[0], elapsed_s)), len(fall.t_s) - 1)
        x_m, y_m, z_m, *turn = fall.pose[index, fall.names.index(still.name)].tolist()
        w, x, y, z = (round(part, 4) for part in turn)
        moved = replace(
            still, x_mm=round(1e3 * x_m, 2), y_mm=round(1e3 * y_m, 2), z_mm=round(1e3 * z_m, 2),
            turn=(w, x, y, z),
        )  # fmt: skip
        lowest = min(float(part[:, 1].min()) for part in moved.outlines_mm())
        return replace(moved, z_mm=moved.z_mm + max(0.0, self._table_mm - lowest))

    def _stand_on(self, pieces: list[Piece]) -> None:
        """Set the bottoms, from the table up; z = 0 is the top of the last one."""
        bodies: list[views.SideBody] = []
        top_mm = 0.0
        for piece in reversed(pieces):
            half = piece.face.half_extents_mm[0]
            top_mm -= piece.height_mm
            profile, face = _profile_mm(piece, half), piece.face.path(OUTLINE_POINTS)
            sizes = half, half, piece.height_mm
            bodies.append(
                views.SideBody(piece.name, *sizes, 0.0, top_mm, views.UPRIGHT, profile, face=face)
            )
        self._bottoms, self._table_mm = tuple(reversed(bodies)), top_mm
        titles = [p.title for p in reversed(pieces)]
        self._names = tower_text(*([self._piece.title] if self._piece else []), *titles)


def _profile_mm(piece: Piece, half_mm: float) -> tuple[tuple[float, float], ...]:
    """Return the heights of a bottom that is not flat, along x through its centre."""
    if piece.surface.flat:
        return ()
    x = np.linspace(-half_mm, half_mm, PROFILE_POINTS)
    heights = piece.surface.heights_mm(np.column_stack([x, np.zeros_like(x)]))
    return tuple(zip(x.tolist(), heights.tolist(), strict=True))
