"""Sources of camera images: V4L2, files, streams."""

from __future__ import annotations

import os
import select
import stat
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from touchdown.backend.config import GelsightSettings
from touchdown.backend.core import ImageArray
from touchdown.backend.devices.cameras.system import lock_controls
from touchdown.backend.devices.gelsight import JpegStream

CHUNK = 1 << 16
DEFAULT_RATE_HZ = 25.0
IDLE_S = 0.01
MANUAL_EXPOSURE = 1.0
_FOURCC = cv2.VideoWriter.fourcc(*"MJPG")


class Source(Protocol):
    """An open camera; ``lost``: pictures that came damaged or were overtaken by a newer one."""

    lost: int

    @property
    def facts(self) -> Mapping[str, float]:
        """What it answers to the format and controls that were set."""

    def read(self, limit_s: float) -> bytes | ImageArray | None:
        """Return the next picture, a JPEG or an image; None if there is none in time."""

    def close(self) -> None:
        """Let go of the camera; its controls stay as set."""


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
            "fourcc": (cv2.CAP_PROP_FOURCC, float(_FOURCC)),  # before the size
            "width_px": (cv2.CAP_PROP_FRAME_WIDTH, settings.width_px),
            "height_px": (cv2.CAP_PROP_FRAME_HEIGHT, settings.height_px),
            "buffer_size": (cv2.CAP_PROP_BUFFERSIZE, settings.buffer_size),
            "exposure_auto": (cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL_EXPOSURE),
            "exposure": (cv2.CAP_PROP_EXPOSURE, settings.exposure),
            "white_balance_auto": (cv2.CAP_PROP_AUTO_WB, 0.0),
            "white_balance": (cv2.CAP_PROP_WB_TEMPERATURE, settings.white_balance),
        }
        for number, value in wanted.values():
            self._capture.set(number, value)
        self._raw = settings.keep_jpeg and bool(self._capture.set(cv2.CAP_PROP_CONVERT_RGB, 0.0))
        told = {name: float(self._capture.get(number)) for name, (number, _) in wanted.items()}
        locked = lock_controls(path, settings)  # OpenCV knows no names, and not all of them
        fps = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.facts: Mapping[str, float] = {**told, **locked, "fps": fps}

    def read(self, limit_s: float) -> bytes | ImageArray | None:
        """Return the next picture; blocks as long as the driver of the system does."""
        there, picture = self._capture.read()
        if not there or picture is None or not picture.size:
            return None
        image = np.asarray(picture, dtype=np.uint8)
        return image.tobytes() if self._raw and image.shape[0] == 1 else image

    def close(self) -> None:
        """Release the device."""
        self._capture.release()


class PipeSource:
    """A named pipe into which somebody writes JPEGs end to end."""

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
            if not data:  # nobody writes: the pipe is always "readable" then
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
    """A video played at its own rate, from the start again when it ends."""

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


def open_source(path: Path, settings: GelsightSettings) -> Source:
    """Open what ``path`` is: a pipe, a device, or a video file."""
    mode = path.stat().st_mode
    if stat.S_ISFIFO(mode):
        return PipeSource(path)
    if stat.S_ISREG(mode):
        return FileSource(path)
    return UvcSource(path, settings)
