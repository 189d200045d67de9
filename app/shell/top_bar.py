"""Top bar: bench state, device chips, speed, servo."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial

from touchdown.app.shell.activity import arm_of
from touchdown.app.shell.bench_text import bench_caption
from touchdown.app.shell.cards import carry_out
from touchdown.app.shell.workspace import WindowCommand
from touchdown.backend.bench import Session
from touchdown.backend.devices import (
    DegradedDevice,
    Device,
    DeviceState,
    SafetyMode,
    signed_name,
    turns,
)
from touchdown.backend.rig import BenchConnection
from touchdown.backend.runs import RunState, RunStatus
from touchdown.widgets.base import Age, Freshness, count_noun, tr
from touchdown.widgets.shell import (
    DEVICE_CHIPS,
    ChipState,
    ChipValue,
    Colour,
    FaultCards,
    PillState,
    Shape,
    TopBar,
)

_WORDS: dict[RunState, tuple[str, Shape, Colour]] = {
    RunState.IDLE: ("READY", "disc", "green"),
    RunState.PREPARING: ("PREPARING", "play", "green"),
    RunState.RUNNING: ("RUNNING", "play", "green"),
    RunState.PAUSING: ("PAUSING", "bars", "yellow"),
    RunState.PAUSED: ("PAUSED", "bars", "yellow"),
    RunState.CANCELLING: ("CANCELLING", "diamond", "yellow"),
    RunState.FINISHING: ("FINISHING", "diamond", "yellow"),
}
# A bench without a step for longer is shown as still; setting up a scene takes longer.
STILL_S = 1.0
# states in which a degraded sensor is shown; in others a card names it.
SHOWS_DEGRADED = (RunState.IDLE, RunState.PREPARING, RunState.RUNNING)


def pill_state(bench: Session) -> PillState:
    """Return the state of the bench for the pill."""
    note = bench_caption(bench).note
    if not bench.devices:
        return PillState("NO DEVICES", "ring", "grey", note)
    if bench.still_s >= STILL_S and bench.status().state is not RunState.PREPARING:
        return PillState("STILL", "bang", "yellow", tr("no step for {:.0f} s", bench.still_s))
    if bench.interlock.latched:
        if bench.interlock.faults:
            return PillState("FAULT", "square", "red", "press Reset")
        return PillState("STOPPED", "square", "blue", "press Reset")
    if bench.connection is not None and (standing := _standing(bench.connection)):
        return standing
    if bench.hand is not None and not bench.hand.powered:
        return PillState("NOT READY", "triangle", "blue", "switch the servo on")
    by_hand = _by_hand(bench)
    if by_hand:
        return PillState("JOG", "play", "green", by_hand)
    if bench.hand is not None and bench.interlock.recovering:
        return PillState("RECOVERY", "diamond", "yellow", "jog in Operate")
    status = bench.status()
    asks = status.asks if status.state is RunState.RUNNING else ""
    if status.awaiting is not None or asks:
        return PillState("YOUR TURN", "triangle", "blue", asks or "approve or decline")
    return _sensed(bench, status) or _of_run(note, status)


def _sensed(bench: Session, status: RunStatus) -> PillState | None:
    """Return the state of the sensors, None if they are in order."""
    degraded = bench.degraded
    if status.state in SHOWS_DEGRADED and degraded:
        return PillState("DEGRADED", "bang", "yellow", _which(degraded, bench.clock_s()))
    if status.state is RunState.IDLE and bench.hand is not None and bench.hand.pressing_n:
        note = tr("{:.0f} N: lift, jog +Z", bench.hand.pressing_n)
        return PillState("IN CONTACT", "diamond", "yellow", note)
    return None


def _which(degraded: tuple[DegradedDevice, ...], now_s: float) -> str:
    """Return the sensor that is late or slow, and since when."""
    first, *others = degraded
    for_s, more = now_s - first.since_s, f" +{len(others)}" if others else ""
    lasted = f"{for_s:.1f} s" if for_s < 1.0 else f"{for_s:.0f} s"
    return f"{tr(dict(DEVICE_CHIPS)[first.device])} {tr(first.how)} {lasted}{more}"


def _standing(connection: BenchConnection) -> PillState | None:
    """Return the connection state of a lab's devices, None if all are connected."""
    missing, count = connection.missing(), len(connection.devices)
    if connection.busy:
        return PillState("CONNECTING", "ring", "blue", tr("{} of {}", count - len(missing), count))
    if len(missing) == count:
        return PillState("NO DEVICES", "ring", "grey", "connect: Ctrl+L")
    if missing:
        return PillState("NOT READY", "triangle", "blue", tr("{} not connected", len(missing)))
    return None


def _by_hand(bench: Session) -> str:
    """Return what is moved by hand, "" if nothing is."""
    if bench.hand is None or not bench.hand.jog.active:
        return ""
    state = bench.hand.jog.state
    if state.order is None:
        return tr("one step")
    order, speed = state.order, f"{state.speed:.0f} mm/s"
    if turns(order.axis):
        speed = f"{math.degrees(state.speed):.0f}\N{DEGREE SIGN}/s"
    return f"{signed_name(order.axis, order.speed)} {order.frame}, {speed}"


def _of_run(note: str, status: RunStatus) -> PillState:
    word, shape, colour = _WORDS[status.state]
    if status.state is RunState.RUNNING and status.phase:
        note = f"{note}, {tr(status.phase)}".lstrip(", ")
    return PillState(word, shape, colour, note)


