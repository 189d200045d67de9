"""Use of calibrations on a connected bench: records in use, gel identity, wrist drift."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import cast

from touchdown.backend import core, sensing
from touchdown.backend.calibration import (
    AXES,
    FINGERPRINT_LIMIT_PX,
    FINGERPRINT_VALUES,
    HELD_LIMIT_PX,
    MIRROR_CODES,
    CalibrationName,
    CalibrationRecord,
    CalibrationStore,
    DeviceName,
    calibrated_positions,
    dots_to_numbers,
    fingerprint_distance_px,
    identify_gel,
    mirrored_dots,
    numbers_to_dots,
    require_calibrated_bottom,
)
from touchdown.backend.config import BenchMode
from touchdown.backend.devices import Device, DeviceState, Gripper
from touchdown.backend.geometry import Piece
from touchdown.backend.rig import fault_of
from touchdown.backend.runs.bench import Bench
from touchdown.backend.runs.requests import CollectRequest, Request, StackRequest

UsedCalibrations = Mapping[CalibrationName, CalibrationRecord]


def device_names(devices: Mapping[str, Device]) -> dict[str, DeviceName]:
    """Return the identity of each connected device, without its firmware version."""
    known = {name: device.identity for name, device in devices.items()}
    return {
        name: DeviceName(maker=who.maker, model=who.model, serial=who.serial)
        for name, who in known.items()
        if who is not None
    }


def calibrations_for(
    request: Request, mode: BenchMode, store: CalibrationStore | None, devices: Mapping[str, Device]
) -> UsedCalibrations:
    """Return the calibrations that a run uses.

    Stacking and collecting on hardware need all of them; other runs use those that are valid.

    Raises ``RefusedError`` naming the first calibration that is missing, expired, damaged, or of
    another device or bottom, and how it is measured.
    """
    required = mode == "hardware" and isinstance(request, StackRequest | CollectRequest)
    if store is not None:
        used = store.in_use(device_names(devices), required=required)
        if required and isinstance(request, StackRequest):
            bottom = "+".join(request.bottoms)
        elif required and isinstance(request, CollectRequest):
            bottom = request.bottom
        else:
            return used
        require_calibrated_bottom(used, bottom, store.step("board", f"--bottom {bottom}"))
        return used
    if required:
        raise core.RefusedError("CALIBRATION-MISSING", "This bench has no folder of calibrations.")
    return {}


def contact_height_mm(piece: Piece, bottom: str, used: UsedCalibrations) -> float:
    """Return the height of ``G`` at which the held piece touches ``bottom``; NaN if unknown.

    Uses the calibration of the board for this pair, otherwise the nominal grip height.
    """
    board = calibrated_positions(used).board
    if board is not None and board.is_of(piece.name, bottom):
        return board.contact_mm
    return math.nan if piece.grip_height_mm is None else piece.grip_height_mm


def payload_wrench(
    store: CalibrationStore | None,
    devices: Mapping[str, Device],
    used: UsedCalibrations | None = None,
) -> core.FloatArray | None:
    """Return the calibrated wrench (6,) of the empty gripper with a level hand, None if unknown.

    ``used`` are the calibrations that a run was checked with. They take precedence over files that
    changed since.
    """
    names = device_names(devices)
    record = None if used is None else used.get("payload")
    if record is not None:
        record = None if record.foreign(names) else record
    elif store is not None:
        standing = store.status("payload", names)
        record = standing.record if standing.condition == "valid" else None
    if record is None:
        return None
    values = record.file.values
    # Its height produces no moment while the hand is level.
    centre_mm = (values["com_x_mm"].value, values["com_y_mm"].value, 0.0)
    return sensing.gripper_payload(values["mass_kg"].value, centre_mm)


def accept_calibration(
    store: CalibrationStore,
    measured: core.CalibrationMeasured,
    devices: Mapping[str, Device],
    person: str = "",
) -> Path:
    """Accept a calibration measured with ``devices``; raises as ``CalibrationStore.accept``.

    For cameras it stores the serial number and the mirroring of each finger, and the fingerprint of
    each gel, independent of the settings during the measurement.
    """
    names = device_names(devices)
    if measured.what != "camera":
        return store.accept(measured, names, person)
    values = dict(zip(measured.names, measured.values, strict=True))
    sources: dict[core.Finger, core.Finger] = {finger: finger for finger in core.FINGERS}
    if values["exchanged"]:
        sources = {"left": "right", "right": "left"}
    mirrors: dict[str, float] = {"exchanged": 0.0}
    gels: dict[str, tuple[float, ...]] = {}
    # Markers (63, 2) of each finger, none without fingerprints
    starts = range(0, len(measured.gels_px), FINGERPRINT_VALUES)
    places = (numbers_to_dots(measured.gels_px[i : i + FINGERPRINT_VALUES]) for i in starts)
    seen_px = dict(zip(core.FINGERS, places, strict=False))
    for finger, source in sources.items():
        now = str(devices[f"tactile_{source}"].describe().get("mirror", "none"))
        code = round(values[f"{finger}_mirror"]) ^ MIRROR_CODES.index(now)
        mirrors[f"{finger}_mirror"] = float(code)
        if source in seen_px:
            gels[f"tactile_{finger}"] = dots_to_numbers(mirrored_dots(seen_px[source], now))
    kept = tuple(mirrors.get(name, value) for name, value in values.items())
    cameras = {f"tactile_{f}": names[f"tactile_{s}"] for f, s in sources.items()}
    return store.accept(replace(measured, values=kept), {**names, **cameras}, person, gels=gels)


def calibration_metadata(used: UsedCalibrations) -> tuple[tuple[str, str], ...]:
    """Return the metadata of an episode: SHA-256 of each calibration in use."""
    return tuple((f"calibration_{what}", record.sha256) for what, record in used.items())


WAIT_S, LOOK_S = 3.0, 0.02  # time limit and poll interval for the images of a camera
FEWEST = 3
UNUSED = "The connection was closed again; nothing was moved."


class GelCheck:
    """Check that each camera has the gel it was calibrated with.

    ``store`` holds the fingerprints; with None any 7 x 9 gel is accepted. ``frames`` are the
    streams of the cameras. ``pause`` waits ``LOOK_S`` or until connecting is cancelled.
    """

    def __init__(
        self,
        store: CalibrationStore | None,
        devices: Mapping[str, Device],
        frames: Mapping[core.Finger, core.Stream[core.TactileFrame]],
        pause: Callable[[threading.Event], object] = lambda cancel: cancel.wait(LOOK_S),
    ) -> None:
        self._store, self._devices, self._frames = store, devices, frames
        self._pause = pause

    def prove(self, name: str, cancel: threading.Event) -> None:
        """Raise ``FaultError`` if camera ``name`` has another gel than at its calibration.

        Codes: the fault of the device itself, GEL-UNSEEN (too few images), GEL-GRID (no 7 x 9
        grid), GEL-MOVES, and GEL-OTHER, which names the finger the gel belongs to if known. Other
        devices pass.
        """
        finger = next((finger for finger in core.FINGERS if name == f"tactile_{finger}"), None)
        if finger is None:
            return
        frames = self._newest(finger, cancel)
        if cancel.is_set():
            return
        if len(frames) < FEWEST:
            fault = fault_of(self._devices[name])
            if fault is not None:
                raise core.FaultError(fault)
            raise _fault("GEL-UNSEEN", name, "Its images arrive too slowly.", "Look at its cable.")
        seen = sensing.measure_rest(frames)
        if not seen.grid.usable:
            what = f"{seen.grid.message[:1].upper()}{seen.grid.message[1:]}."
            raise _fault("GEL-GRID", name, what, "Clean the gel, or fit one of 7 x 9 dots.")
        self._compare(finger, seen)

    def _newest(self, finger: core.Finger, cancel: threading.Event) -> list[core.TactileFrame]:
        """Return the next images; fewer from a slow camera."""
        stream, waited_s = self._frames[finger], 0.0
        begun = stream.count
        while (
            stream.count - begun < sensing.REST_FRAMES and waited_s < WAIT_S and not cancel.is_set()
        ):
            self._pause(cancel)
            waited_s += LOOK_S
        return stream.since(begun)[0]

    def _compare(self, finger: core.Finger, seen: sensing.GelRest) -> None:
        name = f"tactile_{finger}"
        known = {
            one: mirrored_dots(px, str(self._devices[one].describe().get("mirror", "none")))
            for one, px in self._known().items()
        }
        if name not in known:
            return
        limit_px = FINGERPRINT_LIMIT_PX if self._empty() else HELD_LIMIT_PX
        away_px = fingerprint_distance_px(seen.position_px, known[name])
        if away_px < limit_px:
            return
        if seen.motion_px > sensing.MOTION_FACTOR * sensing.NOISE_FLOOR_PX:
            what = f"The gel moves by {seen.motion_px:.2f} px: it cannot be identified."
            raise _fault("GEL-MOVES", name, what, "Let go of the gel and connect again.")
        owner, mirror = identify_gel(seen.position_px, known, name, limit_px)
        again = "" if self._store is None else self._store.step("camera")
        raise other_gel_fault(finger, (away_px, limit_px), _next_step(name, owner, mirror), again)

    def _known(self) -> dict[str, core.FloatArray]:
        """Return the fingerprints of the raw images by camera, empty if not of these cameras."""
        if self._store is None:
            return {}
        standing = self._store.status("camera", device_names(self._devices))
        record: CalibrationRecord | None = standing.record
        if record is None or standing.condition not in ("valid", "expired"):
            return {}
        return {name: numbers_to_dots(numbers) for name, numbers in record.file.gels.items()}

    def _empty(self) -> bool:
        gripper = self._devices.get("gripper")
        if gripper is None or gripper.state is not DeviceState.READY:
            return False
        return not cast("Gripper", gripper).status().holding


def other_gel_fault(
    finger: core.Finger, px: tuple[float, float], next_step: str, again: str
) -> core.FaultError:
    """Return the fault of a gel whose markers rest ``px[0]`` from the calibrated ones (limit
    ``px[1]``).

    ``again``: clause on how the cameras are calibrated.
    """
    away_px, limit_px = px
    far = f"{away_px:.1f} px" if away_px < float("inf") else "too few dots seen"
    what = (
        f"The {finger} finger has another gel than when the cameras were calibrated: its dots "
        f"rest {far} from where they did (rms, limit {limit_px:g} px)."
    )
    on_purpose = f"If it was changed on purpose, {again}."
    return _fault("GEL-OTHER", f"tactile_{finger}", what, f"{next_step} {on_purpose}")


def _next_step(name: str, owner: str, mirror: str) -> str:
    if owner and owner != name:
        other = owner.removeprefix("tactile_")
        return f"It is the gel of the {other} finger: put the two back."
    if owner:
        return f"The picture is mirrored in {AXES[mirror]}: check the settings."
    return "Check if gels or sensors were exchanged, and put the right one back."


def _fault(code: str, name: str, what: str, next_step: str) -> core.FaultError:
    return core.FaultError(core.Fault(code, what, UNUSED, next_step, name))


CLEAR_MM = 1.0  # clearance above the support that excludes contact
STILL_MM, STILL_RAD = 0.05, 0.001  # a hand within these limits is at rest
DRIFT_PERIOD_S = 0.08  # between two looks at the wrench, which takes minutes to drift
SETTLE_S = 0.2  # vibration has decayed after this time
SAME_MM = 0.3  # jaws within this limit still hold the same load
POSE_AGE_S = 0.2


class DriftMonitor:
    """Monitor of the wrist drift at rest in air. Call ``update`` once per bench step.

    ``surface_mm`` returns the height of ``G`` in contact.
    """

    def __init__(
        self, scene: Bench, surface_mm: Callable[[], float], publish: Callable[[core.Event], None]
    ) -> None:
        self._scene, self._surface_mm, self._publish = scene, surface_mm, publish
        self._cursor = scene.sensing.raw.samples.count
        self._watch, self._due_s = sensing.WrenchDriftEstimator(), -math.inf
        self._at_rest: core.Pose | None = None
        self._since_s = math.inf
        self._load: tuple[bool, float] | None = None

    def update(self) -> None:
        """Process new samples; publish ``Noticed`` when the drift exceeds its limit."""
        if (now_s := self._scene.now_s()) < self._due_s:
            return
        self._due_s = now_s + DRIFT_PERIOD_S
        samples = self._scene.sensing.raw.samples.since(self._cursor)
        self._cursor = samples.cursor
        if not self._at_rest_in_air():
            self._watch.leave()
            return
        settled = samples.t_s >= self._since_s + SETTLE_S
        self._watch.feed(samples.t_s[settled], samples.values[settled, :3])
        was, found = self._scene.sensing.drift, self._watch.drift()
        self._scene.sensing.drift = found
        if found is not None and found.named and not (was is not None and was.named):
            self._publish(core.Noticed(self._scene.now_s(), drift_notice(found)))

    def _at_rest_in_air(self) -> bool:
        status = self._scene.gripper.status()
        load = status.holding, status.width_mm
        known = self._load
        if known is None or load[0] != known[0] or abs(load[1] - known[1]) > SAME_MM:
            self._load = load
            self._watch.reload()
            self._at_rest = None
        pose = None
        with suppress(core.StaleSampleError):
            pose = self._scene.arm.pose(POSE_AGE_S)
        if (
            pose is None
            or math.hypot(pose.rx_rad, pose.ry_rad, pose.rz_rad) > core.LEVEL_TOLERANCE_RAD
        ):
            self._at_rest = None
            if pose is not None:
                self._watch.reload()
            return False
        if self._at_rest is None or not _at_rest(pose, self._at_rest):
            self._at_rest, self._since_s = pose, self._scene.now_s()
            return False
        return pose.z_mm >= self._surface_mm() + CLEAR_MM


def drift_notice(drift: sensing.WrenchDrift) -> core.Fault:
    """Return the notice of a drifting wrist sensor; nothing is latched."""
    per_min = 60.0 * drift.rate_n_s
    return core.Fault(
        "FT-DRIFT",
        f"The wrist sensor has drifted by {drift.moved_n:.2f} N in {drift.over_s:.0f} s, "
        f"in still air ({per_min:.1f} N a minute).",
        "Each probe takes its own tare; what drifts after that is read as force.",
        "Zero it in air (Z) before you use its values; let a cold sensor warm up. "
        "If it continues, check its mounting and cable.",
        "force_torque",
    )


def _at_rest(one: core.Pose, other: core.Pose) -> bool:
    # Scalars instead of arrays: ten times faster for six numbers in every step.
    moved = (one.x_mm - other.x_mm, one.y_mm - other.y_mm, one.z_mm - other.z_mm)
    turned = (one.rx_rad - other.rx_rad, one.ry_rad - other.ry_rad, one.rz_rad - other.rz_rad)
    return all(abs(d) <= STILL_MM for d in moved) and all(abs(d) <= STILL_RAD for d in turned)
