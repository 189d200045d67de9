"""Activity of the bench, as shown to the operator."""

from __future__ import annotations

import math
import threading
from functools import partial
from typing import cast

from PySide6.QtCore import QPoint
from PySide6.QtWidgets import QWidget

from touchdown.backend.bench import Session
from touchdown.backend.core import FaultError, Refused, Said, StaleSampleError
from touchdown.backend.devices import NAMES, Arm, Device, Gripper, RobotMode
from touchdown.backend.rig import reconnect
from touchdown.backend.runs import RunState
from touchdown.widgets.base import tr, true_minus
from touchdown.widgets.shell import DEVICE_CHIPS, DeviceInspector, TopBar

DEGRADED_DELAY_S = 1.0  # a sensor degraded for longer keeps runs from starting
ACTIVE_STATES = frozenset(
    {RunState.PREPARING, RunState.RUNNING, RunState.PAUSING, RunState.PAUSED, RunState.CANCELLING,
     RunState.FINISHING}
)  # fmt: skip
MOVING_STATES = ACTIVE_STATES - {RunState.PAUSED}


def is_run_active(bench: Session) -> bool:
    """Return True if a run is active."""
    return bench.status().state in ACTIVE_STATES


def pause_or_resume(bench: Session) -> None:
    """Pause the run at the next safe place, or resume it."""
    if bench.status().state in (RunState.PAUSED, RunState.PAUSING):
        bench.engine.resume()
    else:
        bench.engine.pause()


def may_be_moving(bench: Session) -> bool:
    """Return True if something may be moving. Space then means STOP."""
    status = bench.status()
    if status.state in MOVING_STATES and status.awaiting is None and not status.asks:
        return True
    arm = arm_of(bench)
    return arm is not None and arm.status().robot_mode is RobotMode.MOVING


def arm_of(bench: Session) -> Arm | None:
    """Return the arm, None while the bench has none."""
    return cast("Arm | None", bench.devices.get("arm"))


def gripper_of(bench: Session) -> Gripper | None:
    """Return the gripper, None while the bench has none."""
    return cast("Gripper | None", bench.devices.get("gripper"))


def arm_position_mm(bench: Session, max_age_s: float = math.inf) -> tuple[float, ...] | None:
    """Return x, y, z of the hand, None if it is unknown or older than ``max_age_s``."""
    arm = arm_of(bench)
    try:
        return None if arm is None else tuple(arm.poses.latest(bench.clock_s(), max_age_s)[1])
    except StaleSampleError:
        return None


def missing_scene_reason(bench: Session) -> str:
    """Return why there is no scene, "" where that does not matter."""
    if bench.connection is not None:
        if bench.connection.busy:
            return tr("The devices are being connected")
        return tr("Connect the bench first (Ctrl+L)")
    return "" if bench.devices else tr("The bench is being prepared")


def start_obstacle(bench: Session) -> str:
    """Return why no run can start although none is active, "" if one can."""
    if bench.interlock.latched:
        return tr("Press Reset first")
    if bench.hand is None and missing_scene_reason(bench):
        return missing_scene_reason(bench)
    if bench.hand is not None and not bench.hand.powered:
        return tr("The servo is off: hold Servo in the top bar for 1 s")
    if bench.interlock.recovering:
        return tr("After a fault: jog away from contact in Operate first")
    if bench.hand is not None and bench.hand.pressing_n:
        return tr("In contact: lift first (jog +Z in Operate)")
    for degraded in bench.degraded:
        # Shorter ones would make the buttons flicker; starting is refused with a message.
        if bench.clock_s() - degraded.since_s > DEGRADED_DELAY_S:
            return tr("The {} is {}: check it first", tr(NAMES[degraded.device]), tr(degraded.how))
    return ""


RECONNECT_S = 5.0


class DeviceInspectorPresenter:
    """Keeps one inspector, which shows the device clicked last."""

    def __init__(self, bench: Session, bar: TopBar, window: QWidget) -> None:
        self._bench, self._bar, self._window = bench, bar, window
        self._titles = dict(DEVICE_CHIPS)
        self.sheet: DeviceInspector | None = None
        self._connecting = False
        for key, chip in bar.chips.items():
            chip.clicked.connect(partial(self.open, key))

    def open(self, key: str) -> None:
        """Show the inspector of a device below its chip."""
        device = self._bench.devices.get(key)
        if device is None:
            return
        if self.sheet is None:
            self.sheet = DeviceInspector(self._window, self.reconnect)
        chip = self._bar.chips[key]
        below = chip.mapToGlobal(QPoint(0, chip.height() + 8))
        self.sheet.open_at(key, self._titles[key], self._rows(device), below)

    def reconnect(self) -> None:
        """Reconnect the shown device on a thread; it may take seconds."""
        device = None if self.sheet is None else self._bench.devices.get(self.sheet.key)
        connection = self._bench.connection
        if device is not None and connection is not None and not is_run_active(self._bench):
            if not connection.busy:
                connection.begin((device.name,))
        elif device is not None and not self._connecting and not is_run_active(self._bench):
            self._connecting = True
            threading.Thread(
                target=self._reconnect, args=(device,), name="reconnect", daemon=True
            ).start()

    def _reconnect(self, device: Device) -> None:
        now_s, publish = self._bench.clock_s(), self._bench.events.publish
        try:
            reconnect(device, RECONNECT_S, threading.Event())
        except FaultError as error:
            publish(Refused(now_s, error.fault.code, f"{error.fault.what} {error.fault.next_step}"))
        else:
            name = tr(NAMES.get(device.name, device.name))
            publish(Said(now_s, tr("The {} is connected again.", name)))
        finally:
            self._connecting = False

    def draw(self) -> None:
        """Update the values while the inspector is open."""
        if self.sheet is None or not self.sheet.isVisible():
            return
        self.sheet.reconnect.setEnabled(not self._connecting and not is_run_active(self._bench))
        device = self._bench.devices.get(self.sheet.key)
        if device is not None:
            self.sheet.show_rows(self._rows(device))

    def _rows(self, device: Device) -> list[tuple[str, str]]:
        """Return the rows of a device; those of the wrist sensor include its drift."""
        drift = self._bench.drift if device.name == "force_torque" else None
        told = [] if drift is None else [(tr("drift in air"), drift.words().removeprefix("drift "))]
        return [*inspector_rows(device), *told]


def inspector_rows(device: Device) -> list[tuple[str, str]]:
    """Return connection, health, identity and device-specific fields as (field, value)."""
    health, who = device.health, device.identity
    rows = [
        ("state", device.state.value),
        (tr("rate (Hz)"), f"{health.rate_hz:.1f}"),
        (tr("age (ms)"), f"{1e3 * max(health.age_s, 0.0):.0f}"),
        ("received", f"{health.received}"),
        ("lost", f"{health.lost}"),
    ]
    if who is not None:
        rows += [("maker", who.maker), ("model", who.model), ("serial", who.serial),
                 ("firmware", who.firmware)]  # fmt: skip
    for field, value in device.describe().items():
        rows.append((field, value if isinstance(value, str) else true_minus(f"{value:g}")))
    return rows
