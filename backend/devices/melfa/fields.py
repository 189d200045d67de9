"""What the arm tells of itself: status words, fields of the inspector, a line for a recorder."""

from __future__ import annotations

from collections.abc import Mapping

from backend.config.hardware import MelfaSettings
from backend.core.faults import Fault
from backend.devices.melfa.console import Console
from backend.devices.melfa.orders import Orders
from backend.devices.melfa.stream import Phase, StreamCore
from backend.devices.melfa.wires import Wires
from backend.devices.protocols import ArmStatus, DeviceState, RobotMode, SafetyMode
from backend.wire.melfa_r3_answers import Run, State

PHASES = {phase: float(place) for place, phase in enumerate(Phase)}


def words_of(
    device: DeviceState, state: State | None, fault: Fault | None, *, moving: bool
) -> ArmStatus:
    """Return the status words; ``state`` is what the controller told last."""
    if device is DeviceState.CLOSED:
        return ArmStatus(RobotMode.DISCONNECTED, SafetyMode.UNKNOWN, 0.0, 0)
    override = 0.0 if state is None else state.override / 100.0
    error = 0 if state is None else state.error
    if device is DeviceState.CONNECTING:
        return ArmStatus(RobotMode.CONNECTING, SafetyMode.UNKNOWN, override, error)
    safety = SafetyMode.NORMAL
    if device is DeviceState.FAULT:
        stopped = fault is not None and fault.code == "HW-STOP"
        safety = SafetyMode.HW_STOP if stopped else SafetyMode.FAULT
    mode = RobotMode.READY
    if state is not None and Run.SERVO_ON not in state.run:
        mode = RobotMode.SERVO_OFF
    elif moving:
        mode = RobotMode.MOVING
    return ArmStatus(mode, safety, override, error)


def trace_of(core: StreamCore, orders: Orders) -> tuple[float, ...]:
    """Return the values of ``TRACE``; the caller holds the lock of the stream."""
    return (
        *core.command_mm.tolist(),
        *core.measured_mm.tolist(),
        *core.sent_rad.tolist(),
        *core.measured_rad.tolist(),
        *(
            PHASES[core.phase],
            core.missed,
            core.holds,
            orders.under_way(core),
            orders.level.press_n(),
        ),
    )


def raw_fields(
    core: StreamCore, wires: Wires, settings: MelfaSettings, console: Console
) -> Mapping[str, str | float]:
    """Return them by name; ``command_mm`` is of ``G`` in the bench."""
    counts, times = core.replies.counts, wires.times
    x, y, z = core.command_mm.tolist()
    return {
        "kind": "melfa",
        "host": settings.host,
        "stream": core.phase.value,
        "x_mm": x,
        "y_mm": y,
        "z_mm": z,
        "holds": core.holds,
        "refused": counts.refused,
        "repeated": counts.repeated,
        "old": counts.old,
        "skipped": counts.skipped,
        "controller_missed": core.timeouts,
        "bad_replies": wires.bad_replies,
        "late_cycles": times.late,
        "latest_ms": 1e3 * times.latest_s,
        "realtime": "yes" if times.realtime else "no",
        "time_limit": "none" if console.unlimited else "set",
        **({"notice": console.notice} if console.notice else {}),
    }
