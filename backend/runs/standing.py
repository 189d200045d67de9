"""What a run must not ask of the bench as it stands, and what STOP must reach."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from backend.core.facts import Fact, FaultRaised, FaultsReset
from backend.core.faults import Fault, RefusedError
from backend.core.hub import Hub
from backend.devices.interlock import Interlock
from backend.devices.protocols import Device, DeviceState
from backend.rig.connection import Connection, fault_of
from backend.runs.hand import Hand
from backend.runs.requests import Request, StackRequest


def refuse_on_devices(connection: Connection | None, request: Request) -> None:
    """Raise ``RefusedError`` for what only a simulation can do, or while a device is away.

    Where each scene has its own devices (None) there is nothing to refuse.
    """
    if connection is None:
        return
    if isinstance(request, StackRequest) and request.strategy == "pick-and-place":
        raise RefusedError("SIMULATED-ONLY", "Letting go untested is for simulations only.")
    if missing := connection.missing():
        names = ", ".join(missing)
        raise RefusedError("NOT-CONNECTED", f"Not connected: {names}. Connect first (Ctrl+L).")


def refuse_contact(hand: Hand | None) -> None:
    """Refuse to move off sideways, or to tare and reference, while the piece presses."""
    pressing_n = 0.0 if hand is None else hand.pressing_n
    if pressing_n:
        raise RefusedError(
            "IN-CONTACT",
            f"The piece presses with {pressing_n:.1f} N: lift before you start (jog +Z).",
        )


def stop_with(connection: Connection | None, interlock: Interlock) -> None:
    """Let STOP end connecting, and reach arm and gripper before there is a scene."""
    if connection is None:
        return
    interlock.on_stop(connection.cancel)
    for name in ("arm", "gripper"):
        stop = getattr(connection.devices.get(name), "stop", None)
        if stop is not None:
            interlock.on_stop(stop)


def latch(devices: Iterable[Device], interlock: Interlock) -> None:
    """Latch the fault of each device that was lost, or that has a fault of its own."""
    for device in devices:
        fault = fault_of(device)
        if fault is not None and device.state is DeviceState.FAULT:
            interlock.raise_fault(fault)


class FaultTeller:
    """Announces faults that were latched while no run was there to do it; each once."""

    def __init__(self, hub: Hub, interlock: Interlock, now_s: Callable[[], float]) -> None:
        self._hub, self._interlock, self._now_s = hub, interlock, now_s
        self._told: set[tuple[str, str]] = set()
        hub.subscribe(self._note)

    def tell(self) -> None:
        """Announce what is latched and was not announced since the last reset."""
        for fault in self._interlock.faults:
            if (fault.code, fault.device) not in self._told:
                self._hub.publish(FaultRaised(self._now_s(), fault))

    def tell_now(self, fault: Fault) -> None:
        """Latch ``fault`` and announce it on this thread, if that was not done since the reset."""
        if (fault.code, fault.device) not in self._told:
            self._interlock.raise_fault(fault)
            self._hub.publish(FaultRaised(self._now_s(), fault))

    def _note(self, fact: Fact) -> None:
        if isinstance(fact, FaultRaised):
            self._told.add((fact.fault.code, fact.fault.device))
        elif isinstance(fact, FaultsReset):
            self._told.clear()
