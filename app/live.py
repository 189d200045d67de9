"""Presenter: streams and devices to live views. Runs on the pump, reads snapshots, never waits."""

from __future__ import annotations

import time
from collections.abc import Callable

from app.link import Link
from app.stack_page import StackPage
from backend.core.flow import FINGERS, Finger, MarkerField, TactileFrame
from backend.devices.protocols import Arm, Device, DeviceState
from widgets.device_chip import ChipState, ChipValue
from widgets.freshness import Age, Freshness
from widgets.top_bar import CHIPS, TopBar

CHIP_PERIOD_S = 0.25
_STATES: dict[DeviceState, ChipState] = {
    DeviceState.CLOSED: "closed",
    DeviceState.CONNECTING: "connecting",
    DeviceState.READY: "ready",
    DeviceState.FAULT: "fault",
}


class LivePresenter:
    """Moves the newest samples of a bench into the views."""

    def __init__(
        self, link: Link, page: StackPage, bar: TopBar, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._link, self._page, self._bar, self._now_s = link, page, bar, now_s
        self._fresh = {finger: Freshness() for finger in FINGERS}
        self._device_fresh = {key: Freshness() for key, _ in CHIPS}
        self._wrench_fresh = Freshness()
        self._wrench_cursor = 0
        self._first_s = float("nan")
        self._chips_s = float("-inf")
        self._frame_cursor = dict.fromkeys(FINGERS, 0)
        self.frames_shown = dict.fromkeys(FINGERS, 0)

    def draw_left(self) -> None:
        """Update the left tactile view."""
        self._draw_finger("left")

    def draw_right(self) -> None:
        """Update the right tactile view."""
        self._draw_finger("right")

    def _draw_finger(self, finger: Finger) -> None:
        view, stream = self._page.tactile[finger], self._link.frames[finger]
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
        page, stream, now_s = self._page, self._link.wrench, self._now_s()
        if not page.force.isVisible():
            return
        if self._wrench_fresh.note(stream.count, now_s):
            samples = stream.since(self._wrench_cursor)
            self._wrench_cursor = samples.cursor
            if len(samples.t_s):
                page.force.add(samples.t_s, samples.values[:, :3])
                page.moment.add(samples.t_s, samples.values[:, 3:])
        age, age_s = self._wrench_fresh.judge(now_s), self._wrench_fresh.age_s(now_s)
        for plot in (page.force, page.moment):
            plot.show_age(age, age_s, "The force/torque sensor has not sent a sample.")

    def draw_chips(self) -> bool:
        """Update chips, headers and modes four times a second; True when it did."""
        now_s = self._now_s()
        if now_s - self._chips_s < CHIP_PERIOD_S:
            return False
        self._chips_s = now_s
        devices = self._link.devices
        for key, _ in CHIPS:
            device = devices.get(key)
            if device is not None:
                self._bar.chips[key].show_value(self._chip(key, device, now_s))
        arm = devices.get("arm")
        if arm is not None:
            status = _arm(arm).status()
            self._bar.show_modes(status.robot_mode.value, status.safety_mode.value)
        for finger in FINGERS:
            self._show_header(finger)
        for plot in (self._page.force, self._page.moment):
            plot.setAccessibleDescription(plot.summary())
        return True

    def _chip(self, key: str, device: Device, now_s: float) -> ChipValue:
        health, fresh = device.health, self._device_fresh[key]
        fresh.note(health.received, now_s)
        state: ChipState = _STATES[device.state]
        age = fresh.judge(now_s)
        if state == "ready" and age in (Age.STALE, Age.GONE):
            state = "stale"
            detail = f"stale {fresh.age_s(now_s):.1f} s"
        elif device.state is DeviceState.READY:
            detail = f"{health.rate_hz:.0f} Hz, {1e3 * max(health.age_s, 0):.0f} ms"
        else:
            detail = device.state.value
        who = device.identity
        lost = _lost(health.lost, "frame" if key.startswith("tactile") else "sample")
        tip = f"{device.state.value}, {detail}; {health.received} received, {lost}"
        if who is not None:
            tip = f"{who.maker} {who.model}, serial {who.serial}\n{tip}"
        return ChipValue(state, detail, health.lost, tip)

    def _show_header(self, finger: Finger) -> None:
        panel, device = (
            self._page.tactile_panels[finger],
            self._link.devices.get(f"tactile_{finger}"),
        )
        seen, total = self._page.tactile[finger].seen()
        if device is None or total == 0:
            panel.detail.setText("")
            return
        health = device.health
        lost = f", {_lost(health.lost, 'frame')}" if health.lost else ""
        panel.detail.setToolTip("markers seen, measured rate, frames lost")
        panel.detail.setText(f"{seen}/{total}, {health.rate_hz:.1f} Hz{lost}")

    def _why_silent(self, finger: Finger) -> str:
        device = self._link.devices.get(f"tactile_{finger}")
        if device is None:
            return "The bench is being prepared."
        if device.state is not DeviceState.READY:
            return f"The camera is {device.state.value}."
        return "The camera has sent no frame for more than 2 s."


def _lost(count: int, noun: str) -> str:
    """Name what was lost: beside the count of markers a bare number reads as markers."""
    return f"{count} {noun} lost" if count == 1 else f"{count} {noun}s lost"


def _arm(device: Device) -> Arm:
    return device  # type: ignore[return-value]
