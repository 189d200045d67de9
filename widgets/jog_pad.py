"""Jogging: hold-to-run pads and steps, frame and speed, pose with age, room to the limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from PySide6.QtCore import Qt
from PySide6.QtWidgets import (
    QButtonGroup,
    QComboBox,
    QDoubleSpinBox,
    QGridLayout,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QSizePolicy,
    QSlider,
    QWidget,
)

from widgets.elided import ElidedLabel
from widgets.hold_button import Hold, HoldButton
from widgets.panel import Panel, label, set_property

MINUS = "\N{MINUS SIGN}"
SLOWEST_MM_S, FASTEST_MM_S, USUAL_MM_S = 1.0, 50.0, 20.0
HOLD = "hold"
PLACES = (
    ("+y", 0, 1), ("-x", 1, 0), ("+x", 1, 2), ("-y", 2, 1), ("+z", 0, 3), ("-z", 2, 3),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class PoseLook:
    """Present pose and the room each way, in mm; ``note`` says why it is slow, or why not at all.

    ``room_mm`` by axis and sign such as "+x"; empty while nothing is known.
    """

    pose_mm: tuple[float, float, float] | None = None
    age_s: float = 0.0
    room_mm: tuple[tuple[str, float], ...] = ()
    note: str = ""
    warn: bool = False


class JogPad(Panel):
    """Six pads. With a step chosen a press is one step; otherwise the motion lasts as the press."""

    def __init__(
        self,
        steps_mm: Sequence[float],
        renew: Callable[[str], bool],
        ended: Callable[[str], None],
        step: Callable[[str], None],
        arm_keys: Callable[[bool], None],
    ) -> None:
        super().__init__("Jog")
        self._step = step
        self.hold = Hold(self, renew, ended)
        self.pads = {what: self._pad(what) for what, _, _ in PLACES}
        self.frame = QComboBox()
        self.frame.addItems(["XYZ", "TOOL", "JOINT"])
        self.frame.setAccessibleName("Jog frame")
        self.frame.setToolTip("XYZ: axes of the bench. TOOL: axes of the hand. (F)")
        self._steps = self._step_buttons(steps_mm)
        self.speed, self._slider = QDoubleSpinBox(), QSlider(Qt.Orientation.Horizontal)
        self.keys = QPushButton("Arm keys")
        self.keys.setCheckable(True)
        self.keys.setAccessibleName("Arm the jog keys")
        self.keys.setToolTip("Arrows move X and Y, Page Up and Page Down move Z while this is on. "
                             "It ends after 30 s without use.")  # fmt: skip
        self.keys.toggled.connect(arm_keys)
        self._pose, self._note = ElidedLabel(""), label("", "small")
        self._wire_speed()
        self._arrange()
        self.show_look(PoseLook())

    @property
    def step_mm(self) -> float | None:
        """The chosen step, None while pads are held."""
        at = self._chosen()
        return None if at == 0 else float(self._steps[at].text())

    def show_joint_reason(self, reason: str) -> None:
        """Offer JOINT only where it can be had; else say why not ("" offers it)."""
        item = self.frame.model().item(2)  # type: ignore[attr-defined]
        item.setEnabled(not reason)
        item.setToolTip(reason)
        self.frame.setToolTip(f"{self.frame.toolTip()} {reason}".strip())

    def show_armed(self, armed: bool) -> None:
        """Show the ring round the panel while keys move the arm."""
        set_property(self, "armed", "yes" if armed else "no")
        if self.keys.isChecked() != armed:
            self.keys.setChecked(armed)
        self.keys.setText("Keys armed" if armed else "Arm keys")

    def show_ready(self, ready: bool, why: str) -> None:
        """Switch all pads off with the reason, or on."""
        for what, pad in self.pads.items():
            if pad.isEnabled() != ready:
                pad.setEnabled(ready)
            pad.setToolTip(f"Jog {what.upper()}" if ready else why)
        if self.keys.isEnabled() != ready:
            self.keys.setEnabled(ready)

    def show_look(self, look: PoseLook) -> None:
        """Show pose, room and note."""
        if look.pose_mm is None:
            pose = "No pose yet"
        else:
            x, y, z = (f"{v:.1f}".replace("-", MINUS) for v in look.pose_mm)
            pose = f"X {x}   Y {y}   Z {z} mm"
            if look.age_s > 0.2:
                pose += f"   ({look.age_s:.1f} s old)"
        for shown, text in ((self._pose, pose), (self._note, look.note)):
            if shown.text() != text:
                shown.setText(text)
        for what, room_mm in look.room_mm:
            text = f"{_signed(what)}\n{room_mm:.0f} mm"
            if self.pads[what].text() != text:
                self.pads[what].setText(text)
                self.pads[what].setAccessibleDescription(f"{room_mm:.0f} mm to the limit")
        set_property(self._note, "tone", "bad" if look.warn else "")

    def press_key(self, page: QWidget, what: str, key: int) -> None:
        """Step, or begin to hold, by a key."""
        if not self._pressed_step(what):
            self.hold.press(page, what, key)

    def next_step(self, by: int) -> None:
        """Choose the next longer or shorter step; before the shortest is hold-to-run."""
        at = self._chosen()
        self._steps[min(max(at + by, 0), len(self._steps) - 1)].setChecked(True)

    def next_frame(self) -> None:
        """Choose the other frame that can be had."""
        self.frame.setCurrentIndex(1 - min(self.frame.currentIndex(), 1))

    # -- inside -----------------------------------------------------------------------------------

    def _chosen(self) -> int:
        return next((i for i, button in enumerate(self._steps) if button.isChecked()), 0)

    def _pad(self, what: str) -> HoldButton:
        pad = _Pad(_signed(what), what, f"Jog {_signed(what)}", self.hold, self._pressed_step)
        pad.setProperty("axis", what[1])
        return pad

    def _pressed_step(self, what: str) -> bool:
        """Take a press as one step if a step is chosen."""
        if self.step_mm is None:
            return False
        self._step(what)
        return True

    def _step_buttons(self, steps_mm: Sequence[float]) -> list[QPushButton]:
        group, made = QButtonGroup(self), []
        for text in ("Hold", *(f"{step:g}" for step in steps_mm)):
            button = QPushButton(text)
            button.setProperty("role", "choice")
            button.setCheckable(True)
            name = "Hold to run" if text == "Hold" else f"Step of {text} mm"
            button.setAccessibleName(name)
            button.setToolTip(f"{name} ([ and ])")
            group.addButton(button)
            made.append(button)
        made[0].setChecked(True)
        return made

    def _wire_speed(self) -> None:
        self.speed.setRange(SLOWEST_MM_S, FASTEST_MM_S)
        self.speed.setDecimals(0)
        self.speed.setSuffix(" mm/s")
        self.speed.lineEdit().setTextMargins(6, 0, 0, 0)
        self.speed.setAccessibleName("Jog speed")
        self._slider.setRange(int(SLOWEST_MM_S), int(FASTEST_MM_S))
        self._slider.setAccessibleName("Jog speed")
        for widget in (self.speed, self._slider):
            widget.setToolTip("Near the surface and in contact it is 2 mm/s at most")
        self.speed.valueChanged.connect(self._follow_spin)
        self._slider.valueChanged.connect(self._follow_slider)
        self.speed.setValue(USUAL_MM_S)

    def _follow_spin(self, value: float) -> None:
        self._slider.setValue(round(value))

    def _follow_slider(self, value: int) -> None:
        self.speed.setValue(value)

    def _arrange(self) -> None:
        self.header.addWidget(self.keys)
        top, speed, steps = QHBoxLayout(), QHBoxLayout(), QHBoxLayout()
        top.addWidget(self._pose, 1)
        top.addWidget(self.frame)
        speed.addWidget(_buddy("Speed", self.speed))
        speed.addWidget(self._slider, 1)
        speed.addWidget(self.speed)
        steps.setSpacing(4)
        for button in self._steps:
            steps.addWidget(button, 1)
        unit = label("mm", "muted")
        steps.addWidget(unit)
        pads = QGridLayout()
        pads.setSpacing(4)
        for what, row, column in PLACES:
            pads.addWidget(self.pads[what], row, column)
        for row in range(3):
            pads.setRowStretch(row, 1)
        for column in range(4):
            pads.setColumnStretch(column, 1)
        pads.setContentsMargins(0, 2, 0, 2)
        self.column.addLayout(top)
        self.column.addLayout(pads, 1)
        self.column.addLayout(steps)
        self.column.addLayout(speed)
        self._note.setWordWrap(True)
        self._note.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.column.addWidget(self._note)


class _Pad(HoldButton):
    """A pad that can be a step button as well."""

    def __init__(
        self, text: str, what: str, name: str, hold: Hold, step: Callable[[str], bool]
    ) -> None:
        super().__init__(text, what, name, hold)
        self._as_step = step

    def begin(self, source: int) -> None:
        """Step, or begin to hold."""
        if not self._as_step(self._what):
            super().begin(source)


def _signed(what: str) -> str:
    return f"{MINUS if what[0] == '-' else '+'}{what[1].upper()}"


def _buddy(text: str, field: QWidget) -> QLabel:
    made = label(text, "muted")
    made.setBuddy(field)
    return made