PERIOD_S = 0.25
# Smaller losses are shown in the tool tip only: a camera drops one in 200.
MUCH_LOST, LEAST_LOST = 0.02, 3
_STATES: dict[DeviceState, ChipState] = {
    DeviceState.CLOSED: "closed",
    DeviceState.CONNECTING: "connecting",
    DeviceState.READY: "ready",
    DeviceState.FAULT: "fault",
}


class DeviceChipsPresenter:
    """Shows the state of the devices four times a second."""

    def __init__(
        self, bench: Session, bar: TopBar, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._bench, self._bar, self._now_s = bench, bar, now_s
        self._fresh = {key: Freshness() for key, _ in DEVICE_CHIPS}
        self._drawn_s = float("-inf")

    def draw(self) -> bool:
        """Update chips and modes; return True if it did."""
        now_s = self._now_s()
        if now_s - self._drawn_s < PERIOD_S:
            return False
        self._drawn_s = now_s
        devices = self._bench.devices
        degraded = {one.device: one for one in self._bench.degraded}
        for key, _ in DEVICE_CHIPS:
            device = devices.get(key)
            if device is not None:
                self._bar.chips[key].show_value(self._chip(key, device, now_s, degraded.get(key)))
        arm = arm_of(self._bench)
        if arm is not None:
            status = arm.status()
            self._bar.show_modes(tr(status.robot_mode.value), tr(status.safety_mode.value))
            active = status.safety_mode is SafetyMode.HW_STOP
            unknown = "active" if active else "unknown"
            self._bar.show_hardware_stop("none" if self._bench.simulated else unknown)
        return True

    def _chip(
        self, key: str, device: Device, now_s: float, degraded: DegradedDevice | None
    ) -> ChipValue:
        health, fresh = device.health, self._fresh[key]
        drift = self._bench.drift if key == "force_torque" else None
        fresh.note(health.received, now_s)
        state: ChipState = _STATES[device.state]
        age = fresh.judge(now_s)
        if state == "ready" and age in (Age.STALE, Age.GONE):
            state = "stale"
            detail = tr("stale {:.1f} s", fresh.age_s(now_s))
        elif state == "ready" and degraded is not None:
            state = "degraded"
            lasted_s = self._bench.clock_s() - degraded.since_s
            figure = f"{health.rate_hz:.0f} Hz" if degraded.how == "slow" else f"{lasted_s:.1f} s"
            detail = f"{tr(degraded.how)} {figure}"
        elif state == "ready" and drift is not None and drift.named:
            state, detail = "degraded", tr("drift {:.2f} N", drift.moved_n)
        elif device.state is DeviceState.READY and not math.isfinite(health.age_s):
            detail = tr("no data yet")
        elif device.state is DeviceState.READY:
            detail = f"{health.rate_hz:.0f} Hz, {1e3 * max(health.age_s, 0):.0f} ms"
        else:
            detail = tr(device.state.value)
        who = device.identity
        lost = count_noun(health.lost, "frame" if key.startswith("tactile") else "sample")
        tip = f"{tr(device.state.value)}, {detail}; "
        tip += tr("{} received, {} lost", health.received, lost)
        tip = tip if drift is None else f"{tip}\n{tr('{}, in still air', drift.words())}"
        if who is not None:
            tip = f"{tr('{} {}, serial {}', who.maker, who.model, who.serial)}\n{tip}"
        share = health.lost / max(1, health.received + health.lost)
        much = health.lost >= LEAST_LOST and share > MUCH_LOST
        return ChipValue(state, detail, health.lost if much else 0, tip)


START_PERCENT = 10  # initial override with hardware
STEP_PERCENT = 10


class SpeedOverride:
    """Applies the speed of the top bar to the bench; ``say`` confirms it in the footer."""

    def __init__(self, bar: TopBar, say: Callable[[str], None]) -> None:
        self._bar, self._say = bar, say
        self._bench: Session | None = None
        bar.override.valueChanged.connect(self._choose)
        self.commands = (
            WindowCommand("slower", "Slower: speed override down", "Ctrl+Alt+-",
                          partial(self._change, -STEP_PERCENT)),
            WindowCommand("faster", "Faster: speed override up", "Ctrl+Alt++",
                          partial(self._change, STEP_PERCENT)),
        )  # fmt: skip

    def attach(self, bench: Session) -> None:
        """Show the override of this bench; hardware starts slowly."""
        self._bench = None
        if not bench.simulated:
            bench.interlock.override_speed(START_PERCENT / 100)
        self._bar.override.setValue(round(100 * bench.interlock.override))
        self._bench = bench

    def _choose(self, percent: int) -> None:
        if self._bench is not None:
            self._bench.interlock.override_speed(percent / 100)
            self._say(tr("Speed override {} %.", percent))

    def _change(self, by_percent: int) -> None:
        self._bar.override.setValue(self._bar.override.value() + by_percent)


class ServoSwitch:
    """Switches the servo of the arm and shows its state."""

    def __init__(self, bench: Session, bar: TopBar, cards: FaultCards) -> None:
        self._bench, self._bar, self._cards = bench, bar, cards
        bar.servo.ordered = self._switch

    def draw(self) -> None:
        """Show the state of the servo: on, off or unknown."""
        hand = self._bench.hand
        if hand is None:
            self._bar.servo.show_state(None)
        else:
            self._bar.servo.show_state(hand.powered, busy=hand.switching)

    def _switch(self, on: bool) -> None:
        hand = self._bench.hand
        if hand is not None:
            carry_out(lambda: hand.servo(on), self._cards)
