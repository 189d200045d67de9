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
    """Return the fault of a camera that is not, or no longer, there."""
    return Fault(
        "CAMERA-LINK",
        what,
        "This finger feels nothing.",
        "Check the USB cable; the camera is taken again by its number as soon as it is back.",
        name,
    )


def frozen_fault(name: str) -> Fault:
    """Return the fault of a camera that sends the same picture again and again."""
    return Fault(
        "CAMERA-FROZEN",
        "The camera sends the same picture again and again.",
        "Its pictures are not used.",
        "Unplug the camera and plug it in again.",
        name,
    )


def dark_fault(name: str) -> Fault:
    """Return the fault of a camera whose pictures stay dark."""
    return Fault(
        "CAMERA-DARK",
        "The pictures stay dark.",
        "No marker can be seen.",
        "Check the lamps of the sensor and its exposure.",
        name,
    )


START, END = b"\xff\xd8\xff", b"\xff\xd9"
LONGEST = 16 << 20  # bytes of one picture; what goes on longer is noise
_SIZED = frozenset({0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF})
_SCAN = 0xDA
# Huffman codes, quantisation, restarts, scan, frame: what the picture data are read by.
_TABLES = frozenset({0xC4, 0xDB, 0xDD, _SCAN}) | _SIZED


class JpegStream:
    """Cuts a stream into pictures; one whose end is missing is refused at the next start."""

    def __init__(self) -> None:
        self._rest = b""
        self.bad_frames = self.bad_in_a_row = self.discarded = 0

    @property
    def pending(self) -> int:
        """Bytes kept of an unfinished picture."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[bytes]:
        """Take the next bytes; return the pictures they complete, oldest first."""
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
                self.bad_in_a_row = 0
            elif len(self._rest) > LONGEST:
                self._refuse(len(self._rest))
            else:
                return pictures
            seen = 0

    def reset(self) -> None:
        """Forget the bytes of an unfinished picture; the counts stay."""
        self._rest = b""

    def _skip(self, count: int) -> None:
        self.discarded += count
        self._rest = self._rest[count:]

    def _refuse(self, count: int) -> None:
        self._skip(count)
        self.bad_frames += 1
        self.bad_in_a_row += 1


def size_px(picture: bytes) -> tuple[int, int]:
    """Return width and height of a JPEG from its frame header; raises ``WireError``."""
    for kind, segment in _segments(picture):
        if kind in _SIZED and len(segment) >= 5:
            height, width = int.from_bytes(segment[1:3], "big"), int.from_bytes(segment[3:5], "big")
            if width and height:
                return width, height
            break
    raise ProtocolError("header", "jpeg picture")


def tables(picture: bytes) -> bytes:
    """Return what the data of a picture are read by, without comments and the maker's own.

    Pictures of one camera have few such headers, so that one bit wrong in it makes a new one.
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
# The level that libjpeg gives blocks without data; so many pixels of the last one are looked at, as
# a block has at least after reduced decoding by four.
MISSING, LAST_PX = 128, 2
_REDUCED = {
    8: cv2.IMREAD_REDUCED_COLOR_8,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    1: cv2.IMREAD_COLOR,
}


def decode(content: bytes, crop_fraction: float) -> ImageArray:
    """Return the picture of a JPEG, decoded no finer than is needed after cropping.

    Raises ``WireError`` if it is damaged so that the decoder notices, or if its data ended before
    the picture did.
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
    """Whether the last pixels are what the decoder puts where data are missing.

    No lit gel ends in a patch of that very grey, without any noise and in all three colours.
    """
    return bool((picture[-1, -LAST_PX:] == MISSING).all())


def fit(picture: ImageArray, crop_fraction: float, mirror: str) -> ImageArray:
    """Return (240, 320, 3): ``crop_fraction`` cut off on each side, scaled, mirrored.

    Raises ``WireError`` if what is left is not of the shape 4:3.
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


# So many equal pictures in a row are no measurement; so many mean that the camera hangs.
EQUAL_INVALID, EQUAL_FAULT = 3, 10
# So long a camera may be dark after it was switched on; so many dark pictures in a row are a fault
# once it was bright.
DARK_S, DARK_FAULT = 3.0, 5
MOST_HEADERS = 64


class PictureFilter:
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
        except ProtocolError:
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
