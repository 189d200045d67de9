"""Live page: tactile images, force traces and freshness."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from PySide6.QtCore import QSize
from PySide6.QtGui import QFontMetrics, QResizeEvent
from PySide6.QtWidgets import QHBoxLayout, QScrollArea, QSizePolicy, QWidget

from touchdown.app.shell.activity import is_run_active
from touchdown.backend.bench import Session
from touchdown.backend.core import FINGERS, WRENCH_CHANNELS, Finger, MarkerField, TactileFrame
from touchdown.backend.devices import DeviceState
from touchdown.backend.sensing import has_moved
from touchdown.widgets import base
from touchdown.widgets.plots import TracePlot
from touchdown.widgets.views import TactileView

HEADER_PERIOD_S = 0.25
# A wrench that changes by less than this share of the shown range moves by a pixel or two.
STILL_SHARE = 0.03
NEWEST = 16  # wrench samples whose mean is compared
CALM_AFTER_S = 1.0  # time without motion


class LivePresenter:
    """Shows the newest samples of a bench in the views of one page."""

    def __init__(
        self, bench: Session, page: LivePage, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._bench, self._views, self._now_s = bench, page, now_s
        self._fresh = {finger: base.Freshness() for finger in FINGERS}
        self._wrench_fresh = base.Freshness()
        self._wrench_cursor = 0
        self.paused = False  # traces are paused; new samples are shown on resume
        self._at_rest, self._headers_s = False, float("-inf")
        # Time, fields and wrench of the last motion
        self._moved_s, self._rest_wrench = now_s(), np.full(WRENCH_CHANNELS, np.nan)
        self._rest: dict[Finger, MarkerField | None] = {}
        self._frame_cursor = dict.fromkeys(FINGERS, 0)
        self.frames_shown = dict.fromkeys(FINGERS, 0)
        # Functions that draw the live views, a few ms each.
        self.parts: Sequence[Callable[[], None]] = (
            *(partial(self.draw_finger, finger) for finger in FINGERS),
            self.draw_wrench,
            self.draw_headers,
        )

    def draw_finger(self, finger: Finger) -> None:
        """Update the tactile view of a finger."""
        view, stream = self._views.tactile[finger], self._bench.frames[finger]
        if not view.isVisible():
            return
        fresh, now_s = self._fresh[finger], self._now_s()
        fresh.note(stream.count, now_s)
        frames, cursor, _ = stream.since(self._frame_cursor[finger])
        if frames:
            # Of two frames, one is late: show both, one tick apart.
            frame = frames[0] if len(frames) == 2 else frames[-1]
            self._frame_cursor[finger] = cursor - (len(frames) == 2)
            if self._at_rest:
                # Of pictures that look the same, the one that is tracked.
                newest = self._bench.fields[finger].newest()
                tracked = (one for one in frames if newest and one.t_s == newest.t_s)
                frame = next(tracked, frame)
            view.show_frame(frame, self._field_of(finger, frame))
            self.frames_shown[finger] += 1
        view.show_age(fresh.judge(now_s), fresh.age_s(now_s), self._why_silent(finger))

    def _field_of(self, finger: Finger, frame: TactileFrame) -> MarkerField | None:
        """Return the field tracked in this frame, else the newest one."""
        stream = self._bench.fields[finger]
        same = stream.between(frame.t_s, frame.t_s)
        return same[-1] if same else stream.newest()

    def calm(self) -> bool:
        """Return True if neither bench, markers nor wrench have moved for a while."""
        bench, now_s = self._bench, self._now_s()
        fields = {finger: bench.fields[finger].newest() for finger in FINGERS}
        active = is_run_active(bench) or (bench.hand is not None and bench.hand.active)
        moved = any(has_moved(self._rest.get(finger), fields[finger]) for finger in FINGERS)
        newest = bench.wrench.since(bench.wrench.count - NEWEST).values
        if len(newest):
            mean, views = newest.mean(axis=0), self._views
            limits = STILL_SHARE * np.repeat([views.force.limit, views.moment.limit], 3)
            moved = moved or not (np.abs(mean - self._rest_wrench) <= limits).all()
        if active or moved:
            self._moved_s, self._rest = now_s, fields
            self._rest_wrench = mean if len(newest) else self._rest_wrench
        self._at_rest = now_s - self._moved_s >= CALM_AFTER_S
        return self._at_rest

    def draw_wrench(self) -> None:
        """Update the traces."""
        views, stream, now_s = self._views, self._bench.wrench, self._now_s()
        if not views.force.isVisible():
            return
        if self._wrench_fresh.note(stream.count, now_s) and not self.paused:
            self._feed()
        age, age_s = self._wrench_fresh.judge(now_s), self._wrench_fresh.age_s(now_s)
        for plot in (views.force, views.moment):
            plot.show_age(age, age_s, "The force/torque sensor has not sent a sample.")

    def _feed(self) -> None:
        samples = self._bench.wrench.since(self._wrench_cursor)
        if len(samples.t_s):
            self._views.force.add(samples.t_s, samples.values[:, :3])
            self._views.moment.add(samples.t_s, samples.values[:, 3:])
        self._wrench_cursor = samples.cursor

    def show_span(self, span_s: float) -> None:
        """Change the time span; redraw from the samples that the stream still holds."""
        for plot in (self._views.force, self._views.moment):
            plot.show_span(span_s)
        self._wrench_cursor = 0
        self._feed()

    def draw_headers(self) -> None:
        """Update the numbers in the headers four times a second."""
        now_s = self._now_s()
        if now_s - self._headers_s < HEADER_PERIOD_S:
            return
        self._headers_s = now_s
        for finger in FINGERS:
            self._show_header(finger)
        drift = self._bench.drift
        self._views.force.show_note("" if drift is None else drift.words())
        for plot in (self._views.force, self._views.moment):
            plot.setAccessibleDescription(plot.summary())

    def _show_header(self, finger: Finger) -> None:
        panel, device = (self._views.captions[finger], self._bench.devices.get(f"tactile_{finger}"))
        seen, total = self._views.tactile[finger].seen()
        if device is None or device.state is not DeviceState.READY or total == 0:
            panel.detail.setText("")
            return
        health = device.health
        lost = base.count_noun(health.lost, "frame")
        panel.detail.setToolTip(base.tr("markers seen, measured rate; {} lost", lost))
        panel.detail.setText(f"{seen}/{total}, {health.rate_hz:.1f} Hz")

    def _why_silent(self, finger: Finger) -> str:
        device = self._bench.devices.get(f"tactile_{finger}")
        if device is None:
            return base.tr("The bench is being prepared.")
        if device.state is not DeviceState.READY:
            return base.tr("The camera is {}.", base.tr(device.state.value))
        return base.tr("The camera has sent no frame for more than 2 s.")


Part = QWidget | QHBoxLayout


class WorkspacePage(QWidget):
    """Base class of the pages."""

    def __init__(self, theme: base.Theme) -> None:
        super().__init__()
        self.setObjectName("frame")
        self._theme = theme

    def heightForWidth(self, _width: int) -> int:
        """Return the minimum height, so that the views share the available height."""
        return self.minimumHeight()

    @property
    def em(self) -> int:
        """Height of the base font in px."""
        return QFontMetrics(base.ui_font(self._theme.scale)).height()

    @property
    def seen_px(self) -> int:
        """Height that is seen without scrolling; views that follow it do not hold the page up."""
        at = self.parentWidget()
        while at is not None and not isinstance(at, QScrollArea):
            at = at.parentWidget()
        return self.height() if at is None else min(self.height(), at.viewport().height())

    def fill(self, columns: QWidget) -> None:
        """Fill the page with its columns."""
        base.hbox(columns, parent=self, margins=(10, 8, 10, 8))


class LivePage(WorkspacePage):
    """Base class of pages with live views; subclasses arrange them.

    ``captions``: the framed view of each finger, whose header shows rate and markers.
    """

    columns: base.Columns
    captions: Mapping[Finger, base.Panel | base.CaptionedView]
    tactile_share = 0.45  # maximum share of the page height for the finger images

    def __init__(self, theme: base.Theme) -> None:
        super().__init__(theme)
        self.tactile: dict[Finger, TactileView] = {f: TactileView(theme, f) for f in FINGERS}
        self.force = TracePlot(theme, "Force", "F", "N", 10.0)
        self.moment = TracePlot(theme, "Moment", "T", "N\N{MIDDLE DOT}m", 0.2)

    def show_silent(self, why: str) -> None:
        """Show in the live views why there are no data yet."""
        views: tuple[TactileView | TracePlot, ...] = (
            *self.tactile.values(),
            self.force,
            self.moment,
        )
        for view in views:
            view.show_age(base.Age.NEVER, 0.0, why)

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Limit the height of the finger images."""
        super().resizeEvent(event)
        self._leave_room()

    def fit(self) -> None:
        """Fit the ranges of both plots."""
        self.force.fit()
        self.moment.fit()

    def stand_in(self, columns: base.Columns, traces: str) -> None:
        """Fill the page; ``traces`` is the title of the panel below the fingers."""
        self.columns, self._traces = columns, traces
        columns.arranged.connect(self._leave_room)
        self.fill(columns)

    def _leave_room(self) -> None:
        share = 1.0 if self.columns.hides(self._traces) else self.tactile_share
        for view in self.tactile.values():
            view.limit_height(round(share * self.seen_px))


def limit_height(panel: QWidget) -> None:
    """Limit the height of a panel to that of its views."""
    panel.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Maximum)


class PageColumn(QWidget):
    """Column of a page: at least ``least_px`` wide, and as wide as its views need."""

    least_px = 0

    def minimumSizeHint(self) -> QSize:
        """Return the size that views and least width need."""
        return super().minimumSizeHint().expandedTo(QSize(self.least_px, 0))


def column_of(*parts: tuple[Part, int]) -> PageColumn:
    """Return a column of (view, stretch)."""
    holder = PageColumn()
    # The last item takes the remaining height when the stretching views are hidden.
    base.vbox(*parts, 0, parent=holder, margins=(0, 0, 0, 0), spacing=8)
    return holder
