"""Presenter of the top bar: one chip per device, and both status words of the arm."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from app.link import Link
from backend.devices.degraded import Degraded
from backend.devices.protocols import Arm, Device, DeviceState, Health, SafetyMode
from widgets.device_chip import ChipState, ChipValue
from widgets.freshness import Age, Freshness
from widgets.top_bar import CHIPS, TopBar

PERIOD_S = 0.25
MUCH_LOST, LEAST_LOST = 0.02, 3
"""Losses below this share, or fewer, stand in the tool tip only: a camera drops one in 200."""
_STATES: dict[DeviceState, ChipState] = {
    DeviceState.CLOSED: "closed",
    DeviceState.CONNECTING: "connecting",
    DeviceState.READY: "ready",
    DeviceState.FAULT: "fault",
}


class ChipsPresenter:
    """Shows what the devices say of themselves, four times a second."""

    def __init__(
        self, link: Link, bar: TopBar, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._link, self._bar, self._now_s = link, bar, now_s
        self._fresh = {key: Freshness() for key, _ in CHIPS}
        self._drawn_s = float("-inf")

    def draw(self) -> bool:
        """Update chips and modes; True when it did."""
        now_s = self._now_s()
        if now_s - self._drawn_s < PERIOD_S:
            return False
        self._drawn_s = now_s
        devices = self._link.devices
        degraded = {one.device: one for one in self._link.degraded}
        for key, _ in CHIPS:
            device = devices.get(key)
            if device is not None:
                self._bar.chips[key].show_value(self._chip(key, device, now_s, degraded.get(key)))
        arm = devices.get("arm")
        if arm is not None:
            status = _arm(arm).status()
            self._bar.show_modes(status.robot_mode.value, status.safety_mode.value)
            self._bar.show_hardware_stop(self._hardware_stop(status.safety_mode))
        return True

    def _hardware_stop(self, safety: SafetyMode) -> str:
        """Return what is known of it: that it stopped the arm is told, that it is free is not."""
        if self._link.simulated:
            return "none"
        return "active" if safety is SafetyMode.HW_STOP else "unknown"

    def _chip(self, key: str, device: Device, now_s: float, degraded: Degraded | None) -> ChipValue:
        health, fresh = device.health, self._fresh[key]
        drift = self._link.drift if key == "force_torque" else None
        fresh.note(health.received, now_s)
        state: ChipState = _STATES[device.state]
        age = fresh.judge(now_s)
        if state == "ready" and age in (Age.STALE, Age.GONE):
            state = "stale"
            detail = f"stale {fresh.age_s(now_s):.1f} s"
        elif state == "ready" and degraded is not None:
            state = "degraded"
            lasted_s = self._link.clock_s() - degraded.since_s
            figure = f"{health.rate_hz:.0f} Hz" if degraded.how == "slow" else f"{lasted_s:.1f} s"
            detail = f"{degraded.how} {figure}"
        elif state == "ready" and drift is not None and drift.named:
            state, detail = "degraded", f"drift {drift.moved_n:.2f} N"
        elif device.state is DeviceState.READY and not math.isfinite(health.age_s):
            detail = "no data yet"
        elif device.state is DeviceState.READY:
            detail = f"{health.rate_hz:.0f} Hz, {1e3 * max(health.age_s, 0):.0f} ms"
        else:
            detail = device.state.value
        who = device.identity
        lost = lost_words(health.lost, "frame" if key.startswith("tactile") else "sample")
        tip = f"{device.state.value}, {detail}; {health.received} received, {lost}"
        tip = tip if drift is None else f"{tip}\n{drift.words()}, in still air"
        if who is not None:
            tip = f"{who.maker} {who.model}, serial {who.serial}\n{tip}"
        return ChipValue(state, detail, health.lost if _is_much(health) else 0, tip)


def _is_much(health: Health) -> bool:
    """Return whether the losses deserve a place on the chip."""
    share = health.lost / max(1, health.received + health.lost)
    return health.lost >= LEAST_LOST and share > MUCH_LOST


def lost_words(count: int, noun: str) -> str:
    """Name what was lost: beside the count of markers a bare number reads as markers."""
    return f"{count} {noun} lost" if count == 1 else f"{count} {noun}s lost"


def _arm(device: Device) -> Arm:
    return device  # type: ignore[return-value]
