"""Which of the pictures that a camera sends are measurements: no frozen, dark or damaged ones."""

from __future__ import annotations

import numpy as np

from backend.config.hardware import GelsightSettings
from backend.core.faults import Fault
from backend.core.flow import Finger, ImageArray
from backend.devices.cameras.faults import dark_fault, frozen_fault
from backend.devices.cameras.picture import decode, fit
from backend.wire.framing import WireError
from backend.wire.mjpeg import tables

EQUAL_INVALID, EQUAL_FAULT = 3, 10
"""So many equal pictures in a row are no measurement; so many mean that the camera hangs."""
DARK_S, DARK_FAULT = 3.0, 5
"""So long a camera may be dark after it was switched on; so many dark pictures in a row are a fault
once it was bright."""
MOST_HEADERS = 64


class Gate:
    """Of one connection from ``now_s`` on; the caller owns the clock.

    ``invalid``: pictures that were none. ``fault``: of the newest picture, if it tells of one.
    """

    def __init__(self, finger: Finger, name: str, settings: GelsightSettings, now_s: float) -> None:
        self._settings, self._name = settings, name
        self._own = settings.left if finger == "left" else settings.right
        self._begun_s = now_s
        self._last: bytes = b""
        self._equal = 0
        self._lit = False
        self._dark = 0
        self._headers: dict[bytes, None] = {}
        self.invalid = 0
        self.fault: Fault | None = None

    def judge(self, t_s: float, content: bytes | ImageArray) -> ImageArray | None:
        """Return the picture as the tracker takes it, (240, 320, 3); None if it is none."""
        self.fault = None
        raw = content if isinstance(content, bytes) else content.tobytes()
        self._equal = self._equal + 1 if raw == self._last else 0
        self._last = raw
        image = None if self._equal + 1 >= EQUAL_INVALID else self._image(content)
        if self._equal + 1 == EQUAL_FAULT:
            self.fault = frozen_fault(self._name)
        if image is None:
            self.invalid += 1
            return None
        if float(np.mean(image)) >= self._settings.darkest_mean:
            self._lit, self._dark = True, 0
            return image
        self._dark += 1
        late = self._dark >= DARK_FAULT if self._lit else t_s - self._begun_s > DARK_S
        if late:
            self.fault = dark_fault(self._name)
        self.invalid += self._lit
        return None

    def _image(self, content: bytes | ImageArray) -> ImageArray | None:
        if isinstance(content, bytes) and not self._known(content):
            return None
        crop = self._own.crop_fraction
        crop = self._settings.crop_fraction if crop is None else crop
        try:
            whole = decode(content, crop) if isinstance(content, bytes) else content
            return fit(whole, crop, self._own.mirror)
        except WireError:
            return None

    def _known(self, content: bytes) -> bool:
        """Whether this header came before, or is the first; a new one is believed when it returns.

        Cameras that adapt their compression use some dozens of them.
        """
        header = tables(content)
        known = not self._headers or header in self._headers
        self._headers.pop(header, None)
        self._headers[header] = None
        if len(self._headers) > MOST_HEADERS:
            del self._headers[next(iter(self._headers))]
        return known
