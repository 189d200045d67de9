"""Jogging of the arm by pads and keys."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import cast

from PySide6.QtCore import QEvent, QObject, Qt, QTimer
from PySide6.QtGui import QKeyEvent, QWindow
from PySide6.QtWidgets import QApplication, QWidget

from touchdown.app import shell
from touchdown.app.operate.page import OperatePage
from touchdown.backend import core, devices
from touchdown.backend.bench import Session
from touchdown.backend.runs import ManualControl, SceneChoice, SetRequest
from touchdown.widgets.base import tr, true_minus
from touchdown.widgets.forms import JOINTS, JogPad, JogUnit, PoseReadout
from touchdown.widgets.shell import CardQuestion, FaultCards

PERIOD_S = 0.1
LEVEL_RAD_S = math.radians(10.0)  # speed of levelling the hand
NO_JOINTS = "The arm of this bench keeps its orientation: no JOINT frame and no turning."
PACES = (
    JogUnit("mm", "mm", devices.STEPS_MM, (1.0, 50.0, 20.0)),
    JogUnit("\N{DEGREE SIGN}", "degrees", devices.STEPS_DEG, (1.0, 15.0, 5.0)),
)
# Text of a pad while its direction is refused.
SHORT = {
    "DRAGGING": "lift first", "TURN-PRESSING": "lift first", "TURN-LOW": "go up first",
    "JOG-FORCE": "force limit", "RECOVERY": "only away", "DEGRADED": "only away",
    "FT-UNKNOWN": "no force", "NO-POSE": "no pose",
}  # fmt: skip


class ManualControlPresenter:
    """Sends manual commands to the bench; shows pose, range, gripper and refusals."""

    def __init__(self, bench: Session, page: OperatePage, cards: FaultCards) -> None:
        self._bench, self._page, self._cards = bench, page, cards
        self._hold = self._sequence = 0
        self._drawn_s = float("-inf")
        self._drawn_pads: tuple[str, ...] = ()
        hand = bench.hand
        page.scene.setVisible(bench.simulated)
        usual = SceneChoice()
        self._titles = shell.piece_titles(bench.catalogue)
        page.scene.show_catalogue(*self._titles, (usual.piece, usual.bottoms[0]))
        page.jog.lift.clicked.connect(self.lift)
        page.jog.show_turning("" if hand is not None and hand.rotates else NO_JOINTS)

    def show_pieces(self) -> None:
        """Show the pieces that were added since; the selection is kept."""
        titles, scene = shell.piece_titles(self._bench.catalogue), self._page.scene
        if titles != self._titles:
            self._titles = titles
            chosen = str(scene.piece.currentData()), str(scene.bottom.currentData())
            scene.show_catalogue(*titles, chosen)

    # -- orders -----------------------------------------------------------------------------------

    def renew(self, what: str) -> bool:
        """Start or renew the jog lease; return False and show a card if it is refused."""
        if self._sequence == 0:
            self._hold += 1
        self._sequence += 1
        order = devices.JogOrder(self._hold, self._sequence, self._bench.clock_s(), _axis(what),
                         self._frame(), _sign(what) * self._speed())  # fmt: skip
        return self._ordered(lambda hand: hand.jog.renew(order))

    def ended(self, cause: str) -> None:
        """End the hold and log its cause."""
        self._sequence = 0
        shell.log.info("jog %d ended: %s", self._hold, cause)
        if self._bench.hand is not None:
            self._bench.hand.jog.end(self._hold)

    def step(self, what: str) -> None:
        """Move by one step."""
        step = self._page.jog.pace.step
        if step is None:
            return
        distance = _sign(what) * (math.radians(step) if self._page.jog.turning else step)
        frame, speed = self._frame(), self._speed()
        self._ordered(lambda hand: hand.jog.step(_axis(what), frame, distance, speed))

    def level(self) -> None:
        """Turn the hand back to straight down."""
        self._ordered(lambda hand: hand.jog.level(LEVEL_RAD_S))

    def lift(self) -> None:
        """Reset if stopped, then lift the hand out of contact."""
        if self._bench.interlock.latched:
            self._cards.reset()
        shell.lift_hand(self._bench, self._cards)

    def grip(self) -> None:
        """Close the gripper on the piece."""
        force_n = self._page.gripper.force.value()
        self._ordered(lambda hand: hand.grip(force_n))

    def open(self) -> None:
        """Open the gripper; while it holds a piece, ask first."""

        def ask(text: str, no: str, yes: str, act: Callable[[], None]) -> None:
            self._cards.ask(CardQuestion(text, ((no, lambda: None), (yes, act))))

        shell.open_gripper(self._bench, self._cards, ask)

    def zero(self) -> None:
        """Zero force and moment."""
        self._ordered(lambda hand: hand.zero_wrench())

    def baseline(self) -> None:
        """Take new tactile reference images."""
        self._ordered(lambda hand: hand.take_references())

    def set_scene(self, piece: str, bottom: str) -> None:
        """Set up a new scene on the simulated bench; a held piece returns to its place."""
        request = SetRequest(SceneChoice(piece, (bottom,)))
        self._ordered(lambda _hand: self._bench.start(request))

    def _ordered(self, order: Callable[[ManualControl], None]) -> bool:
        hand = self._bench.hand
        if hand is None:
            return False
        return shell.carry_out(lambda: order(hand), self._cards)

    # -- showing ----------------------------------------------------------------------------------

    def draw(self) -> None:
        """Update pose, range and gripper ten times a second; end a forbidden hold."""
        why = self.why_not()
        self._page.jog.show_ready(not why, why)
        self._page.gripper.show_ready(not why)
        self._page.scene.show_ready(not why)
        if why:
            self._page.jog.hold.end(why)
            self._page.jog.show_armed(False)
        now_s, pads = time.monotonic(), self._page.jog.shown
        if now_s - self._drawn_s >= PERIOD_S or pads != self._drawn_pads:
            self._drawn_s, self._drawn_pads = now_s, pads
            self._page.jog.show_look(self._look())
            latched = self._bench.interlock.latched
            words = shell.LIFT if latched else tr("Lift {:.0f} mm", shell.LIFT_MM)
            self._page.jog.show_lift(words if shell.is_pressing(self._bench) else "")
            self._draw_gripper()

    def why_not(self) -> str:
        """Return why manual motion is not possible now, "" if it is."""
        if self._bench.hand is None:
            return shell.missing_scene_reason(self._bench) or tr("The bench is being prepared")
        if self._bench.interlock.latched:
            return tr("Press Reset first")
        if not self._bench.hand.powered:
            return tr("The servo is off: hold Servo in the top bar for 1 s")
        return tr("A run is going on") if shell.is_run_active(self._bench) else ""

    def _look(self) -> PoseReadout:
        arm, hand = shell.arm_of(self._bench), self._bench.hand
        if arm is None or hand is None:
            return PoseReadout()
        try:
            t_s, _ = arm.poses.latest(self._bench.clock_s(), float("inf"))
            pose = arm.pose(float("inf"))
            text = self._pose_text(arm, pose)
            rooms = hand.jog.rooms(self._frame())
        except (core.StaleSampleError, core.RefusedError):
            return PoseReadout()
        slow, above_mm = hand.jog.state.slow, pose.z_mm - hand.surface_mm
        recovering, turned = self._bench.interlock.recovering, core.rotation_angle_rad(pose) > 0.0
        note = tr("Recovery: jog away from contact") if recovering else ""
        if not note and hand.pressing_n and not shell.is_run_active(self._bench):
            note = tr("In contact, {:.1f} N: lift first", hand.pressing_n)
        note = note or self._bench.interlock.degraded
        warn = bool(note)
        if not note and core.rotation_angle_rad(pose) > core.LEVEL_TOLERANCE_RAD:
            turned_deg = math.degrees(core.rotation_angle_rad(pose))
            note = tr("Turned by {:.1f}\N{DEGREE SIGN}: level it to probe", turned_deg)
        if not note and any(room.why == "TURN-LOW" for room in rooms.values()):
            clear_mm = self._bench.interlock.limits.turn_clear_mm
            low = "{:.1f} mm above the surface, {:.0f} mm needed to turn: jog +Z"
            note = tr(low, above_mm, clear_mm)
        if not note and not math.isnan(above_mm):
            above, below = "{:.1f} mm above the surface", "{:.1f} mm below the surface"
            note = tr(above if above_mm >= 0.0 else below, abs(above_mm))
        if slow and hand.jog.state.order is not None:
            note = f"{self._jog_speed(hand)}: {slow}"
        age_s = max(self._bench.clock_s() - t_s, 0.0)
        said = tuple((what, _room_words(what, room)) for what, room in rooms.items())
        return PoseReadout(text, age_s, said, note, warn=warn, turned=turned)

    def _pose_text(self, arm: devices.Arm, pose: core.Pose) -> str:
        """Return the pose of the hand in the terms of the visible pads."""
        jog = self._page.jog
        if self._frame() == "JOINT":
            angles = (f"{math.degrees(angle) + 0.0:.0f}" for angle in arm.joints_rad(float("inf")))
            return true_minus("  ".join(angles) + "\N{DEGREE SIGN}")
        if jog.turning:
            turned = (math.degrees(v) for v in (pose.rx_rad, pose.ry_rad, pose.rz_rad))
            x, y, z = (f"{v + 0.0:.1f}" for v in turned)
            return true_minus(f"RX {x}   RY {y}   RZ {z}\N{DEGREE SIGN}")
        return true_minus(f"X {pose.x_mm:.1f}   Y {pose.y_mm:.1f}   Z {pose.z_mm:.1f} mm")

    def _jog_speed(self, hand: ManualControl) -> str:
        state = hand.jog.state
        if state.order is not None and devices.turns(state.order.axis):
            return f"{math.degrees(state.speed):.1f}\N{DEGREE SIGN}/s"
        return f"{state.speed:.1f} mm/s"

    def _draw_gripper(self) -> None:
        gripper, hand, panel = shell.gripper_of(self._bench), self._bench.hand, self._page.gripper
        if gripper is None or hand is None:
            panel.figures.setText(tr("No data"))
            return
        status, moving = gripper.status(), hand.active and not hand.jog.active
        panel.show_status(status.width_mm, status.force_n, holding=status.holding, moving=moving)

    def _frame(self) -> devices.Frame:
        return devices.FRAMES[self._page.jog.frame.currentIndex()]

    def _speed(self) -> float:
        """Return the selected speed in mm/s, or rad/s while the pads turn."""
        jog = self._page.jog
        return math.radians(jog.speed.value()) if jog.turning else jog.speed.value()


def _room_words(what: str, room: devices.JogRange) -> str:
    """Return the text below the name of a pad."""
    if room.why:
        return tr(SHORT.get(room.why, "refused"))
    if devices.turns(_axis(what)):
        return f"\N{LESS-THAN OR EQUAL TO} {math.degrees(room.left):.0f}\N{DEGREE SIGN}"
    return f"\N{LESS-THAN OR EQUAL TO} {room.left:.0f} mm"


def _axis(what: str) -> devices.Axis:
    return cast("devices.Axis", what[1:])


def _sign(what: str) -> float:
    return 1.0 if what[0] == "+" else -1.0


IDLE_MS = 30_000
KEYS: dict[int, str] = {
    Qt.Key.Key_Right: "+x",
    Qt.Key.Key_Left: "-x",
    Qt.Key.Key_Up: "+y",
    Qt.Key.Key_Down: "-y",
    Qt.Key.Key_PageUp: "+z",
    Qt.Key.Key_PageDown: "-z",
}
# Digits choose the joint that the arrows drive; they do not move it.
JOINT_KEYS: dict[int, int] = {int(Qt.Key.Key_1) + joint: joint + 1 for joint in range(JOINTS)}
ROWS = (
    ("Left", "Jog \N{MINUS SIGN}X while held (keyboard jog)"),
    ("Right", "Jog +X while held (keyboard jog)"),
    ("Up", "Jog +Y while held (keyboard jog)"),
    ("Down", "Jog \N{MINUS SIGN}Y while held (keyboard jog)"),
    ("PgUp", "Jog +Z while held (keyboard jog)"),
    ("PgDown", "Jog \N{MINUS SIGN}Z while held (keyboard jog)"),
    ("1", "Choose J1 for the arrows, 2 to 6 the others (keyboard jog, JOINT)"),
)


class JogKeyFilter(QObject):
    """Event filter of the application while the jog keys are armed."""

    def __init__(self, page: QWidget, pad: JogPad) -> None:
        super().__init__(page)
        self._page, self._pad = page, pad
        self._down: set[int] = set()
        self.armed = False
        self._idle = QTimer(self, singleShot=True, interval=IDLE_MS)
        self._idle.timeout.connect(self.disarm)

    def arm(self, on: bool) -> None:
        """Arm or disarm the jog keys."""
        if on == self.armed:
            return
        application = QApplication.instance()
        assert isinstance(application, QApplication)
        self.armed = on
        self._down.clear()
        if on:
            self._page.setFocus()
            application.installEventFilter(self)
            application.focusChanged.connect(self._focus_changed)
            self._idle.start()
        else:
            application.removeEventFilter(self)
            application.focusChanged.disconnect(self._focus_changed)
            self._idle.stop()
            self._pad.hold.end("the keys were disarmed")
        self._pad.show_armed(on)

    def disarm(self) -> None:
        """Disarm the jog keys."""
        self.arm(False)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Handle the jog keys as the window system delivers them."""
        if not isinstance(event, QKeyEvent) or not isinstance(watched, QWindow):
            return False
        joint = self._pad.frame.currentText() == "JOINT" and event.key() in JOINT_KEYS
        if not (joint or event.key() in KEYS) or shell.is_typing():
            return False
        # Qt sends ShortcutOverride before a key press. Accept it, so that no shortcut takes the
        # key; it is not a key press itself.
        if event.type() is not QEvent.Type.ShortcutOverride and not event.isAutoRepeat():
            self._take(event)
        event.accept()
        return True

    def _take(self, event: QKeyEvent) -> None:
        self._idle.start()
        key = event.key()
        if key in JOINT_KEYS:
            if event.type() is QEvent.Type.KeyPress:
                self._pad.choose_joint(JOINT_KEYS[key])
            return
        if event.type() is QEvent.Type.KeyRelease:
            self._down.discard(key)
            self._pad.hold.release(key)
            return
        alone = not self._down
        self._down.add(key)
        if alone:
            self._pad.press_key(self._page, KEYS[key], key)
        else:
            self._pad.hold.end("a second key was pressed")

    def _focus_changed(self, _old: QWidget | None, now: QWidget | None) -> None:
        if (
            now is None
            or not now.isVisible()
            or now.window() is not self._page.window()
            or shell.is_typing()
        ):
            self.disarm()
