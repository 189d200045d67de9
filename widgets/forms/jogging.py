"""Pads that jog the arm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from PySide6.QtCore import QEvent, QSignalBlocker, QSize, Qt, Signal
from PySide6.QtWidgets import (
    QButtonGroup,
    QComboBox,
    QDoubleSpinBox,
    QGridLayout,
    QPushButton,
    QSizePolicy,
    QSlider,
    QWidget,
)

from touchdown.widgets import base
from touchdown.widgets.forms.fields import HoldButton, HoldState, field_label, inset_spin_boxes


@dataclass(frozen=True, slots=True)
class JogUnit:
    """Unit of jogging, its steps, and slowest, fastest and default speed per second."""

    unit: str
    spoken: str
    steps: tuple[float, ...]
    speeds: tuple[float, float, float]


class JogPace(QWidget):
    """Choice of hold-to-run or a step, and of the speed. Each unit keeps its own speed."""

    def __init__(self, paces: Sequence[JogUnit]) -> None:
        """``paces``: the first is shown; it has all steps of the others."""
        super().__init__()
        self._paces = tuple(paces)
        self._pace = self._paces[0]
        self._kept = {pace.unit: pace.speeds[2] for pace in self._paces}
        self.steps = self._step_buttons()
        self._unit = base.label(self._pace.unit, "muted")
        self.speed, self._slider = QDoubleSpinBox(), QSlider(Qt.Orientation.Horizontal)
        self.speed.setDecimals(0)
        inset_spin_boxes(self.speed)
        for widget in (self.speed, self._slider):
            widget.setAccessibleName(base.tr("Jog speed"))
            widget.setToolTip(base.tr("At most 2 mm/s near the surface and in contact"))
        self.speed.valueChanged.connect(self._follow_spin)
        self._slider.valueChanged.connect(self.speed.setValue)
        self._arrange()
        self.show_pace(0)

    @property
    def step(self) -> float | None:
        """Selected step in the present unit, None for hold-to-run."""
        at = self._chosen()
        return None if at == 0 else float(self.steps[at].text())

    def show_pace(self, at: int) -> None:
        """Show steps and speed of another unit."""
        pace = self._pace = self._paces[at]
        for button, step in zip(self.steps[1:], self._paces[0].steps, strict=True):
            button.setVisible(step in pace.steps)
            button.setAccessibleName(base.tr("Step of {} {}", button.text(), base.tr(pace.spoken)))
            button.setToolTip(base.tr("{} ([ and ])", button.accessibleName()))
        if self.steps[self._chosen()].isHidden():
            self.next_step(1)
        self._unit.setText(pace.unit)
        slowest, fastest, _ = pace.speeds
        with QSignalBlocker(self.speed), QSignalBlocker(self._slider):
            self.speed.setRange(slowest, fastest)
            self.speed.setSuffix(f" {pace.unit}/s")
            self._slider.setRange(int(slowest), int(fastest))
            self.speed.setValue(self._kept[pace.unit])
            self._slider.setValue(round(self._kept[pace.unit]))

    def next_step(self, by: int) -> None:
        """Select the next longer or shorter step; hold-to-run precedes the shortest."""
        at = self._chosen() + by
        while 0 < at < len(self.steps) - 1 and self.steps[at].isHidden():
            at += by
        self.steps[min(max(at, 0), len(self.steps) - 1)].setChecked(True)

    def _chosen(self) -> int:
        return next((i for i, button in enumerate(self.steps) if button.isChecked()), 0)

    def _step_buttons(self) -> list[QPushButton]:
        group, made = QButtonGroup(self), []
        for text in ("Hold", *(f"{step:g}" for step in self._paces[0].steps)):
            button = base.push_button(text, role="choice", checkable=True)
            group.addButton(button)
            made.append(button)
        made[0].setChecked(True)
        made[0].setAccessibleName(base.tr("Hold to run"))
        made[0].setToolTip(base.tr("Hold to run ([ and ])"))
        return made

    def _follow_spin(self, value: float) -> None:
        self._kept[self._pace.unit] = value
        self._slider.setValue(round(value))

    def _arrange(self) -> None:
        steps = base.hbox(*((button, 1) for button in self.steps), self._unit, spacing=4)
        speed = base.hbox(field_label("Speed", self.speed), (self._slider, 1), self.speed)
        base.vbox(steps, speed, parent=self, margins=(0, 0, 0, 0), spacing=6)


MINUS, DEGREE = "\N{MINUS SIGN}", "\N{DEGREE SIGN}"
JOINTS = 6
PAD_LINES, PAD_TALL = 8, 1.1  # width of a pad in lines of text, height per width
MOVES = (
    ("+y", 0, 1), ("-x", 1, 0), ("+x", 1, 2), ("-y", 2, 1), ("+z", 0, 3), ("-z", 2, 3),
)  # fmt: skip
TURNS = tuple((f"{what[0]}r{what[1]}", row, column) for what, row, column in MOVES)
JOINT_PADS = tuple(
    (f"{sign}j{joint + 1}", joint // 2, 2 * (joint % 2) + at)
    for joint in range(JOINTS)
    for at, sign in enumerate("-+")
)


@dataclass(frozen=True, slots=True)
class PoseReadout:
    """Pose of the hand and remaining travel; ``note``: reason for slow or blocked motion.

    ``pose``: pose in the present frame with its unit, "" if unknown. ``rooms``: second line of the
    pads by direction, such as "+x" or "-j4". ``turned``: the hand is not level.
    """

    pose: str = ""
    age_s: float = 0.0
    rooms: tuple[tuple[str, str], ...] = ()
    note: str = ""
    warn: bool = False
    turned: bool = False


class JogPad(base.Panel):
    """Pads of one frame. A press is one step if a step is selected, else motion while it lasts."""

    hold_ended = Signal(str)
    step_pressed = Signal(str)

    def __init__(self, paces: Sequence[JogUnit], renew: Callable[[str], bool]) -> None:
        """Create the pads.

        ``paces`` holds the units of moving and of turning. ``renew`` is called repeatedly while a
        pad is held; it returns False to end the hold.
        """
        super().__init__("Jog")
        self.hold = HoldState(self, renew, self.hold_ended.emit)
        self.pads = {what: self._pad(what) for what, _, _ in (*MOVES, *TURNS, *JOINT_PADS)}
        self.frame = QComboBox()
        self.frame.addItems(["XYZ", "TOOL", "JOINT"])
        self.frame.setAccessibleName(base.tr("Jog frame"))
        tip = "Turn the hand about these axes instead of moving it (T)"
        self.turn = base.push_button("Turn", tip, role="choice", checkable=True)
        self.turn.setAccessibleName(base.tr("Turn the hand instead of moving it"))
        tip = "Turn the hand to straight down, in place (Shift+T)"
        self.level = base.push_button("Level", tip, role="header")
        self.level.setAccessibleName(base.tr("Level the hand"))
        self.keys = base.push_button("Keyboard jog", role="header", checkable=True)
        self.keys.setAccessibleName(base.tr("Jog with the keyboard"))
        self.pace = JogPace(paces)
        self.speed = self.pace.speed
        self.lift = base.push_button(role="primary")  # offered in contact
        self.lift.setAccessibleName(base.tr("Lift the hand out of contact"))
        self.lift.setProperty("low", "yes")
        self.lift.hide()
        self.joint = 1  # joint of the arrow keys in JOINT
        self._ready = self._turns = False
        self._ready_why: tuple[bool, str] | None = None
        self._pose, self._note = base.ElidedLabel(""), base.label("", "small")
        self._field = QWidget()
        self.level.setEnabled(False)
        self.frame.currentIndexChanged.connect(self._show_frame)
        self.turn.toggled.connect(self._show_frame)
        self._arrange()
        self.show_turning("")
        self._show_frame()
        self.show_look(PoseReadout())

    @property
    def turning(self) -> bool:
        """True while pads rotate: steps and speed are in degrees."""
        return self.frame.currentText() == "JOINT" or self.turn.isChecked()

    @property
    def shown(self) -> tuple[str, ...]:
        """Directions of the visible pads."""
        if self.frame.currentText() == "JOINT":
            return tuple(what for what, _, _ in JOINT_PADS)
        return tuple(what for what, _, _ in (TURNS if self.turn.isChecked() else MOVES))

    def show_turning(self, reason: str) -> None:
        """Offer rotation and JOINT; a ``reason`` disables them and is shown instead."""
        item = self.frame.model().item(2)  # type: ignore[attr-defined]
        item.setEnabled(not reason)
        item.setToolTip(base.tr(reason))
        tip = base.tr("XYZ: axes of the bench. TOOL: axes of the hand. JOINT: one joint. (F)")
        self.frame.setToolTip(f"{tip} {base.tr(reason)}".strip())
        self._turns = not reason
        self.turn.setVisible(self._turns and self.frame.currentText() != "JOINT")
        self.level.setVisible(not reason)

    def show_armed(self, armed: bool) -> None:
        """Highlight the panel while keys move the arm."""
        base.set_property(self, "armed", "yes" if armed else "no")
        self.keys.setChecked(armed)
        self.keys.setText(base.tr("Keyboard jog on" if armed else "Keyboard jog"))
        self._mark_joint()

    def show_ready(self, ready: bool, why: str) -> None:
        """Enable all pads, or disable them with the reason."""
        if (ready, why) == self._ready_why:
            return
        self._ready, self._ready_why = ready, (ready, why)
        for what, pad in self.pads.items():
            pad.setEnabled(ready)
            pad.setToolTip(base.tr("Jog {}", _signed(what)) if ready else base.tr(why))
        self.keys.setEnabled(ready)

    def show_lift(self, words: str) -> None:
        """Offer to lift the hand; "" hides the button."""
        self.lift.setVisible(bool(words))
        self.lift.setText(base.tr(words))

    def show_look(self, look: PoseReadout) -> None:
        """Show pose, remaining travel and note."""
        old = base.tr("   ({:.1f} s old)", look.age_s) if look.pose and look.age_s > 0.2 else ""
        pose = f"{look.pose}{old}" or base.tr("No pose yet")
        self._pose.setText(pose)
        self._pose.setToolTip(pose)
        self._note.setText(look.note)
        for what, room in look.rooms:
            text = f"{_signed(what)}\n{room}"
            if self.pads[what].text() != text:
                self.pads[what].setText(text)
                self.pads[what].setAccessibleDescription(room)
        base.set_property(self._note, "tone", "bad" if look.warn else "")
        self.level.setEnabled(look.turned and self._ready)

    def press_key(self, page: QWidget, what: str, key: int) -> None:
        """Step or hold by a key that means direction ``what``."""
        frame = self.frame.currentText()
        if frame == "JOINT":
            what = f"{what[0]}j{self.joint}"
        elif self.turn.isChecked():
            what = f"{what[0]}r{what[1]}"
        if not self._pressed_step(what):
            self.hold.press(page, what, key)

    def choose_joint(self, joint: int) -> None:
        """Select the joint of the arrow keys in JOINT; ends a hold."""
        self.hold.end("another joint was chosen")
        self.joint = joint
        self._mark_joint()

    def next_frame(self) -> None:
        """Select the next available frame."""
        offered = [i for i in range(3) if self.frame.model().item(i).isEnabled()]  # type: ignore[attr-defined]
        at = offered.index(self.frame.currentIndex())
        self.frame.setCurrentIndex(offered[(at + 1) % len(offered)])

    def event(self, event: QEvent) -> bool:
        """Keep the pads nearly square, also after a change of theme or text size."""
        done = super().event(event)
        if event.type() in (QEvent.Type.Resize, QEvent.Type.LayoutRequest):
            self._fit_pads()
        return done

    def _fit_pads(self) -> None:
        within = self.column.contentsRect().width()
        side = min(within / 4, PAD_LINES * self.fontMetrics().lineSpacing())
        most = QSize(round(4 * side), round(3 * PAD_TALL * side))
        self._field.setMaximumSize(most.expandedTo(self._field.minimumSizeHint()))

    def _show_frame(self) -> None:
        self.hold.end("the frame was changed")
        joint = self.frame.currentText() == "JOINT"
        self.turn.setVisible(self._turns and not joint)
        shown = self.shown
        for what, pad in self.pads.items():
            pad.setVisible(what in shown)
        self.pace.show_pace(int(self.turning))
        keys = base.tr("Digits choose a joint, arrows drive it") if joint else (
            base.tr("Arrows turn about X and Y, Page Up and Page Down about Z")
            if self.turning else base.tr("Arrows move X and Y, Page Up and Page Down move Z")
        )  # fmt: skip
        self.keys.setToolTip(base.tr("{} while this is on. It ends after 30 s without use.", keys))
        self._mark_joint()

    def _mark_joint(self) -> None:
        armed = self.keys.isChecked()
        for what, _, _ in JOINT_PADS:
            mark = armed and what[1:] == f"j{self.joint}"
            base.set_property(self.pads[what], "chosen", "yes" if mark else "no")

    def _pad(self, what: str) -> HoldButton:
        pad = HoldButton(
            _signed(what), what, base.tr("Jog {}", _signed(what)), self.hold, self._pressed_step
        )
        pad.setProperty("axis", what[-1] if what[1] != "j" else "")
        return pad

    def _pressed_step(self, what: str) -> bool:
        if self.pace.step is None:
            return False
        self.step_pressed.emit(what)
        return True

    def _arrange(self) -> None:
        base.add_items(self.header, self.level, self.keys)
        pads = QGridLayout(self._field)
        pads.setSpacing(4)
        for what, row, column in (*MOVES, *TURNS, *JOINT_PADS):
            pads.addWidget(self.pads[what], row, column)
        for row in range(3):
            pads.setRowStretch(row, 1)
        for column in range(4):
            pads.setColumnStretch(column, 1)
        pads.setContentsMargins(0, 2, 0, 2)
        self._note.setWordWrap(True)
        self._note.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        # The pose has a line of its own, which also holds the largest numbers.
        top = base.vbox(self._pose, base.hbox(1, self.turn, self.frame), spacing=0)
        middle = base.hbox(1, (self._field, 1000), 1)
        base.add_items(
            self.column, top, (middle, 1000), self.pace, base.hbox((self._note, 1), self.lift), 1
        )


def _signed(what: str) -> str:
    return f"{MINUS if what[0] == '-' else '+'}{what[1:].upper()}"
