"""Which calibrations hold on a bench now, and which runs must not begin without them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from backend.calibration.applied import placed_by, refuse_other_bottom
from backend.calibration.gels import NUMBERS, as_numbers, as_places, turned
from backend.calibration.kinds import MIRRORS, What
from backend.calibration.record import DeviceName, Record
from backend.calibration.store import CalibrationStore
from backend.config.bench_facts import BenchMode
from backend.core.facts import CalibrationMeasured
from backend.core.faults import RefusedError
from backend.core.flow import FINGERS, Finger, FloatArray
from backend.devices.protocols import Device
from backend.objects.catalogue import Piece
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
    that is missing, expired, damaged or of another device or bottom, with the fix. Elsewhere those
    that hold are used.
    """
    required = mode == "hardware" and isinstance(request, StackRequest | CollectRequest)
    if store is not None:
        used = store.in_use(device_names(devices), required=required)
        if required and isinstance(request, StackRequest):
            refuse_other_bottom(used, "+".join(request.bottoms), store.command("board"))
        elif required and isinstance(request, CollectRequest):
            refuse_other_bottom(used, request.bottom, store.command("board"))
        return used
    if required:
        raise RefusedError("CALIBRATION-MISSING", "This bench has no folder of calibrations.")
    return {}


def surface_of(piece: Piece, bottom: str, used: Used) -> float:
    """Return the height of ``G`` at which the held piece touches ``bottom``; NaN if unknown.

    As the board was felt with this piece on this bottom; else by the nominal height of the grip.
    """
    board = placed_by(used).board
    if board is not None and board.is_of(piece.name, bottom):
        return board.contact_mm
    return math.nan if piece.grip_height_mm is None else piece.grip_height_mm


def payload_of(
    store: CalibrationStore | None, devices: Mapping[str, Device], used: Used | None = None
) -> FloatArray | None:
    """Return the measured wrench (6,) of the gripper, hand level; None if none holds.

    ``used``: what a run was checked with. Its record counts, whatever has become of the file.
    """
    names = device_names(devices)
    record = None if used is None else used.get("payload")
    if record is not None:
        record = None if record.foreign(names) else record
    elif store is not None:
        standing = store.standing("payload", names)
        record = standing.record if standing.condition == "valid" else None
    if record is None:
        return None
    values = record.file.values
    # The height of the centre of mass makes no moment while the hand is level.
    centre_mm = (values["com_x_mm"].value, values["com_y_mm"].value, 0.0)
    return gripper_payload(values["mass_kg"].value, centre_mm)


def keep(
    store: CalibrationStore,
    measured: CalibrationMeasured,
    devices: Mapping[str, Device],
    person: str = "",
) -> Path:
    """Accept what was measured with ``devices``; refused as ``CalibrationStore.accept``.

    Of the cameras it keeps which serial number is at which finger and how each raw picture is to be
    mirrored, and the fingerprint of each gel, whatever the settings were while it was measured.
    """
    names = device_names(devices)
    if measured.what != "camera":
        return store.accept(measured, names, person)
    values = dict(zip(measured.names, measured.values, strict=True))
    sources: dict[Finger, Finger] = {finger: finger for finger in FINGERS}
    if values["exchanged"]:
        sources = {"left": "right", "right": "left"}
    sits: dict[str, float] = {"exchanged": 0.0}
    gels: dict[str, tuple[float, ...]] = {}
    seen_px = dict(zip(FINGERS, _places(measured.gels_px), strict=False))
    for finger, source in sources.items():
        now = str(devices[f"tactile_{source}"].describe().get("mirror", "none"))
        code = round(values[f"{finger}_mirror"]) ^ MIRRORS.index(now)
        sits[f"{finger}_mirror"] = float(code)
        if source in seen_px:
            gels[f"tactile_{finger}"] = as_numbers(turned(seen_px[source], now))
    kept = tuple(sits.get(name, value) for name, value in values.items())
    cameras = {f"tactile_{f}": names[f"tactile_{s}"] for f, s in sources.items()}
    return store.accept(replace(measured, values=kept), {**names, **cameras}, person, gels=gels)


def _places(gels_px: Sequence[float]) -> list[FloatArray]:
    """Return the dots (63, 2) of each finger, none where no fingerprint was taken."""
    return [as_places(gels_px[i : i + NUMBERS]) for i in range(0, len(gels_px), NUMBERS)]


def as_metadata(used: Used) -> tuple[tuple[str, str], ...]:
    """Return the pairs that an episode keeps: which calibration, by its SHA-256."""
    return tuple((f"calibration_{what}", record.sha256) for what, record in used.items())
