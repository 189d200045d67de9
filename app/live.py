"""Presenter: streams to live views. Runs on the pump, reads snapshots, never waits."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from app.chips import lost_words
from app.link import Link
from backend.core.flow import FINGERS, Finger, MarkerField, TactileFrame
from backend.devices.protocols import DeviceState
from widgets.force_traces import TracePlot
from widgets.freshness import Freshness
from widgets.panel import Captioned, Panel
from widgets.tactile_view import TactileView

HEADER_PERIOD_S = 0.25


@dataclass(frozen=True, slots=True)
class LiveViews:
    """The views of one page that follow the sensors."""

    tactile: Mapping[Finger, TactileView]
    panels: Mapping[Finger, Panel | Captioned]
    force: TracePlot
    moment: TracePlot


class LivePresenter:
    """Moves the newest samples of a bench into the views of one page."""

    def __init__(
        self, link: Link, views: LiveViews, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._link, self._views, self._now_s = link, views, now_s
        self._fresh = {finger: Freshness() for finger in FINGERS}
        self._wrench_fresh = Freshness()
        self._wrench_cursor = 0
        self.paused = False
        """Traces stand still; what arrives meanwhile is shown when they go on."""
        self._headers_s = float("-inf")
        self._frame_cursor = dict.fromkeys(FINGERS, 0)
        self.frames_shown = dict.fromkeys(FINGERS, 0)

    def draw_left(self) -> None:
        """Update the left tactile view."""
        self._draw_finger("left")

    def draw_right(self) -> None:
        """Update the right tactile view."""
        self._draw_finger("right")

    def _draw_finger(self, finger: Finger) -> None:
        view, stream = self._views.tactile[finger], self._link.frames[finger]
        if not view.isVisible():
            return
        fresh, now_s = self._fresh[finger], self._now_s()
        fresh.note(stream.count, now_s)
        frames, cursor, _ = stream.since(self._frame_cursor[finger])
        if frames:
            # Two at once are a late one and a punctual one: both are shown, one tick apart.
            frame = frames[0] if len(frames) == 2 else frames[-1]
            self._frame_cursor[finger] = cursor - (len(frames) == 2)
            view.show_frame(frame, self._field_of(finger, frame))
            self.frames_shown[finger] += 1
        view.show_age(fresh.judge(now_s), fresh.age_s(now_s), self._why_silent(finger))

    def _field_of(self, finger: Finger, frame: TactileFrame) -> MarkerField | None:
        """Return the field that was tracked in this frame, else the newest one."""
        stream = self._link.fields[finger]
        same = stream.between(frame.t_s, frame.t_s)
        return same[-1] if same else stream.newest()

    def draw_wrench(self) -> None:
        """Feed the traces."""
        views, stream, now_s = self._views, self._link.wrench, self._now_s()
        if not views.force.isVisible():
            return
        if self._wrench_fresh.note(stream.count, now_s) and not self.paused:
            self._feed()
        age, age_s = self._wrench_fresh.judge(now_s), self._wrench_fresh.age_s(now_s)
        for plot in (views.force, views.moment):
            plot.show_age(age, age_s, "The force/torque sensor has not sent a sample.")

    def _feed(self) -> None:
        samples = self._link.wrench.since(self._wrench_cursor)
        self._wrench_cursor = samples.cursor
        if len(samples.t_s):
            self._views.force.add(samples.t_s, samples.values[:, :3])
            self._views.moment.add(samples.t_s, samples.values[:, 3:])

    def show_span(self, span_s: float) -> None:
        """Show another length of time, from what the stream still holds."""
        for plot in (self._views.force, self._views.moment):
            plot.show_span(span_s)
        self._wrench_cursor = 0
        self._feed()

    def draw_headers(self) -> None:
        """Update the figures in the headers four times a second."""
        now_s = self._now_s()
        if now_s - self._headers_s < HEADER_PERIOD_S:
            return
        self._headers_s = now_s
        for finger in FINGERS:
            self._show_header(finger)
        drift = self._link.drift
        self._views.force.show_note("" if drift is None else drift.words())
        for plot in (self._views.force, self._views.moment):
            plot.setAccessibleDescription(plot.summary())

    def _show_header(self, finger: Finger) -> None:
        panel, device = (
            self._views.panels[finger],
            self._link.devices.get(f"tactile_{finger}"),
        )
        seen, total = self._views.tactile[finger].seen()
        if device is None or total == 0:
            panel.detail.setText("")
            return
        health = device.health
        lost = lost_words(health.lost, "frame")
        panel.detail.setToolTip(f"markers seen, measured rate; {lost}")
        panel.detail.setText(f"{seen}/{total}, {health.rate_hz:.1f} Hz")

    def _why_silent(self, finger: Finger) -> str:
        device = self._link.devices.get(f"tactile_{finger}")
        if device is None:
            return "The bench is being prepared."
        if device.state is not DeviceState.READY:
            return f"The camera is {device.state.value}."
        return "The camera has sent no frame for more than 2 s."
