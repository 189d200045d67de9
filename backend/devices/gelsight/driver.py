"""Driver of a GelSight Mini camera.

One thread reads, one decodes; a newer picture replaces an undecoded one. A camera is found by the
serial number in its card name, never by the order of video devices.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeAlias, TypeVar

import numpy as np

from touchdown.backend.config import GelsightSettings, HardwareSettings
from touchdown.backend.core import Fault, FaultError, Finger, ImageArray, Stream, TactileFrame
from touchdown.backend.devices import protocols
from touchdown.backend.devices.cameras import PictureFilter, PictureSource, link_fault, open_source

T = TypeVar("T")


class Mailbox(Generic[T]):
    """Queue of one item; ``skipped`` counts the replaced ones."""

    def __init__(self) -> None:
        self._item: T | None = None
        self._there = threading.Condition()
        self.skipped = 0

    def put(self, item: T) -> None:
        """Put an item, replacing the former one."""
        with self._there:
            self.skipped += self._item is not None
            self._item = item
            self._there.notify()

    def take(self, limit_s: float) -> T | None:
        """Return and remove the newest item; None after the time limit."""
        with self._there:
            self._there.wait_for(lambda: self._item is not None, limit_s)
            item, self._item = self._item, None
            return item


LONGEST = 256


def read_serial(content: bytes) -> str | None:
    """Return the serial number of a ``/sys/class/video4linux/*/name`` file; None if it is cut off,
    or if the device is no GelSight Mini.
    """
    serial = re.search(rb"GelSight Mini.*\b([A-Z0-9]{4}-[A-Z0-9]{4})\b", content[:LONGEST])
    return serial[1].decode() if serial else None


BY_ID = "*-index0"  # the second node of a camera carries no pictures


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A GelSight Mini: its serial number and the path to open."""

    serial: str
    path: Path


def find_cameras(by_id: Path, names: Path, nodes: Path) -> list[FoundCamera]:
    """Return all GelSight Minis, by serial number.

    ``by_id`` is the system's folder of stable links; without it, ``names`` is the folder of card
    names and ``nodes`` that of the devices. Entries that change meanwhile are left out.
    """
    found = {camera.serial: camera for camera in _by_name(names, nodes)}
    found.update((camera.serial, camera) for camera in _by_id(by_id))
    return [found[serial] for serial in sorted(found)]


def _by_id(folder: Path) -> Iterator[FoundCamera]:
    for link in sorted(folder.glob(BY_ID)):
        serial = read_serial(link.name.replace("_", " ").encode())
        if serial is not None and link.exists():
            yield FoundCamera(serial, link)


def _by_name(folder: Path, nodes: Path) -> Iterator[FoundCamera]:
    for entry in sorted(folder.glob("video*"), key=_number):
        try:
            index = (entry / "index").read_text("ascii").strip()
            serial = read_serial((entry / "name").read_bytes())
        except (OSError, UnicodeDecodeError):
            continue
        if index == "0" and serial is not None:
            yield FoundCamera(serial, nodes / entry.name)


def _number(entry: Path) -> int:
    digits = re.search(r"\d+$", entry.name)
    return int(digits[0]) if digits else -1


CAPACITY = 256
READ_S = 0.05
TAKE_S = 0.1
JOIN_S = 1.0
STALE_S = 0.12
# A camera without its device is unplugged after this time without a valid picture.
GONE_S = 0.045
RETRY_S = (0.5, 1.0, 1.5)
Captured: TypeAlias = tuple[float, int, bytes | ImageArray]


class TactileCamera:
    """Camera of one finger; pictures are stamped by ``now_s`` on arrival. ``identity`` is given if
    ``open_camera`` needs no path.
    """

    def __init__(
        self,
        finger: Finger,
        settings: GelsightSettings,
        now_s: Callable[[], float],
        frames: Stream[TactileFrame] | None = None,
        open_camera: Callable[[Path, GelsightSettings], PictureSource] = open_source,
        identity: protocols.Identity | None = None,
    ) -> None:
        self.finger: Finger = finger
        self.name = f"tactile_{finger}"
        self._settings = settings
        self._own = settings.left if finger == "left" else settings.right
        self._now_s, self._open_camera, self._given = now_s, open_camera, identity
        self.frames = frames or Stream[TactileFrame](self.name, CAPACITY)
        self._newest: Mailbox[Captured] = Mailbox()
        self._stop, self._first = threading.Event(), threading.Event()
        self._threads: list[threading.Thread] = []
        # State of the connection; FAULT while the camera is missing or hangs.
        self.state = protocols.DeviceState.CLOSED
        self.identity: protocols.Identity | None = None  # None before the first connection
        self._facts: Mapping[str, float] = {}
        self._arrivals = protocols.ArrivalCounter()
        self._damaged = self.reopened = self._sequence = 0
        self._gate = self._new_gate()
        self.steps = protocols.ConnectionSteps()
        self.fault: Fault | None = None

    @property
    def health(self) -> protocols.Health:
        """Delivered pictures per second, age of the newest, counts; ``lost`` are undelivered
        pictures.
        """
        lost = self._damaged + self._gate.invalid + self._newest.skipped
        return self._arrivals.health(self._now_s(), lost)

    def describe(self) -> Mapping[str, str | float]:
        """Return condition, scale, and the camera's format and controls."""
        stale = self.state is protocols.DeviceState.READY and self.health.age_s > STALE_S
        return {
            "kind": self.identity.model if self.identity else "GelSight Mini",
            "condition": "stale" if stale else self.state.value,
            "mm_per_px_x": self._settings.mm_per_px_x,
            "mm_per_px_y": self._settings.mm_per_px_y,
            "mirror": self._own.mirror,
            "invalid": self._gate.invalid,
            "skipped": self._newest.skipped,
            "reopened": self.reopened,
            **self._facts,
        }

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Find the camera by its serial number, open it, wait for the first bright picture."""
        if self.state is protocols.DeviceState.READY:
            return
        self.close()
        self.state, self.fault = protocols.DeviceState.CONNECTING, None
        self.steps.begin()
        self._stop, self._first, self._newest = threading.Event(), threading.Event(), Mailbox()
        self._damaged = self.reopened = self._sequence = 0
        self._gate = self._new_gate()
        self._arrivals = protocols.ArrivalCounter()
        targets = (self._watch, self._deliver)
        self._threads = [
            threading.Thread(target=run, args=(self._stop,), name=self.name, daemon=True)
            for run in targets
        ]
        for thread in self._threads:
            thread.start()
        end_s = self._now_s() + timeout_s
        while not self._first.wait(READ_S) or cancel.is_set():
            if cancel.is_set():
                self.close()
                raise FaultError(link_fault(self.name, "Connecting was cancelled."))
            if self._now_s() > end_s:
                self.close()
                raise FaultError(self._why or link_fault(self.name, "No picture comes."))

    def close(self) -> None:
        """Stop reading and release the camera; a blocked thread ends by itself."""
        self._stop.set()
        for thread in self._threads:
            thread.join(JOIN_S)
        self._threads = []
        self.state = protocols.DeviceState.CLOSED

    def _new_gate(self) -> PictureFilter:
        return PictureFilter(self.finger, self.name, self._settings, self._now_s())

    def find(self) -> Path:
        """Return the path of the camera; raises ``FaultError``."""
        if self._given is not None:
            self.identity = self._given
            return Path(self.name)
        if self._own.file:
            self.identity = protocols.Identity("", "video file", Path(self._own.file).name, "")
            return Path(self._own.file)
        folders = self._settings.by_id, self._settings.names, self._settings.nodes
        found = {camera.serial: camera.path for camera in find_cameras(*map(Path, folders))}
        if self._own.serial not in found:
            there = ", ".join(found) or "none"
            what = f"No camera with the number '{self._own.serial}' is plugged in (there: {there})."
            raise FaultError(link_fault(self.name, what))
        self.identity = protocols.Identity("GelSight", "GelSight Mini", self._own.serial, "")
        return found[self._own.serial]

    def _watch(self, stop: threading.Event) -> None:
        """Read the camera; reopen the same camera after each loss."""
        tries = 0
        while not stop.is_set():
            try:
                path = self.find()
                self.steps.reached("identify")
                node = path.resolve()
                source = self._open_camera(path, self._settings)
                self.steps.reached("configure")
            except (OSError, FaultError) as error:
                what = error.fault if isinstance(error, FaultError) else None
                self._fail(what or link_fault(self.name, f"The camera cannot be opened: {error}."))
                stop.wait(RETRY_S[min(tries, len(RETRY_S) - 1)])
                tries += 1
                continue
            self._facts = source.facts
            try:
                self._read(source, node, stop)
            except OSError as error:
                self._fail(link_fault(self.name, f"The camera is lost: {error}."))
            finally:
                source.close()
            self.reopened += not stop.is_set()
            tries = 0

    def _read(self, source: PictureSource, node: Path, stop: threading.Event) -> None:
        """Read until the stop, a silence, or the loss of ``node``. Picture numbers continue after a
        replug.
        """
        begun_s = heard_s = new_s = self._now_s()
        damaged = self._damaged
        before: bytes | ImageArray | None = None
        while not stop.is_set():
            content = source.read(READ_S)
            now_s, self._damaged = self._now_s(), damaged + source.lost
            if content is not None:
                heard_s = now_s
                self._newest.put((now_s, self._sequence, content))
                self._sequence += 1
                new_s = now_s if before is None or not np.array_equal(content, before) else new_s
                before = content
            elif now_s - heard_s > self._settings.silence_s:
                raise OSError(f"no picture for {now_s - heard_s:.1f} s")
            # A read from a removed camera may return data, or the last picture.
            shown_s = min(max(begun_s, self._arrivals.last_s), new_s)
            if self._given is None and now_s - shown_s > GONE_S and not node.exists():
                raise OSError("it was unplugged")

    def _deliver(self, stop: threading.Event) -> None:
        while not stop.is_set():
            taken = self._newest.take(TAKE_S)
            if taken is not None:
                self._take(*taken)

    def _take(self, t_s: float, sequence: int, content: bytes | ImageArray) -> None:
        image = self._gate.judge(t_s, content)
        if self._gate.fault is not None:
            self._fail(self._gate.fault)
        if image is not None:
            jpeg = isinstance(content, bytes)
            self.frames.put(t_s, TactileFrame(self.finger, sequence, t_s, image, jpeg))
            self._arrivals.note(t_s)
            self.fault = None
            self.state = protocols.DeviceState.READY
            self.steps.reached("first sample")
            self._first.set()

    @property
    def _why(self) -> Fault | None:
        return self.fault

    def _fail(self, fault: Fault) -> None:
        self.fault = fault
        if self._first.is_set():
            self.state = protocols.DeviceState.FAULT


def make_gelsight(
    finger: Finger,
    settings: HardwareSettings,
    now_s: Callable[[], float],
    frames: Stream[TactileFrame],
) -> TactileCamera:
    """Return the camera of one finger, found by its serial number."""
    return TactileCamera(finger, settings.gelsight, now_s, frames)
