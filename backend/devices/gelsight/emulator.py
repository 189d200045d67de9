"""Emulated GelSight Mini: a copy of the system's folders, with a named pipe in place of a device.

``by-id`` holds the stable links, ``names`` the card names, ``nodes`` the devices: two of each as
for a real camera, the second without pictures. After a replug the nodes have other numbers.
"""

from __future__ import annotations

import contextlib
import os
import select
import shutil
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from touchdown.backend import emulation
from touchdown.backend.core import Decimator, Finger, ImageArray, InputError

WIDTH_PX = 320  # picture width to which ``OTHER`` and ``TILE_COLUMNS`` refer
# Transform to another gel of the same kind: its dots are some 5 px away, as for two real sensors.
OTHER = np.array([[1.0, 0.012, 3.0], [-0.01, 0.985, 4.0]])
# Seven by nine pitches of 320 x 240 px: tiles side by side continue the grid.
TILE_ROWS, TILE_COLUMNS = (8, 232), (12, 308)
SMALLER = 0.88  # scale from 7 x 9 to 8 x 10 dots
RATE_HZ = 25.0
QUALITY = 95
DARKENING, HALVED = 16, 0.5
SERIAL = "2D8Y-69GR"
IDLE_S = 0.01


class GelsightServer(emulation.DeviceServer):
    """Server of pictures in ``folder`` at ``rate_hz``; several may share a folder."""

    def __init__(
        self,
        pictures: emulation.PictureFunction,
        folder: Path,
        serial: str = SERIAL,
        *,
        rate_hz: float = RATE_HZ,
        faults: emulation.Faults | None = None,
    ) -> None:
        super().__init__(faults or emulation.Faults("tactile_left"))
        self._pictures, self._folder, self._serial = pictures, folder, serial
        self._period_s = 1.0 / rate_hz
        self._last: bytes | None = None
        self._thinned = Decimator()
        self._light, self._seen_s = 1.0, 0.0
        for part in ("by-id", "names", "nodes"):
            (folder / part).mkdir(parents=True, exist_ok=True)
        self._node = self._plug()
        self._file: int | None = None

    @property
    def url(self) -> str:
        """The stable link to the pictures."""
        return str(self._link(0))

    def close(self) -> None:
        """Stop and remove the device."""
        super().close()
        self._remove_device()

    def _link(self, index: int) -> Path:
        name = f"usb-Arducam_GelSight_Mini_R0B_{self._serial}:_Ge-video-index{index}"
        return self._folder / "by-id" / name

    def _plug(self) -> Path:
        """Make the pipe at the first free even number, a silent one beside it, and their links;
        return the first.
        """
        number = 0
        while True:
            node = self._node_of(number)
            try:
                os.mkfifo(node)
                break
            except FileExistsError:
                number += 2
        self._mute = self._node_of(number + 1)
        self._mute.unlink(missing_ok=True)  # left by a killed process
        os.mkfifo(self._mute)
        for index, one in enumerate((node, self._mute)):
            entry = self._folder / "names" / one.name
            entry.mkdir(exist_ok=True)
            (entry / "name").write_text(f"GelSight Mini R0B {self._serial}: Ge\n", "utf-8")
            (entry / "index").write_text(f"{index}\n", "ascii")
            link = self._link(index)
            link.unlink(missing_ok=True)
            link.symlink_to(Path("..") / "nodes" / one.name)
        return node

    def _node_of(self, number: int) -> Path:
        return self._folder / "nodes" / f"video{number}"

    def _remove_device(self) -> None:
        self._close_pipe()
        for index, one in enumerate((self._node, self._mute)):
            link = self._link(index)
            if link.is_symlink() and link.readlink().name == one.name:
                link.unlink()
            shutil.rmtree(self._folder / "names" / one.name, ignore_errors=True)
            one.unlink(missing_ok=True)

    def _run(self) -> None:
        due_s = self._clock.now_s()
        while not self._stop.is_set():
            if self._is_unplugged():
                self._replug()
            now_s = self._clock.now_s()
            if now_s < due_s:
                self._stop.wait(min(due_s - now_s, IDLE_S))
                continue
            due_s = max(due_s + self._period_s, now_s - self._period_s)
            picture = self._picture(now_s)
            taken = [] if picture is None else [picture]
            for out in self.faults.outgoing(now_s, taken):
                self._write(self.damage(out))

    def _replug(self) -> None:
        """Remove the device during the fault; return as another node."""
        before = self._node
        self._remove_device()
        self._wait_until_plugged()
        try:
            before.touch()
            self._node = self._plug()
            before.unlink()
        except FileNotFoundError:
            # The folder was removed meanwhile.
            self._stop.set()

    def _picture(self, now_s: float) -> bytes | None:
        picture = self._pictures(now_s)
        slow = self.faults.find("slow", now_s)
        if picture is None:
            return None
        if slow is not None and slow.hz is not None and not self._thinned.takes(now_s, slow.hz):
            return None
        if self._last is not None and self.faults.active("freeze", now_s):
            return self._last
        if self.faults.active("dark", now_s):
            picture = np.asarray(picture // DARKENING, dtype=np.uint8)
        picture = self._changed(picture, now_s)
        self._last = encode(picture)
        return self._last

    def _changed(self, picture: ImageArray, now_s: float) -> ImageArray:
        for kind, fitted in GELS.items():
            if self.faults.active(kind, now_s):
                picture = fitted(picture)
        fading = self.faults.active("fade", now_s)
        self._light = self._light * HALVED ** (now_s - self._seen_s) if fading else 1.0
        self._seen_s = now_s
        return np.asarray(picture * self._light, dtype=np.uint8) if fading else picture

    def _write(self, out: bytes) -> None:
        """Write one picture if there is a reader; unread data are lost."""
        if not self._has_reader():
            return
        rest, file = memoryview(out), self._file
        while rest and file is not None and not self._stop.is_set():
            try:
                rest = rest[os.write(file, rest) :]
            except BlockingIOError:
                if not select.select([], [file], [], self._period_s)[1]:
                    break
            except BrokenPipeError:
                self._close_pipe()
                return
        self._log_sent(out[: len(out) - len(rest)])

    def _has_reader(self) -> bool:
        """Return True if the pipe has a reader; opens it for writing on the first one."""
        if self._file is None:
            with contextlib.suppress(OSError):  # no reader
                self._file = os.open(self._node, os.O_WRONLY | os.O_NONBLOCK)
                self.clients += 1
        return self._file is not None

    def _close_pipe(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None


def encode(picture: ImageArray) -> bytes:
    """Return the JPEG of a picture as the camera makes it: quality 95, no colour subsampling."""
    options = [
        cv2.IMWRITE_JPEG_QUALITY,
        QUALITY,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]
    _, content = cv2.imencode(".jpg", picture, options)
    return bytes(content)


def other_gel(picture: ImageArray) -> ImageArray:
    """Return the picture of another gel of the same kind."""
    height, width = picture.shape[:2]
    sized = OTHER * np.array([1.0, 1.0, width / WIDTH_PX])
    moved = cv2.warpAffine(picture, sized, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, dtype=np.uint8)


def small_dots(picture: ImageArray) -> ImageArray:
    """Return the picture of a gel with 8 x 10 small dots."""
    height, width = picture.shape[:2]
    scale = width / WIDTH_PX
    rows, columns = (
        slice(*(round(scale * px) for px in ends)) for ends in (TILE_ROWS, TILE_COLUMNS)
    )
    wider = np.tile(picture[rows, columns], (2, 2, 1))
    cut = wider[: round(height / SMALLER), : round(width / SMALLER)]
    smaller = cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(smaller, dtype=np.uint8)


# Fault kind -> transform to the picture of the fitted gel.
GELS = {"other_gel": other_gel, "small_dots": small_dots}


def emulate_gelsight(
    choice: emulation.EmulationChoice, faults: emulation.Faults
) -> emulation.Emulation:
    """Serve the pictures of a camera in a folder; raises ``InputError`` without either."""
    choice.network_port()
    if choice.folder is None or choice.port is not None or choice.pictures is None:
        raise InputError(
            "An emulated camera is a pipe in a folder.", "--folder", "Name a folder; no --port."
        )
    serial = choice.serial or SERIAL
    front = GelsightServer(choice.pictures, choice.folder, serial, faults=faults)
    return emulation.Emulation((front,), camera_tables(choice.folder, {choice.finger: serial}))


def camera_tables(folder: Path, serials: Mapping[Finger, str]) -> emulation.BenchTables:
    """Return the tables of a bench file for emulated cameras."""
    names = {"by_id": "by-id", "names": "names", "nodes": "nodes"}
    places = {key: str((folder / name).resolve()) for key, name in names.items()}
    own = {f"gelsight.{finger}": {"serial": serial} for finger, serial in serials.items()}
    return {"gelsight": {**places, "crop_fraction": 0.0}, **own}
