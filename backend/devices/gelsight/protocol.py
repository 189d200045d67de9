"""Names and MJPEG frames of a GelSight Mini."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

from touchdown.backend.devices.framing import WireError

LONGEST = 256


@dataclass(frozen=True, slots=True)
class CardName:
    """Name of a video device; ``serial`` is None if it is no GelSight Mini or cut off."""

    name: str
    serial: str | None
    is_gelsight: bool


def decode(content: bytes) -> CardName:
    """Return what the content of a ``/sys/class/video4linux/*/name`` file says."""
    name = content[:LONGEST].decode("utf-8", "replace").strip("\n\x00 ")
    if "GelSight Mini" not in name:
        return CardName(name, None, is_gelsight=False)
    serial = re.search(r"\b[A-Z0-9]{4}-[A-Z0-9]{4}\b", name)
    return CardName(name, serial[0] if serial else None, is_gelsight=True)


START, END = b"\xff\xd8\xff", b"\xff\xd9"
LONGEST_JPEG_BYTES = 16 << 20
"""Bytes of one picture; what goes on longer is noise."""
_SIZED = frozenset({0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF})
_SCAN = 0xDA
_TABLES = frozenset({0xC4, 0xDB, 0xDD, _SCAN}) | _SIZED
"""Huffman codes, quantisation, restarts, scan, frame: what the picture data are read by."""


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
            elif len(self._rest) > LONGEST_JPEG_BYTES:
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
    raise WireError("header", "jpeg picture")


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
