"""Picture sources of a camera: UVC device, pipe of JPEGs, video file.

All raise ``OSError``. Only the thread that opened a source reads it. Exposure and white balance are
locked under Linux by the kernel's control names (source: ``linux/videodev2.h``; names as printed by
``v4l2-ctl``).
"""

from __future__ import annotations

import errno
import os
import re
import select
import stat
import struct
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from touchdown.backend.config import GelsightSettings
from touchdown.backend.core import ImageArray
from touchdown.backend.devices.cameras.frames import JpegStream

# VIDIOC_QUERYCTRL, VIDIOC_G_CTRL, VIDIOC_S_CTRL.
QUERY, GET, SET = 0xC0445624, 0xC008561B, 0xC008561C
NEXT = 0x8000_0000
DISABLED, CLASS_TYPE = 0x1, 6
MOST = 256  # limit of the number of controls of a camera
V4L2_MANUAL_EXPOSURE = 1
_INFO = struct.Struct("<II32s4iI8x")
_VALUE = struct.Struct("<Ii")

# ``ioctl`` of one file: (file, request, content) -> content.
IoctlFunction = Callable[[int, int, bytes], bytes]


def lock_controls(
    path: Path, settings: GelsightSettings, ask: IoctlFunction | None = None
) -> Mapping[str, float]:
    """Disable automatic control, set exposure and white balance; return the values read back.
    Missing controls are left out; the result is empty on other systems. Nothing is raised.
    """
    try:
        import fcntl

        ask = ask or fcntl.ioctl
        file = os.open(path, os.O_RDWR | getattr(os, "O_NONBLOCK", 0))
    except (ImportError, OSError):
        return {}
    try:
        known = find_controls(file, ask)
        # Automatic modes first: they block the others.
        wanted = {
            "white_balance_auto": 0,
            "exposure_auto": V4L2_MANUAL_EXPOSURE,
            "exposure_priority": 0,
            "exposure": round(settings.exposure),
            "white_balance": round(settings.white_balance),
        }
        names = settings.control_names
        told = {
            key: _set(file, ask, known, names[key], value)
            for key, value in wanted.items()
            if key in names
        }
    except OSError:
        return {}
    finally:
        os.close(file)
    return {key: value for key, value in told.items() if value is not None}


def find_controls(file: int, ask: IoctlFunction) -> Mapping[str, int]:
    """Return the id of each control that can be used, by name."""
    found: dict[str, int] = {}
    last = 0
    for _ in range(MOST):
        try:
            content = ask(file, QUERY, _INFO.pack(last | NEXT, 0, b"", 0, 0, 0, 0, 0))
        except OSError as error:
            if error.errno == errno.EINVAL:  # no further control
                break
            raise
        last, kind, name, _, _, _, _, flags = _INFO.unpack(content)
        if kind != CLASS_TYPE and not flags & DISABLED:
            found[plain_name(name.partition(b"\0")[0].decode("utf-8", "replace"))] = last
    return found


def plain_name(title: str) -> str:
    """Return "Exposure Time, Absolute" as "exposure_time_absolute"."""
    return "_".join(re.findall(r"[a-z0-9]+", title.lower()))


def _set(
    file: int, ask: IoctlFunction, known: Mapping[str, int], names: tuple[str, ...], value: int
) -> float | None:
    """Set the first existing control of ``names`` and return its value."""
    control = next((known[name] for name in names if name in known), None)
    if control is None:
        return None
    try:
        ask(file, SET, _VALUE.pack(control, value))
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ERANGE, errno.EACCES, errno.EBUSY):
            raise
    return float(_VALUE.unpack(ask(file, GET, _VALUE.pack(control, 0)))[1])


CHUNK = 1 << 16
DEFAULT_RATE_HZ = 25.0
IDLE_S = 0.01
OPENCV_MANUAL_EXPOSURE = 1.0
_FOURCC = cv2.VideoWriter.fourcc(*"MJPG")


class PictureSource(Protocol):
    """An open camera; ``lost`` counts damaged and replaced pictures."""

    lost: int

    @property
    def facts(self) -> Mapping[str, float]:
        """Format and controls as read back."""

    def read(self, limit_s: float) -> bytes | ImageArray | None:
        """Return the next picture, a JPEG or an image; None after the time limit."""

    def close(self) -> None:
        """Close the camera; its controls stay as set."""


