"""Connection panel: its sheet and its presenter, and the dialogs of a bench."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from PySide6.QtCore import QRect, Qt, Signal
from PySide6.QtWidgets import QGridLayout, QLabel, QPushButton, QWidget

from touchdown.app.calibrate import CalibratePresenter
from touchdown.app.connect.devices import DevicesPresenter
from touchdown.app.connect.limits import LimitsPresenter
from touchdown.app.shell import BenchSheet, QuestionRow, carry_out, is_run_active
from touchdown.backend.bench import Session
from touchdown.backend.core import RefusedError
from touchdown.backend.devices import CONNECTION_STEPS
from touchdown.backend.rig import BenchConnection, DeviceStatus
from touchdown.widgets.base import Theme, label, push_button, rule, set_property, tr
from touchdown.widgets.shell import DEVICE_CHIPS, FaultCards

MARKS = {
    "done": "\N{CHECK MARK}",
    "now": "\N{HORIZONTAL ELLIPSIS}",
    "failed": "\N{MULTIPLICATION X}",
    "open": "\N{MIDDLE DOT}",
}
TALLEST_PX = 10_000
TONES = {"done": "good", "failed": "bad"}


@dataclass(frozen=True, slots=True)
class DeviceRowView:
    """One device: ``marks`` of its steps (done, now, failed, open), a sentence, its buttons.

    ``label`` is the text of the first button, ``extra`` that of the second, "" without one.
    """

    title: str
    state: str
    marks: tuple[str, ...]
    text: str
    bad: bool
    label: str
    can: bool
    extra: str = ""


@dataclass(frozen=True, slots=True)
class ConnectView:
    """State of the connection panel."""

    head: str
    text: str
    rows: tuple[DeviceRowView, ...]
    busy: bool
    can: bool


@dataclass(slots=True)
class _DeviceRow:
    name: QLabel
    state: QLabel
    marks: list[QLabel]
    text: QLabel
    button: QPushButton
    extra: QPushButton
    shown: DeviceRowView | None = field(default=None)


class ConnectSheet(BenchSheet):
    """Connection panel."""

    row_pressed = Signal(int)
    extra_pressed = Signal(int)

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent, "Connect")
        self.head, self.text = label("", "head"), label("", wrap=True)
        self.question = QuestionRow()
        self._grid = QGridLayout()
        self._grid.setHorizontalSpacing(16)
        self._grid.setVerticalSpacing(8)
        self._grid.setColumnStretch(len(CONNECTION_STEPS) + 2, 1)
        self._rows: list[_DeviceRow] = []
        tip = "One after the other, the arm last; nothing moves"
        self.connect_all = push_button("Connect all", tip, role="primary")
        self.cancel = push_button("Cancel", "End connecting; what is connected stays so")
        tip = "First the arm goes off; the gripper keeps its grip"
        self.disconnect_all = push_button("Disconnect all", tip)
        tip = "Choose makes, ports and cameras, and save the lab file"
        self.devices, self.limits = push_button("Devices", tip), push_button("Limits")
        foot = (self.connect_all, self.cancel, self.disconnect_all, self.devices, self.limits)
        self.arrange(
            self.head, self.text, rule(), self._grid, self.question, 1, foot=foot, spacing=10
        )
        self.give_width(64)

    def show_look(self, look: ConnectView) -> None:
        """Update the panel."""
        self.head.setText(tr(look.head))
        self.text.setText(tr(look.text))
        if len(look.rows) != len(self._rows):
            self._build(look.rows)
        for row, shown in zip(self._rows, look.rows, strict=True):
            if row.shown != shown:
                row.shown = shown
                self._show_row(row, shown)
        self.connect_all.setEnabled(look.can and not look.busy)
        self.cancel.setEnabled(look.busy)
        self.disconnect_all.setEnabled(look.can and not look.busy)

    def row(self, index: int) -> tuple[str, str, QPushButton, QPushButton]:
        """Return (state, sentence, first button, second button) of a device."""
        row = self._rows[index]
        return row.state.text(), row.text.text(), row.button, row.extra

    # -- inside -----------------------------------------------------------------------------------

    def _build(self, looks: Sequence[DeviceRowView]) -> None:
        for column, step in enumerate(CONNECTION_STEPS):
            self._grid.addWidget(label(step, "small"), 0, column + 2)
        for index, look in enumerate(looks):
            row = _DeviceRow(
                label(look.title, "title"),
                label("", "muted"),
                [label("") for _ in CONNECTION_STEPS],
                label("", wrap=True),
                QPushButton(tr("Connect"), autoDefault=False),
                QPushButton("", autoDefault=False),
            )
            row.button.clicked.connect(partial(self.row_pressed.emit, index))
            row.extra.clicked.connect(partial(self.extra_pressed.emit, index))
            widgets = (row.name, row.state, *row.marks, row.text, row.extra, row.button)
            for column, widget in enumerate(widgets):
                self._grid.addWidget(widget, index + 1, column)
                if isinstance(widget, QLabel) and widget in row.marks:
                    self._grid.setAlignment(widget, Qt.AlignmentFlag.AlignHCenter)
            self._rows.append(row)

    def _show_row(self, row: _DeviceRow, look: DeviceRowView) -> None:
        row.state.setText(tr(look.state))
        for mark, word, step in zip(row.marks, look.marks, CONNECTION_STEPS, strict=True):
            mark.setText(MARKS[word])
            mark.setAccessibleName(f"{tr(look.title)}, {tr(step)}: {tr(word)}")
            set_property(mark, "tone", TONES.get(word, ""))
        row.text.setText(tr(look.text))
        # A label in a grid does not request the height of its wrapped text.
        metrics, least = self.fontMetrics(), 3 if look.bad else 2
        room = QRect(0, 0, (25 if look.extra else 30) * metrics.height(), TALLEST_PX)
        high = metrics.boundingRect(room, Qt.TextFlag.TextWordWrap, look.text).height()
        row.text.setMinimumHeight(max(high, least * metrics.lineSpacing()) + 2)
        set_property(row.text, "tone", "bad" if look.bad else "")
        row.button.setText(tr(look.label))
        row.button.setAccessibleName(f"{tr(look.label)} {tr(look.title)}")
        row.button.setEnabled(look.can)
        row.extra.setVisible(bool(look.extra))
        row.extra.setText(tr(look.extra))
        row.extra.setAccessibleName(f"{tr(look.extra)} {tr(look.title)}")
        row.extra.setEnabled(look.can)


PERIOD_S = 0.1
TITLES = dict(DEVICE_CHIPS)
EXTRA = {"": "", "home": "Home", "acknowledge": "Acknowledge"}
NOTHING_MOVES = "Nothing moves while connecting. The arm is switched on last and does not move."


class ConnectPresenter:
    """Presents the connection of devices that are connected by hand."""

    def __init__(
        self,
        bench: Session,
        connection: BenchConnection,
        window: QWidget,
        cards: FaultCards,
        limits: LimitsPresenter,
    ) -> None:
        self._bench, self._connection, self._cards = bench, connection, cards
        self.devices = DevicesPresenter(bench, window)
        self.sheet = sheet = ConnectSheet(window)
        sheet.connect_all.clicked.connect(self._connect)
        sheet.cancel.clicked.connect(connection.cancel)
        sheet.disconnect_all.clicked.connect(lambda: self._ordered(lambda: self._leave(())))
        sheet.row_pressed.connect(self._row)
        sheet.extra_pressed.connect(self._extra)
        sheet.limits.clicked.connect(limits.open)
        sheet.devices.clicked.connect(self.devices.open)
        self._drawn_s = float("-inf")

    def open(self) -> None:
        """Show the panel. If it is visible, connect, or cancel a connection in progress."""
        if not self.sheet.isVisible():
            self.draw(at_once=True)
            self.sheet.present()
        elif self._connection.busy:
            self._connection.cancel()
        else:
            self._connect()

    def draw(self, *, at_once: bool = False) -> None:
        """Update the panel ten times a second while it is open."""
        now_s = time.monotonic()
        if not at_once and (not self.sheet.isVisible() or now_s - self._drawn_s < PERIOD_S):
            return
        self._drawn_s = now_s
        self.sheet.show_look(self._look())

    # -- orders -----------------------------------------------------------------------------------

    def _connect(self) -> None:
        self._ordered(lambda: self._begin(()))

    def _begin(self, names: tuple[str, ...]) -> None:
        if self._bench.interlock.stopped_by:
            raise RefusedError("NOT-RESET", "The bench is stopped: press Reset, then connect.")
        self._connection.begin(names)

    def _leave(self, names: tuple[str, ...]) -> None:
        # Nothing may move without all devices.
        self._bench.leave_scene()
        self._connection.disconnect(names)

    def _row(self, index: int) -> None:
        line = self._connection.lines()[index]
        order = self._leave if line.state == "ready" else self._begin
        self._ordered(lambda: order((line.name,)))

    def _extra(self, index: int) -> None:
        needs = self._connection.lines()[index].needs
        if needs == "home":
            text, yes = "Homing moves the jaws to their end. Are they empty?", "Home the gripper"
            order = self._bench.home_gripper
        else:
            text, yes = "Have you looked at the gripper and the piece?", "Acknowledge"
            order = self._connection.acknowledge
        self.sheet.question.ask(text, "Not yet", yes, lambda: self._ordered(order))

    def _ordered(self, order: Callable[[], None]) -> None:
        carry_out(order, self._cards)
        self.draw(at_once=True)

    # -- showing ----------------------------------------------------------------------------------

    def _look(self) -> ConnectView:
        connection, lines = self._connection, self._connection.lines()
        can = not is_run_active(self._bench)
        store, free = self._bench.calibrations, can and not connection.busy
        gels = {} if store is None else store.gels.texts()
        rows = tuple(device_row(one, can=free, gel=gels.get(one.name, "")) for one in lines)
        emulated = self._bench.description.mode == "emulated"
        kind = tr("emulated bench" if emulated else "real devices")
        return ConnectView(
            f"{self._bench.name} ({kind})", self._text(lines), rows, connection.busy, can
        )

    def _text(self, lines: tuple[DeviceStatus, ...]) -> str:
        ready = sum(line.state == "ready" for line in lines)
        trouble = self._connection.trouble
        if trouble is not None:
            return str(trouble)
        if not self._connection.busy and any(line.needs for line in lines):
            return tr("The gripper needs you: see its row.")
        if not self._connection.busy and ready == len(lines):
            return tr("All devices are ready.")
        return f"{tr('{} of {} connected.', ready, len(lines))} {tr(NOTHING_MOVES)}"


def device_row(line: DeviceStatus, *, can: bool, gel: str = "") -> DeviceRowView:
    """Return the row of one device; ``gel``: life of its gel."""
    failed = line.state == "failed"
    present = {"connecting": "now", "failed": "failed"}.get(line.state, "open")
    marks = [
        "done" if step < line.steps else "open" if step > line.steps else present
        for step in range(len(CONNECTION_STEPS))
    ]
    if failed and line.steps == len(CONNECTION_STEPS):
        # A lost device is missing its samples.
        marks[-1] = "failed"
    text = ""
    if line.fault is not None:
        text = f"{line.fault.what} {line.fault.next_step}".strip()
    elif line.identity is not None:
        who = line.identity
        text = f"{who.maker} {who.model}, {who.serial}"
        text = ". ".join(filter(None, (text, gel, line.notice)))
    word = "Disconnect" if line.state == "ready" else "Retry" if failed else "Connect"
    return DeviceRowView(
        TITLES.get(line.name, line.name), line.state, tuple(marks), text,
        line.fault is not None or bool(line.notice), word, can, EXTRA[line.needs],
    )  # fmt: skip


class BenchDialogs:
    """Dialogs of a bench: connection, limits, calibration."""

    def __init__(
        self, bench: Session, theme: Theme, window: QWidget, cards: FaultCards,
        open_bench: Callable[[Path], None],
    ) -> None:  # fmt: skip
        self.calibrate = CalibratePresenter(bench, theme, window, cards)
        self.calibrate.open_bench = open_bench
        self.limits = LimitsPresenter(bench, window, cards)
        self.connect: ConnectPresenter | None = None
        if bench.connection is not None:
            self.connect = ConnectPresenter(bench, bench.connection, window, cards, self.limits)
            self.connect.devices.open_bench = open_bench

    def open_connect(self) -> bool:
        """Show the connection panel, connect or cancel; return False without such a panel."""
        if self.connect is None:
            return False
        self.connect.open()
        return True

    def draw(self) -> None:
        """Update the open dialogs."""
        self.calibrate.draw()
        if self.connect is not None:
            self.connect.draw()
