"""Whether the gels that the cameras see at connection are those they were calibrated with."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import cast

from backend.calibration.camera import AXES
from backend.calibration.gels import HELD_LIMIT_PX, LIMIT_PX, apart_px, as_places, turned, whose
from backend.calibration.record import Record
from backend.calibration.store import CalibrationStore
from backend.core.faults import Fault, FaultError
from backend.core.flow import FINGERS, Finger, FloatArray, TactileFrame
from backend.core.stream import Stream
from backend.devices.protocols import Device, DeviceState, Gripper
from backend.rig.connection import fault_of
from backend.runs.calibrated import device_names
from backend.sensing.reference import FRAMES, MOTION_FACTOR, NOISE_FLOOR_PX
from backend.sensing.rest import Rest, look_at_rest

WAIT_S, LOOK_S = 3.0, 0.02
"""A camera has so long for its pictures, looked for so often."""
FEWEST = 3
UNUSED = "The connection was closed again; nothing was moved."


class GelCheck:
    """Of one bench: ``store`` has the fingerprints (None: any 7 x 9 gel will do), ``frames``
    what the cameras send.

    ``pause`` lets ``LOOK_S`` pass, or ends it at once where connecting was cancelled.
    """

    def __init__(
        self,
        store: CalibrationStore | None,
        devices: Mapping[str, Device],
        frames: Mapping[Finger, Stream[TactileFrame]],
        pause: Callable[[threading.Event], object] = lambda cancel: cancel.wait(LOOK_S),
    ) -> None:
        self._store, self._devices, self._frames = store, devices, frames
        self._pause = pause

    def prove(self, name: str, cancel: threading.Event) -> None:
        """Raise ``FaultError`` if ``name`` is a camera with another gel than was calibrated.

        The faults: its own, or GEL-UNSEEN (too few pictures), GEL-GRID (no grid of 7 x 9),
        GEL-MOVES, and GEL-OTHER, which names whose gel it is where that is known. Other devices
        pass.
        """
        finger = next((finger for finger in FINGERS if name == f"tactile_{finger}"), None)
        if finger is None:
            return
        frames = self._newest(finger, cancel)
        if cancel.is_set():
            return
        if len(frames) < FEWEST:
            told = fault_of(self._devices[name])
            raise _unseen(name) if told is None else FaultError(told)
        seen = look_at_rest(frames)
        if not seen.grid.usable:
            what = f"{seen.grid.message[:1].upper()}{seen.grid.message[1:]}."
            raise _fault("GEL-GRID", name, what, "Clean the gel, or fit one of 7 x 9 dots.")
        self._compare(finger, seen)

    def _newest(self, finger: Finger, cancel: threading.Event) -> list[TactileFrame]:
        """Return the next pictures, fewer where the camera is slow."""
        stream, waited_s = self._frames[finger], 0.0
        begun = stream.count
        while stream.count - begun < FRAMES and waited_s < WAIT_S and not cancel.is_set():
            self._pause(cancel)
            waited_s += LOOK_S
        return stream.since(begun)[0]

    def _compare(self, finger: Finger, seen: Rest) -> None:
        name = f"tactile_{finger}"
        known = {one: turned(px, self._mirror(one)) for one, px in self._known().items()}
        if name not in known:
            return
        limit_px = LIMIT_PX if self._empty() else HELD_LIMIT_PX
        away_px = apart_px(seen.position_px, known[name])
        if away_px < limit_px:
            return
        if seen.motion_px > MOTION_FACTOR * NOISE_FLOOR_PX:
            what = f"The gel moves by {seen.motion_px:.2f} px: it cannot be told which one it is."
            raise _fault("GEL-MOVES", name, what, "Let go of the gel and connect again.")
        owner, mirror = whose(seen.position_px, known, name, limit_px)
        again = "" if self._store is None else self._store.command("camera")
        raise other_gel(finger, (away_px, limit_px), _next_step(name, owner, mirror), again)

    def _known(self) -> dict[str, FloatArray]:
        """Return the fingerprints of the raw pictures, by camera; none where they are of others."""
        if self._store is None:
            return {}
        standing = self._store.standing("camera", device_names(self._devices))
        record: Record | None = standing.record
        if record is None or standing.condition not in ("valid", "expired"):
            return {}
        return {name: as_places(numbers) for name, numbers in record.file.gels.items()}

    def _mirror(self, name: str) -> str:
        return str(self._devices[name].describe().get("mirror", "none"))

    def _empty(self) -> bool:
        """Whether the jaws are known to hold nothing."""
        gripper = self._devices.get("gripper")
        if gripper is None or gripper.state is not DeviceState.READY:
            return False
        return not cast("Gripper", gripper).status().holding


def other_gel(finger: Finger, px: tuple[float, float], next_step: str, again: str) -> FaultError:
    """Return the fault of a gel whose dots rest ``px[0]`` (limit ``px[1]``) from where they did.

    ``again``: the command that calibrates the cameras anew.
    """
    away_px, limit_px = px
    far = f"{away_px:.1f} px" if away_px < float("inf") else "too few dots seen"
    what = (
        f"The {finger} finger has another gel than when the cameras were calibrated: its dots "
        f"rest {far} from where they did (rms, limit {limit_px:g} px)."
    )
    on_purpose = f"If it was changed on purpose, run '{again}'."
    return _fault("GEL-OTHER", f"tactile_{finger}", what, f"{next_step} {on_purpose}")


def _next_step(name: str, owner: str, mirror: str) -> str:
    """Return what to do, by what the picture is like."""
    if owner and owner != name:
        other = owner.removeprefix("tactile_")
        return f"It is the gel of the {other} finger: put the two back."
    if owner:
        return f"The picture is mirrored in {AXES[mirror]}: look at the settings."
    return "Have gels or sensors been exchanged? Put the right one back."


def _unseen(name: str) -> FaultError:
    return _fault("GEL-UNSEEN", name, "Its pictures come too seldom.", "Look at its cable.")


def _fault(code: str, name: str, what: str, next_step: str) -> FaultError:
    return FaultError(Fault(code, what, UNUSED, next_step, name))