class UvcSource:
    """A camera through OpenCV: raw Motion JPEG, exposure and white balance locked."""

    def __init__(
        self,
        path: Path,
        settings: GelsightSettings,
        open_capture: Callable[..., Any] = cv2.VideoCapture,
    ) -> None:
        self.lost = 0
        self._capture = open_capture(str(path), cv2.CAP_V4L2)
        if not self._capture.isOpened():
            self._capture.release()
            raise OSError(f"{path} cannot be opened")
        wanted = {
            "fourcc": (cv2.CAP_PROP_FOURCC, float(_FOURCC)),  # must precede the size
            "width_px": (cv2.CAP_PROP_FRAME_WIDTH, settings.width_px),
            "height_px": (cv2.CAP_PROP_FRAME_HEIGHT, settings.height_px),
            "buffer_size": (cv2.CAP_PROP_BUFFERSIZE, settings.buffer_size),
            "exposure_auto": (cv2.CAP_PROP_AUTO_EXPOSURE, OPENCV_MANUAL_EXPOSURE),
            "exposure": (cv2.CAP_PROP_EXPOSURE, settings.exposure),
            "white_balance_auto": (cv2.CAP_PROP_AUTO_WB, 0.0),
            "white_balance": (cv2.CAP_PROP_WB_TEMPERATURE, settings.white_balance),
        }
        for number, value in wanted.values():
            self._capture.set(number, value)
        self._raw = settings.keep_jpeg and bool(self._capture.set(cv2.CAP_PROP_CONVERT_RGB, 0.0))
        told = {name: float(self._capture.get(number)) for name, (number, _) in wanted.items()}
        locked = lock_controls(path, settings)  # OpenCV knows no names and not all controls
        fps = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.facts: Mapping[str, float] = {**told, **locked, "fps": fps}

    def read(self, limit_s: float) -> bytes | ImageArray | None:
        """Return the next picture; blocks while the system's driver does."""
        there, picture = self._capture.read()
        if not there or picture is None or not picture.size:
            return None
        image = np.asarray(picture, dtype=np.uint8)
        return image.tobytes() if self._raw and image.shape[0] == 1 else image

    def close(self) -> None:
        """Release the device."""
        self._capture.release()


class PipeSource:
    """A named pipe with consecutive JPEGs."""

    facts: Mapping[str, float] = {}

    def __init__(self, path: Path) -> None:
        self.lost = 0
        self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self._decoder = JpegStream()
        self._overtaken = 0
        self._idle = threading.Event()

    def read(self, limit_s: float) -> bytes | ImageArray | None:
        """Return the newest whole picture."""
        end_s = time.monotonic() + limit_s
        while (left_s := end_s - time.monotonic()) > 0:
            if not select.select([self._file], [], [], left_s)[0]:
                return None
            data = self._take()
            pictures = self._decoder.feed(data)
            if pictures:
                self._overtaken += len(pictures) - 1
                self.lost = self._overtaken + self._decoder.bad_frames
                return pictures[-1]
            if not data:  # without a writer the pipe is always readable
                self._idle.wait(min(IDLE_S, left_s))
        return None

    def close(self) -> None:
        """Close the pipe."""
        os.close(self._file)

    def _take(self) -> bytes:
        taken = bytearray()
        try:
            while data := os.read(self._file, CHUNK):
                taken += data
        except BlockingIOError:
            pass
        return bytes(taken)


class FileSource:
    """A video played in a loop at its own rate."""

    def __init__(self, path: Path, rate_hz: float | None = None) -> None:
        self.lost = 0
        self._capture = cv2.VideoCapture(str(path))
        if not self._capture.isOpened():
            raise OSError(f"{path} is no video that OpenCV reads")
        told_hz = float(self._capture.get(cv2.CAP_PROP_FPS))
        self._rate_hz = rate_hz or (told_hz if 1.0 <= told_hz <= 1000.0 else DEFAULT_RATE_HZ)
        self.facts: Mapping[str, float] = {"fps": self._rate_hz}
        self._due_s = time.monotonic()
        self._idle = threading.Event()

    def read(self, limit_s: float) -> bytes | ImageArray | None:
        """Return the next picture when it is due."""
        wait_s = self._due_s - time.monotonic()
        if wait_s > limit_s:
            self._idle.wait(limit_s)
            return None
        self._idle.wait(max(0.0, wait_s))
        self._due_s = max(self._due_s + 1.0 / self._rate_hz, time.monotonic() - 1.0)
        there, picture = self._capture.read()
        if not there:
            self._capture.set(cv2.CAP_PROP_POS_FRAMES, 0.0)
            there, picture = self._capture.read()
        return np.asarray(picture, dtype=np.uint8) if there else None

    def close(self) -> None:
        """Close the file."""
        self._capture.release()


def open_source(path: Path, settings: GelsightSettings) -> PictureSource:
    """Open ``path``: a pipe, a device, or a video file."""
    mode = path.stat().st_mode
    if stat.S_ISFIFO(mode):
        return PipeSource(path)
    if stat.S_ISREG(mode):
        return FileSource(path)
    return UvcSource(path, settings)
