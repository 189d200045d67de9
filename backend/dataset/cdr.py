"""CDR, the wire form of ROS 2 messages: little-endian XCDR1, offsets counted after 4 bytes.

Source: OMG DDSI-RTPS 2.5 chapter 10 and DDS-XTypes 1.3 section 7.4.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

ENCAPSULATION = b"\x00\x01\x00\x00"


class CdrWriter:
    """Appends fields in order; each primitive is aligned to its own size."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def align(self, size: int) -> None:
        """Pad with zeros to a multiple of ``size``."""
        self._bytes.extend(bytes(-len(self._bytes) % size))

    def number(self, kind: str, value: float) -> None:
        """Append one number; ``kind`` is its ``struct`` letter (B H i I f d)."""
        self.align(struct.calcsize(kind))
        self._bytes.extend(struct.pack("<" + kind, value))

    def text(self, value: str) -> None:
        """Append a string: length with the final NUL, bytes, NUL."""
        content = value.encode("utf-8") + b"\x00"
        self.number("I", len(content))
        self._bytes.extend(content)

    def sequence(self, values: NDArray[np.generic] | bytes) -> int:
        """Append a count and the elements; returns the offset of the first element."""
        array = np.frombuffer(values, np.uint8) if isinstance(values, bytes) else values
        self.number("I", array.size)
        if array.size:
            self.align(array.dtype.itemsize)
        start = len(self._bytes)
        self._bytes.extend(np.ascontiguousarray(array).tobytes())
        return start

    def header(self, stamp_ns: int, frame_id: str) -> None:
        """Append a ``std_msgs/Header``."""
        self.number("i", stamp_ns // 1_000_000_000)
        self.number("I", stamp_ns % 1_000_000_000)
        self.text(frame_id)

    def numbers(self, kind: str, values: Sequence[float]) -> None:
        """Append several numbers of one kind."""
        for value in values:
            self.number(kind, value)

    @property
    def size(self) -> int:
        """Bytes so far, without the encapsulation."""
        return len(self._bytes)

    def finish(self) -> bytes:
        """Return the message with its encapsulation."""
        return ENCAPSULATION + bytes(self._bytes)


class CdrReader:
    """Takes fields in order; raises ``ValueError`` where the message is too short or foreign."""

    def __init__(self, message: bytes | memoryview) -> None:
        if len(message) < 4 or bytes(message[:4]) != ENCAPSULATION:
            raise ValueError("not a little-endian CDR message")
        self._data = memoryview(message)[4:]
        self._at = 0

    def _take(self, count: int) -> memoryview:
        if count < 0 or self._at + count > len(self._data):
            raise ValueError("the message is shorter than its content")
        part = self._data[self._at : self._at + count]
        self._at += count
        return part

    def number(self, kind: str) -> float:
        """Take one number."""
        size = struct.calcsize(kind)
        self._at += -self._at % size
        value: float = struct.unpack("<" + kind, self._take(size))[0]
        return value

    def integer(self, kind: str) -> int:
        """Take one whole number."""
        return int(self.number(kind))

    def text(self) -> str:
        """Take a string."""
        content = bytes(self._take(self.integer("I")))
        return content[:-1].decode("utf-8")

    def sequence(self, dtype: str) -> NDArray[np.generic]:
        """Take a sequence as a new array of ``dtype`` such as ``<f4``."""
        count = self.integer("I")
        kind = np.dtype(dtype)
        if count:
            self._at += -self._at % kind.itemsize
        return np.frombuffer(self._take(count * kind.itemsize), kind).copy()

    def header(self) -> tuple[int, str]:
        """Take a ``std_msgs/Header``: (stamp in ns, frame)."""
        seconds = self.integer("i")
        return seconds * 1_000_000_000 + self.integer("I"), self.text()
