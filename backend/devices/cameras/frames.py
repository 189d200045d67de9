"""Valid pictures from camera data: JPEG stream, decoding to 320 x 240 BGR, rejection of bad frames.

Frozen, dark and damaged pictures are rejected. Source of the JPEG structure: ITU T.81 annex B
(markers; FFh in picture data is always followed by 00h or a restart).
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from touchdown.backend.config import GelsightSettings
from touchdown.backend.core import Fault, Finger, ImageArray
from touchdown.backend.devices.framing import ProtocolError


def link_fault(name: str, what: str) -> Fault:
    """Return the fault of a missing or lost camera."""
    return Fault(
        "CAMERA-LINK",
        what,
        "This finger feels nothing.",
        "Check the USB cable; the camera is taken again by its number as soon as it is back.",
        name,
    )


def _camera(name: str) -> str:
    return f"{name.removeprefix('tactile_')} tactile camera"


def frozen_fault(name: str) -> Fault:
    """Return the fault of a camera that repeats the same picture."""
    return Fault(
        "CAMERA-FROZEN",
        f"The {_camera(name)} sends the same picture again and again.",
        "Its pictures are not used.",
        "Unplug the camera and plug it in again.",
        name,
    )


def dark_fault(name: str) -> Fault:
    """Return the fault of a camera whose pictures stay dark."""
    return Fault(
        "CAMERA-DARK",
        f"The pictures of the {_camera(name)} stay dark.",
        "No marker can be seen.",
        "Check the lamps of the sensor and its exposure.",
        name,
    )


START, END = b"\xff\xd8\xff", b"\xff\xd9"
LONGEST = 16 << 20  # maximum bytes of one picture
_SIZED = frozenset({0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF})
_SCAN = 0xDA
# Segments needed for decoding: Huffman codes, quantisation, restarts, scan, frame.
_TABLES = frozenset({0xC4, 0xDB, 0xDD, _SCAN}) | _SIZED


class JpegStream:
    """Stream decoder of pictures; one without an end is rejected at the next start."""

    def __init__(self) -> None:
        self._rest = b""
        self.bad_frames = self.discarded = 0

    @property
    def pending(self) -> int:
        """Number of bytes of an incomplete picture."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[bytes]:
        """Process the next bytes; return the completed pictures, oldest first."""
        seen = max(0, len(self._rest) - 2)
        self._rest += data
        pictures: list[bytes] = []
        while True:
            begin = self._rest.find(START)
            if begin != 0:
                self._skip(begin if begin > 0 else max(0, len(self._rest) - 2))
                seen = 0
                if begin < 0:
                    return pictures
            again = self._rest.find(START, max(1, seen))
            end = self._rest.find(END, max(len(START), seen))
            if again > 0 and (end < 0 or again < end):
                self._refuse(again)
            elif end > 0:
                pictures.append(self._rest[: end + 2])
                self._rest = self._rest[end + 2 :]
            elif len(self._rest) > LONGEST:
                self._refuse(len(self._rest))
            else:
                return pictures
            seen = 0

    def _skip(self, count: int) -> None:
        self.discarded += count
        self._rest = self._rest[count:]

    def _refuse(self, count: int) -> None:
        self._skip(count)
        self.bad_frames += 1


def size_px(picture: bytes) -> tuple[int, int]:
    """Return width and height of a JPEG from its frame header; raises ``ProtocolError``."""
    for kind, segment in _segments(picture):
        if kind in _SIZED and len(segment) >= 5:
            height, width = int.from_bytes(segment[1:3], "big"), int.from_bytes(segment[3:5], "big")
            if width and height:
                return width, height
            break
    raise ProtocolError("header", "jpeg picture")


def decoding_segments(picture: bytes) -> bytes:
    """Return the segments needed for decoding, without comments and vendor data.

    The pictures of a camera share few such headers: an unknown one is damaged.
    """
    return b"".join(
        bytes((kind,)) + segment for kind, segment in _segments(picture) if kind in _TABLES
    )


