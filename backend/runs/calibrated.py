"""Which calibrations hold on a bench now, and which runs must not begin without them."""

from __future__ import annotations

from collections.abc import Mapping

from backend.calibration.kinds import What
from backend.calibration.record import DeviceName, Record
from backend.calibration.store import CalibrationStore
from backend.config.bench_facts import BenchMode
from backend.core.faults import RefusedError
from backend.core.flow import FloatArray
from backend.devices.protocols import Device
from backend.runs.requests import CollectRequest, Request, StackRequest
from backend.sensing.tare import gripper_payload

Used = Mapping[What, Record]


def device_names(devices: Mapping[str, Device]) -> dict[str, DeviceName]:
    """Return who each connected device says it is; firmware may change without harm."""
    known = {name: device.identity for name, device in devices.items()}
    return {
        name: DeviceName(maker=who.maker, model=who.model, serial=who.serial)
        for name, who in known.items()
        if who is not None
    }


def calibrations_for(
    request: Request,
    mode: BenchMode,
    store: CalibrationStore | None,
    devices: Mapping[str, Device],
) -> Used:
    """Return the calibrations that a run uses.

    On hardware, stacking and collecting need all of them: raises ``RefusedError`` naming the first
    that is missing, expired, damaged or of another device, with the fix. Elsewhere those that hold
    are used.
    """
    required = mode == "hardware" and isinstance(request, StackRequest | CollectRequest)
    if store is not None:
        return store.in_use(device_names(devices), required=required)
    if required:
        raise RefusedError("CALIBRATION-MISSING", "This bench has no folder of calibrations.")
    return {}


def payload_of(store: CalibrationStore | None, devices: Mapping[str, Device]) -> FloatArray | None:
    """Return the measured wrench (6,) of the gripper, hand level; None if none holds."""
    if store is None:
        return None
    standing = store.standing("payload", device_names(devices))
    if standing.condition != "valid" or standing.record is None:
        return None
    values = standing.record.file.values
    # The height of the centre of mass makes no moment while the hand is level.
    centre_mm = (values["com_x_mm"].value, values["com_y_mm"].value, 0.0)
    return gripper_payload(values["mass_kg"].value, centre_mm)


def as_metadata(used: Used) -> tuple[tuple[str, str], ...]:
    """Return the pairs that an episode keeps: which calibration, by its SHA-256."""
    return tuple((f"calibration_{what}", record.sha256) for what, record in used.items())
