"""Presenter of everything that moves by hand: jog by pad and key, gripper, zero and baseline."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import datetime

from app.activity import busy, not_set
from app.cards import refusal_card
from app.error_hooks import log
from app.link import Link
from app.operate.page import OperatePage
from backend.core.faults import FaultError, RefusedError, StaleSampleError
from backend.core.flow import Pose
from backend.devices.jog import JogOrder
from backend.devices.jog_axes import AXES, Axis, Frame, way_of
from backend.devices.jog_limits import room_mm
from backend.devices.protocols import Arm, Device, Gripper, GripStatus
from backend.runs.hand import Hand
from backend.runs.requests import SceneChoice, SetRequest
from widgets.fault_cards import FaultCards, Question
from widgets.jog_pad import PoseLook

PERIOD_S = 0.1
NO_JOINTS = "The arm of this bench keeps its orientation: no JOINT frame and no rotations."


class HandPresenter:
    """Sends orders to the present scene's hand; shows pose, room, gripper and refusals."""

    def __init__(
        self,
        link: Link,
        page: OperatePage,
        cards: FaultCards,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._link, self._page, self._cards, self._now_s = link, page, cards, now_s
        self._hold = self._sequence = 0
        self._drawn_s = float("-inf")
        hand, shown = link.hand, link.catalogue
        page.scene.setVisible(link.simulated)
        page.scene.show_catalogue(
            [(name, shown.piece(name).title) for name in shown.tops],
            [(name, shown.piece(name).title) for name in shown.bottoms],
            (SceneChoice().piece, SceneChoice().bottoms[0]),
        )
        page.jog.show_joint_reason("" if hand is not None and hand.rotates else NO_JOINTS)

    # -- orders -----------------------------------------------------------------------------------

    def renew(self, what: str) -> bool:
        """Open or renew the jog lease; False, with a card, if it is refused."""
        if self._sequence == 0:
            self._hold += 1
        self._sequence += 1
        order = JogOrder(self._hold, self._sequence, self._link.clock_s(), _axis(what),
                         self._frame(), _sign(what) * self._page.jog.speed.value())  # fmt: skip
        return self._ordered(lambda hand: hand.jog.renew(order))

    def ended(self, cause: str) -> None:
        """End the hold; the cause goes to the log."""
        self._sequence = 0
        log.info("jog %d ended: %s", self._hold, cause)
        if self._link.hand is not None:
            self._link.hand.jog.end(self._hold)

    def step(self, what: str) -> None:
        """Move by one step."""
        step_mm, jog = self._page.jog.step_mm, self._page.jog
        if step_mm is None:
            return
        distance = _sign(what) * step_mm
        frame, speed = self._frame(), jog.speed.value()
        self._ordered(lambda hand: hand.jog.step(_axis(what), frame, distance, speed))

    def grip(self) -> None:
        """Close on the piece."""
        force_n = self._page.gripper.force.value()
        self._ordered(lambda hand: hand.grip(force_n))

    def open(self) -> None:
        """Open; while a piece is held a card asks first."""
        status = self._grip_status()
        if status is not None and status.holding:
            answers = (("Keep holding", _keep), ("Open and let it go", self._open_anyway))
            self._cards.ask(Question("A piece is held. Opening lets it go.", answers))
        else:
            self._ordered(lambda hand: hand.open(confirmed=False))

    def zero(self) -> None:
        """Zero force and moment."""
        self._ordered(lambda hand: hand.zero_wrench())

    def baseline(self) -> None:
        """Take the tactile references anew."""
        self._ordered(lambda hand: hand.take_references())

    def set_scene(self, piece: str, bottom: str) -> None:
        """Set the simulated bench anew; a held piece goes back to its place as well."""
        request = SetRequest(SceneChoice(piece, (bottom,)))
        self._ordered(lambda _hand: self._link.start(request))

    def _open_anyway(self) -> None:
        self._ordered(lambda hand: hand.open(confirmed=True))

    def _ordered(self, order: Callable[[Hand], None]) -> bool:
        hand = self._link.hand
        if hand is None:
            return False
        try:
            order(hand)
        except RefusedError as error:
            if error.reason == "JOG-ENDED":
                # What ended it has been told already.
                return False
            self._cards.show_card(refusal_card(error, f"{datetime.now():%H:%M:%S}"))
            return False
        except FaultError as error:
            refused = RefusedError(error.fault.code, error.fault.what)
            self._cards.show_card(refusal_card(refused, f"{datetime.now():%H:%M:%S}"))
            return False
        self._cards.pass_on()
        return True

    # -- showing ----------------------------------------------------------------------------------

    def draw(self) -> None:
        """Show pose, room and gripper ten times a second; end a hold that may not go on."""
        why = self.why_not()
        self._page.jog.show_ready(not why, why)
        self._page.gripper.show_ready(not why)
        self._page.scene.show_ready(not why)
        if why:
            self._page.jog.hold.end(why)
            self._page.jog.show_armed(False)
        now_s = self._now_s()
        if now_s - self._drawn_s >= PERIOD_S:
            self._drawn_s = now_s
            self._page.jog.show_look(self._look())
            self._draw_gripper()

    def why_not(self) -> str:
        """Return why nothing may be moved by hand now, "" if it may."""
        if self._link.hand is None:
            return not_set(self._link) or "The bench is being prepared"
        if self._link.interlock.latched:
            return "Press Reset first"
        return "A run is going on" if busy(self._link) else ""

    def _look(self) -> PoseLook:
        arm, hand = self._link.devices.get("arm"), self._link.hand
        if arm is None or hand is None:
            return PoseLook()
        try:
            t_s, values = _arm(arm).poses.latest(self._link.clock_s(), float("inf"))
        except StaleSampleError:
            return PoseLook()
        x, y, z = values.tolist()
        pose, limits, frame = Pose(x, y, z), self._link.interlock.limits, self._frame()
        room = tuple(
            (f"{sign}{axis}", room_mm(pose, way_of(axis, frame, int(f"{sign}1")), limits))
            for axis in AXES
            for sign in "+-"
        )
        slow = hand.jog.state.slow
        recovering = self._link.interlock.recovering
        contact = self._contact(hand)
        note = "Recovery: jog away from contact" if recovering else contact
        if slow and hand.jog.state.order is not None:
            note = f"{hand.jog.state.speed:.1f} mm/s: {slow}"
        age_s = max(self._link.clock_s() - t_s, 0.0)
        return PoseLook((x, y, z), age_s, room, note, warn=recovering or bool(contact))

    def _contact(self, hand: Hand) -> str:
        if busy(self._link) or not hand.pressing_n:
            return ""
        return f"In contact with {hand.pressing_n:.1f} N: jog +Z to lift before you start a run"

    def _draw_gripper(self) -> None:
        status, hand = self._grip_status(), self._link.hand
        if status is not None and hand is not None:
            moving = hand.active and not hand.jog.active
            self._page.gripper.show_status(
                status.width_mm, status.force_n, holding=status.holding, moving=moving
            )

    def _grip_status(self) -> GripStatus | None:
        device = self._link.devices.get("gripper")
        return None if device is None else _gripper(device).status()

    def _frame(self) -> Frame:
        return "TOOL" if self._page.jog.frame.currentText() == "TOOL" else "XYZ"


def _axis(what: str) -> Axis:
    return AXES["xyz".index(what[1])]


def _sign(what: str) -> float:
    return 1.0 if what[0] == "+" else -1.0


def _keep() -> None:
    """Do nothing: the piece stays held."""


def _arm(device: Device) -> Arm:
    return device  # type: ignore[return-value]


def _gripper(device: Device) -> Gripper:
    return device  # type: ignore[return-value]
