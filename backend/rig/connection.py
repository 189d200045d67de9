"""Connection of the devices of a bench in a safe order.

Nothing moves: the arm is switched on last and stands still. All methods return at once; one thread
does the work. A reconnected device must have the same serial number.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

from touchdown.backend.core import Fault, FaultError, InputError, RefusedError, TouchdownError
from touchdown.backend.devices import (
    CONNECTION_STEPS,
    Device,
    DeviceState,
    HomingGripper,
    Identity,
    ReportsConnectionSteps,
)


def reconnect(device: Device, timeout_s: float, cancel: threading.Event) -> None:
    """Close and connect; raises ``FaultError`` on failure or if the serial number differs.

    After a replug two cameras may be swapped. Calibrations belong to a serial number, so a device
    with another one is closed again.
    """
    before = device.identity
    device.close()
    device.connect(timeout_s, cancel)
    require_serial(device, "" if before is None else before.serial)


def require_serial(device: Device, serial: str) -> None:
    """Close ``device`` and raise ``FaultError`` if its serial number is not ``serial``. An empty
    ``serial`` and a device without a number are accepted.
    """
    now = device.identity
    if not serial or now is None or now.serial == serial:
        return
    device.close()
    raise FaultError(
        Fault(
            "OTHER-DEVICE",
            f"Serial number {now.serial} answers instead of {serial}.",
            "The connection was closed again.",
            "Put the device back into its place, or restart with the other one.",
            device.name,
        )
    )


CONNECT_S = 10.0
JOIN_S = 15.0
HOME_S = 20.0
LineState = Literal["closed", "waiting", "connecting", "ready", "failed"]
ARM, ARM_NEEDS = "arm", "force_torque"
# An unreachable gripper has nothing to acknowledge: it must be connected first.
LINK_LOST = ("WSG-LINK", "CONTROL-LOST")


@dataclass(frozen=True, slots=True)
class DeviceStatus:
    """State of one device: number of completed ``STEPS``, and the fault if it failed. ``needs`` is
    the action required from the operator, ``notice`` a remark; both may be empty.
    """

    name: str
    state: LineState
    steps: int
    identity: Identity | None = None
    fault: Fault | None = None
    needs: Literal["", "home", "acknowledge"] = ""
    notice: str = ""


class BenchConnection:
    """Connects ``devices`` (by name, in this order, the arm last).

    ``serials`` are the required serial numbers; without one, the first number that answered is
    required later.
    """

    def __init__(
        self, devices: Mapping[str, Device], serials: Mapping[str, str] | None = None
    ) -> None:
        self.devices: dict[str, Device] = dict(devices)
        # Called on the worker thread each time all devices are ready.
        self.when_ready: Callable[[], None] = lambda: None
        # Called for each device but the arm, when all are connected and before the arm is switched
        # on. A ``FaultError`` rejects the device, which is then closed.
        self.prove: Callable[[str, threading.Event], None] = lambda name, cancel: None
        # Remarks on ready devices, in addition to their own; without a full stop.
        self.notices: Mapping[str, str] = {}
        self._known = {name: serial for name, serial in (serials or {}).items() if serial}
        self._faults: dict[str, Fault] = {}
        self._waiting: list[str] = []
        self._present = ""
        self._cancel = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        # Reason why the bench cannot be used although all devices are ready.
        self.trouble: TouchdownError | None = None

    # -- state, for any thread --------------------------------------------------------------------

    @property
    def busy(self) -> bool:
        """True while devices are connected or disconnected, or the gripper is homed."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def ready(self) -> bool:
        """True if every device is ready."""
        return not self.missing()

    def lines(self) -> tuple[DeviceStatus, ...]:
        """Return the state of each device, in the order of connection."""
        return tuple(self._line(name, device) for name, device in self.devices.items())

    def missing(self) -> tuple[str, ...]:
        """Return the names of the devices that are not ready."""
        return tuple(n for n, d in self.devices.items() if d.state is not DeviceState.READY)

    # -- orders -----------------------------------------------------------------------------------

    def begin(self, names: Sequence[str] = ()) -> None:
        """Connect ``names`` (empty: all that are not ready); raises ``RefusedError`` while busy."""
        wanted = [n for n in self.devices if (n in names if names else n in self.missing())]
        self._start(lambda: self._connect(wanted), wanted)

    def disconnect(self, names: Sequence[str] = ()) -> None:
        """Close ``names`` (empty: all), the arm first; the gripper keeps its grip."""
        wanted = [n for n in reversed(self.devices) if not names or n in names]
        self._start(lambda: self._close(wanted), ())

    def home(self) -> None:
        """Home the gripper. The jaws move: only with empty jaws, and on the operator's command."""
        gripper = self._gripper()
        if gripper.status().holding:
            raise RefusedError("HOLDING", HELD)
        self._start(lambda: self._home(gripper), ())

    def acknowledge(self) -> None:
        """Acknowledge a fast stop of the gripper, on the operator's command."""
        gripper = self._gripper()
        self._start(lambda: self._run_step("gripper", gripper.acknowledge), ())

    def cancel(self) -> None:
        """Cancel connecting; returns at once. Connected devices stay connected."""
        self._cancel.set()

    def wait(self, limit_s: float | None = None) -> bool:
        """Wait until the work is done, for scripts; return False after a timeout."""
        thread = self._thread
        if thread is not None:
            thread.join(limit_s)
        return not self.busy

    def close(self) -> None:
        """Cancel, then close all, the arm first."""
        self.cancel()
        self.wait(JOIN_S)
        self._close(list(reversed(self.devices)))

    # -- worker thread ----------------------------------------------------------------------------

    def _start(self, work: Callable[[], None], waiting: Sequence[str]) -> None:
        with self._lock:
            if self.busy:
                raise RefusedError("CONNECTING", "Wait until the present step is done, or cancel.")
            self._cancel.clear()
            self._waiting = list(waiting)
            self.trouble = None
            self._thread = threading.Thread(target=work, name="connection", daemon=True)
            self._thread.start()

    def _connect(self, names: Sequence[str]) -> None:
        first, arm = [n for n in names if n != ARM], [n for n in names if n == ARM]
        steps = ((self._connect_one, first), (self._prove_one, first), (self._connect_one, arm))
        try:
            for work, wanted in steps:
                for name in wanted:
                    if self._cancel.is_set():
                        return
                    if work == self._prove_one and self._is_away(name):
                        continue
                    self._present = name
                    self._waiting = [one for one in self._waiting if one != name]
                    self._run_step(name, partial(work, name))
        finally:
            self._present, self._waiting = "", []
        if self.ready and not self._cancel.is_set():
            try:
                self.when_ready()
            except (InputError, FaultError, RefusedError) as error:
                self.trouble = error

    def _connect_one(self, name: str) -> None:
        device = self.devices[name]
        if name == ARM and self._is_away(ARM_NEEDS):
            raise FaultError(NO_WRIST)
        device.close()
        try:
            device.connect(CONNECT_S, self._cancel)
        except TouchdownError:
            raise
        except Exception as error:
            # A driver of another package may raise anything; the other devices continue.
            device.close()
            raise FaultError(
                Fault(
                    "DRIVER-FAILED",
                    f"The driver of {name} failed: {type(error).__name__}: {error}.",
                    "The device is not connected.",
                    "Tell who wrote the driver; then connect the device again.",
                    name,
                )
            ) from error
        require_serial(device, self._known.get(name, ""))
        if device.identity is not None:
            self._known[name] = device.identity.serial

    def _prove_one(self, name: str) -> None:
        try:
            self.prove(name, self._cancel)
        except FaultError:
            self.devices[name].close()
            raise

    def _close(self, names: Sequence[str]) -> None:
        for name in names:
            self._faults.pop(name, None)
            self._run_step(name, self.devices[name].close)

    def _home(self, gripper: HomingGripper) -> None:
        def home() -> None:
            motion, waited_s = gripper.home(), 0.0
            while not motion.done and waited_s < HOME_S and not self._cancel.wait(0.02):
                waited_s += 0.02
            if not motion.done:
                gripper.stop()
                raise FaultError(NOT_HOMED)
            motion.result()

        self._run_step("gripper", home)

    def _run_step(self, name: str, work: Callable[[], None]) -> None:
        try:
            work()
        except FaultError as error:
            self._faults[name] = error.fault
        except RefusedError as error:
            self._faults[name] = Fault(error.reason, error.detail, "Nothing was moved.", "", name)
        else:
            self._faults.pop(name, None)

    # -- inside -----------------------------------------------------------------------------------

    def _line(self, name: str, device: Device) -> DeviceStatus:
        done = device.steps.done if isinstance(device, ReportsConnectionSteps) else 0
        state, fault = device.state, self._faults.get(name)
        if name == self._present:
            return DeviceStatus(name, "connecting", done)
        if state is DeviceState.READY:
            needs = _needs(device)
            own = str(device.describe().get("notice", ""))
            notice = ". ".join(filter(None, (own, self.notices.get(name, ""))))
            return DeviceStatus(
                name, "ready", len(CONNECTION_STEPS), device.identity, fault, needs, notice
            )
        if name in self._waiting:
            return DeviceStatus(name, "waiting", 0)
        if state is DeviceState.FAULT:
            fault = fault_of(device) or fault
            return DeviceStatus(name, "failed", done, device.identity, fault, _needs(device))
        word: LineState = "failed" if fault is not None else "closed"
        return DeviceStatus(name, word, done if fault is not None else 0, None, fault)

    def _is_away(self, name: str) -> bool:
        device = self.devices.get(name)
        return device is not None and device.state is not DeviceState.READY

    def _gripper(self) -> HomingGripper:
        gripper = self.devices.get("gripper")
        if not isinstance(gripper, HomingGripper):
            raise RefusedError("NO-HOMING", "This gripper is not homed from here.")
        return gripper


def fault_of(device: Device) -> Fault | None:
    """Return the fault of a device, None if it reports none."""
    fault = getattr(device, "fault", None)
    return fault if isinstance(fault, Fault) else None


def _needs(device: Device) -> Literal["", "home", "acknowledge"]:
    if not isinstance(device, HomingGripper):
        return ""
    if device.fault is not None and device.fault.code not in LINK_LOST:
        return "acknowledge"
    return "" if device.homed else "home"


HELD = (
    "A piece is held: homing would let it go. Take it, and open the jaws in the window (Operate, "
    "Shift+G); a gripper that has its origin needs no homing."
)
NO_WRIST = Fault(
    "NO-WRIST",
    "The wrist sensor is not connected.",
    "The arm was not switched on: it moves on what the wrist feels.",
    "Connect the wrist sensor, then the arm.",
    "arm",
)
NOT_HOMED = Fault(
    "NOT-HOMED",
    "The gripper did not find its origin.",
    "The jaws stand still.",
    "Look at the jaws, then home again.",
    "gripper",
)
