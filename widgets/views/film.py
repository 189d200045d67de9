"""Recorded film with its time line."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from PySide6.QtCore import QElapsedTimer, QPointF, QRectF, QSize, Qt, QTimer, Signal
from PySide6.QtGui import QMouseEvent, QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QGridLayout, QSizePolicy, QWidget

from touchdown.backend import core
from touchdown.widgets.base import Age, Theme, blend, label, tr, ui_font
from touchdown.widgets.plots import PlotArea, nice_step, tick_text, ticks
from touchdown.widgets.views.tactile import IMAGE_H, IMAGE_W, TactileView

TICK_MS = 33
NOT_RECORDED = "No picture recorded"
GROUND = 40  # grey of a frame without a picture


@dataclass(frozen=True, slots=True)
class FilmTrack:
    """Recording of one finger: ``picture_t_s`` (n,), access to picture i, ``fields`` in time order.

    All times are relative to the contact onset. Without pictures the arrows are drawn on grey.
    """

    picture_t_s: core.FloatArray
    picture: Callable[[int], core.ImageArray]
    field_t_s: core.FloatArray
    fields: Sequence[core.MarkerField]


Reel = Mapping[core.Finger, FilmTrack]


def latest(t_s: core.FloatArray, cursor_s: float) -> int:
    """Return the index of the newest sample at or before the cursor, -1 before the first."""
    return int(np.searchsorted(t_s, cursor_s + 1e-9, side="right")) - 1


class FilmView(QWidget):
    """Player of a reel; ``seek`` gets the time when playing or stepping moves the cursor.

    ``ran`` is emitted with True when playing starts and False when it stops.
    """

    ran = Signal(bool)

    def __init__(self, theme: Theme, seek: Callable[[float], None]) -> None:
        super().__init__()
        self._seek = seek
        self._reel: Reel = {}
        self._span_s = (0.0, 2.0)
        self.cursor_s = 0.0
        self.views = {finger: TactileView(theme, finger) for finger in core.FINGERS}
        for view in self.views.values():
            view.never = view.gone = NOT_RECORDED
        self.notes = {finger: label("", "small") for finger in core.FINGERS}
        grid = QGridLayout(self)
        grid.setContentsMargins(0, 0, 0, 0)
        grid.setSpacing(4)
        for column, finger in enumerate(core.FINGERS):
            grid.addWidget(self.notes[finger], 0, column)
            grid.addWidget(self.views[finger], 1, column)
            grid.setColumnStretch(column, 1)
        self._clock = QElapsedTimer()
        self._from_s = 0.0
        self._timer = QTimer(self, interval=TICK_MS)
        self._timer.timeout.connect(self._turn)

    @property
    def playing(self) -> bool:
        """True while the film plays."""
        return self._timer.isActive()

    def show_none(self) -> None:
        """Show an empty view: no probe is selected."""
        self.take_reel({}, (0.0, 2.0))
        for finger, view in self.views.items():
            self.notes[finger].setText("")
            view.gone = view.never = ""
            view.show_age(Age.GONE, 0.0, "")

    def limit_height(self, limit_px: int) -> None:
        """Limit the height of the pictures, to leave room for the views below."""
        for view in self.views.values():
            view.limit_height(limit_px)

    def take_reel(self, reel: Reel, span_s: tuple[float, float]) -> None:
        """Set another probe; the next ``show_cursor`` draws it."""
        self.stop()
        self._reel, self._span_s = reel, span_s
        for view in self.views.values():
            view.never = view.gone = NOT_RECORDED

    def show_cursor(self, t_s: float) -> None:
        """Show the newest frame of each finger at this time."""
        self.cursor_s = t_s
        for finger in core.FINGERS:
            self._show_finger(finger, self._reel.get(finger))

    def play_or_pause(self) -> None:
        """Play from the cursor, or from the start if it is at the end; or pause."""
        if self._timer.isActive():
            self.stop()
            return
        at_end = self.cursor_s >= self._span_s[1] - 1e-6
        self._from_s = self._span_s[0] if at_end else self.cursor_s
        self._clock.start()
        self._timer.start()
        self.ran.emit(True)

    def stop(self) -> None:
        """Stop playing."""
        self._timer.stop()
        self.ran.emit(False)

    def step(self, by: int) -> None:
        """Move the cursor to the next (1) or previous (-1) frame of any finger."""
        self.stop()
        tracks = self._reel.values()
        stamps = np.unique([
            t_s for one in tracks
            for t_s in (one.picture_t_s if len(one.picture_t_s) else one.field_t_s)
        ])  # fmt: skip
        if by > 0:
            found = stamps[stamps > self.cursor_s + 1e-9][:1]
        else:
            found = stamps[stamps < self.cursor_s - 1e-9][-1:]
        if len(found):
            self._seek(float(found[0]))

    def _turn(self) -> None:
        at_s = self._from_s + self._clock.elapsed() * 1e-3
        if at_s >= self._span_s[1]:
            self.stop()
        self._seek(min(at_s, self._span_s[1]))

    def _show_finger(self, finger: core.Finger, track: FilmTrack | None) -> None:
        view, note = self.views[finger], self.notes[finger]
        field = None
        if track is not None:
            at = latest(track.field_t_s, self.cursor_s)
            field = track.fields[at] if at >= 0 else None
        index = latest(track.picture_t_s, self.cursor_s) if track is not None else -1
        if track is None or (field is None and index < 0):
            view.show_age(Age.GONE, 0.0, "Nothing was recorded at this time.")
            note.setText(tr(finger))
            return
        view.show_age(Age.FRESH, 0.0, "")
        if index >= 0:
            image, t_s = track.picture(index), float(track.picture_t_s[index])
            note.setText(tr("{}, frame {} of {}", tr(finger), index + 1, len(track.picture_t_s)))
        else:
            image = np.full((IMAGE_H, IMAGE_W, 3), GROUND, dtype=np.uint8)
            t_s = self.cursor_s
            kept = len(track.picture_t_s) > 0
            why = "{}, before the first picture" if kept else "{}, no picture kept"
            note.setText(tr(why, tr(finger)))
        view.show_frame(core.TactileFrame(finger, index, t_s, image), field)


@dataclass(frozen=True, slots=True)
class TimeMark:
    """Event on the time line, or a ``note``; ``strong``: drawn at full height with its word."""

    t_s: float
    word: str
    strong: bool = False
    note: bool = False


@dataclass(frozen=True, slots=True)
class TimeScene:
    """Time span, recorded intervals and events in time order."""

    span_s: tuple[float, float] = (0.0, 0.0)
    recorded_s: tuple[tuple[float, float], ...] = ()
    marks: tuple[TimeMark, ...] = ()


class TimeLine(QWidget):
    """Time line of a ``TimeScene``; ``seek`` gets the pressed or dragged time."""

    def __init__(self, theme: Theme, seek: Callable[[float], None]) -> None:
        super().__init__()
        self._theme, self._seek = theme, seek
        self.scene, self.cursor_s = TimeScene(), 0.0
        self.setAccessibleName(tr("Time line"))
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self.setAttribute(Qt.WidgetAttribute.WA_OpaquePaintEvent)

    def sizeHint(self) -> QSize:
        """Return three lines of text."""
        return QSize(400, round(3.6 * self.fontMetrics().height()))

    def show_scene(self, scene: TimeScene) -> None:
        """Show another span."""
        self.scene = scene
        self.update()

    def show_cursor(self, t_s: float) -> None:
        """Move the cursor."""
        self.cursor_s = t_s
        self.setAccessibleDescription(tr("{:.2f} s of {:.2f} s", t_s, self.scene.span_s[1]))
        self.update()

    def area(self) -> PlotArea:
        """Return the area of the line; an empty span is drawn as one second."""
        em = self.fontMetrics().height()
        low, high = self.scene.span_s
        rect = QRectF(10, 1.3 * em, max(self.width() - 20.0, 10.0), self.height() - 2.6 * em)
        return PlotArea(rect, low, max(high, low + 1.0), 0.0, 1.0)

    def mousePressEvent(self, event: QMouseEvent) -> None:
        """Move the cursor to the pressed or dragged time."""
        if event.buttons() & Qt.MouseButton.LeftButton:
            low, high = self.scene.span_s
            self._seek(min(max(self.area().at(event.position())[0], low), high))

    mouseMoveEvent = mousePressEvent  # noqa: N815

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw recorded intervals, events with the words that fit, times, and the cursor."""
        painter, t, area = QPainter(self), self._theme.tokens, self.area()
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.fillRect(self.rect().adjusted(0, 0, 1, 1), t.colour("panel"))
        painter.setFont(ui_font(self._theme.scale, 0.8))
        painter.fillRect(area.rect, t.colour("bg"))
        shade = blend(t.colour("bg"), t.colour("axis_x"), 0.4)
        for start, end in self.scene.recorded_s:
            left, rect = area.x(start), QRectF(area.rect)
            rect.setLeft(left)
            rect.setRight(max(area.x(end), left + 2.0))
            painter.fillRect(rect, shade)
        painter.setPen(QPen(t.colour("border"), 1))
        painter.drawRect(area.rect)
        if self.scene.span_s[1] <= self.scene.span_s[0]:
            return
        self._draw_marks(painter, area)
        self._draw_times(painter, area)
        x = area.x(self.cursor_s)
        painter.setPen(QPen(t.colour("focus"), 2.5))
        painter.drawLine(QPointF(x, area.rect.top() - 5), QPointF(x, area.rect.bottom() + 5))

    def _draw_marks(self, painter: QPainter, area: PlotArea) -> None:
        t, free = self._theme.tokens, area.rect.left() - 1.0
        metrics = painter.fontMetrics()
        for mark in self.scene.marks:
            x, half = area.x(mark.t_s), 0.5 * area.rect.height()
            ink = "focus" if mark.note else "text" if mark.strong else "muted"
            painter.setPen(QPen(t.colour(ink), 3.0 if mark.note else 1.4))
            top = area.rect.top() if mark.strong else area.rect.top() + half
            painter.drawLine(QPointF(x, top), QPointF(x, area.rect.bottom()))
            width = metrics.horizontalAdvance(mark.word) + 4.0
            left = min(max(x - width / 2, area.rect.left()), area.rect.right() - width)
            if mark.strong and left >= free:
                free = left + width + 4
                box = QRectF(left, 0, width, area.rect.top() - 1)
                painter.drawText(box, int(Qt.AlignmentFlag.AlignCenter), mark.word)

    def _draw_times(self, painter: QPainter, area: PlotArea) -> None:
        painter.setPen(self._theme.tokens.colour("muted"))
        step = nice_step(area.x1 - area.x0, 8)
        top, height = area.rect.bottom() + 6, painter.fontMetrics().height()
        for value in ticks(area.x0, area.x1, 8):
            text = f"{tick_text(value, step)} s"
            width = painter.fontMetrics().horizontalAdvance(text) + 2.0
            # Keeps the outermost labels inside the widget.
            left = min(max(area.x(value) - width / 2, 0.0), self.width() - width)
            box = QRectF(left, top, width, height)
            painter.drawText(box, int(Qt.AlignmentFlag.AlignHCenter), text)