def _segments(picture: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield kind and content of the segments up to the first scan."""
    at = 2
    while at + 4 <= len(picture) and picture[at] == 0xFF:
        kind, length = picture[at + 1], max(2, int.from_bytes(picture[at + 2 : at + 4], "big"))
        yield kind, picture[at + 4 : at + 2 + length]
        if kind == _SCAN:
            return
        at += 2 + length


WIDTH_PX, HEIGHT_PX = 320, 240
MIRRORS = {"none": None, "x": 1, "y": 0, "both": -1}
_SHAPE_TOLERANCE = 0.02
# Grey level of blocks without data in libjpeg, and the size of a block after decoding at a quarter.
MISSING, LAST_PX = 128, 2
_REDUCED = {
    8: cv2.IMREAD_REDUCED_COLOR_8,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    1: cv2.IMREAD_COLOR,
}


def decode(content: bytes, crop_fraction: float) -> ImageArray:
    """Return the picture of a JPEG, decoded at the resolution needed after cropping. Raises
    ``ProtocolError`` if the decoder detects damage, or if data are missing.
    """
    width, height = size_px(content)
    kept = 1.0 - 2.0 * crop_fraction
    fits = (f for f in _REDUCED if width * kept >= f * WIDTH_PX and height * kept >= f * HEIGHT_PX)
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), _REDUCED[next(fits, 1)])
    if picture is None:
        raise ProtocolError("content", "jpeg picture", len(content))
    image = np.asarray(picture, dtype=np.uint8)
    if _ends_early(image):
        raise ProtocolError("length", "jpeg picture", len(content))
    return image


def _ends_early(picture: ImageArray) -> bool:
    """Return True if the last pixels are the decoder's filling for missing data. An illuminated gel
    never has this exact grey without noise in all three colours.
    """
    return bool((picture[-1, -LAST_PX:] == MISSING).all())


def fit_picture(picture: ImageArray, crop_fraction: float, mirror: str) -> ImageArray:
    """Return (240, 320, 3): cropped by ``crop_fraction`` on each side, scaled, mirrored. Raises
    ``ProtocolError`` if the result is not 4:3.
    """
    height, width = picture.shape[:2]
    rows, columns = round(height * crop_fraction), round(width * crop_fraction)
    cut = picture[rows : height - rows, columns : width - columns]
    height, width = cut.shape[:2]
    if not height or abs(width / height * HEIGHT_PX / WIDTH_PX - 1.0) > _SHAPE_TOLERANCE:
        raise ProtocolError("shape", f"picture of {width} x {height} px")
    if (height, width) != (HEIGHT_PX, WIDTH_PX):
        method = cv2.INTER_AREA if width > WIDTH_PX else cv2.INTER_CUBIC
        size = (WIDTH_PX, HEIGHT_PX)
        cut = np.asarray(cv2.resize(cut, size, interpolation=method), dtype=np.uint8)
    flip = MIRRORS[mirror]
    turned = cut if flip is None else cv2.flip(cut, flip)
    return np.array(turned, dtype=np.uint8)


# Number of equal pictures in a row that are rejected, and that are a fault.
EQUAL_INVALID, EQUAL_FAULT = 3, 10
# Time a camera may be dark after it was switched on; number of dark pictures in a row that are a
# fault later.
DARK_S, DARK_FAULT = 3.0, 5
MOST_HEADERS = 64


class PictureFilter:
    """Filter of the pictures of one connection from ``now_s`` on; the caller owns the clock.
    ``invalid`` counts rejected pictures; ``fault`` is the fault of the newest picture.
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
        """Return the picture for the tracker, (240, 320, 3); None if it is invalid."""
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
            return fit_picture(whole, crop, self._own.mirror)
        except ProtocolError:
            return None

    def _known(self, content: bytes) -> bool:
        """Return True if this header is the first or known; a new one is accepted at its second
        occurrence. Cameras that adapt their compression use some dozens of headers.
        """
        header = decoding_segments(content)
        known = not self._headers or header in self._headers
        self._headers.pop(header, None)
        self._headers[header] = None
        if len(self._headers) > MOST_HEADERS:
            del self._headers[next(iter(self._headers))]
        return known
