"""Text protocols: lines that end with CR, LF, both, or with silence."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from backend.wire.framing import WireError

Message = TypeVar("Message")

ENDS = b"\r\n"


class LineStream(Generic[Message]):
    """Stream decoder of lines; ``parse`` gets one line without its end, ``longest`` bytes at most.

    Where a device sends no line end, call ``flush`` once it has been silent long enough.
    """

    def __init__(self, parse: Callable[[bytes], Message], longest: int) -> None:
        self._parse, self._longest = parse, longest
        self._rest = b""
        self._skipping = False
        self.bad_frames = self.bad_in_a_row = self.discarded = 0

    @property
    def pending(self) -> int:
        """Bytes kept of an unfinished line."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[Message]:
        """Take the next bytes; return the messages they complete, oldest first."""
        *whole, rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        messages: list[Message] = []
        for line in whole:
            self._finish(line, messages)
        self._rest = rest
        if len(rest) > self._longest:
            self.discarded += len(rest)
            self._rest, self._skipping = b"", True
        return messages

    def flush(self) -> list[Message]:
        """Take what has come so far as a whole line."""
        messages: list[Message] = []
        line, self._rest = self._rest, b""
        self._finish(line, messages)
        return messages

    def reset(self) -> None:
        """Forget the unfinished line; the counts stay."""
        self._rest, self._skipping = b"", False

    def _finish(self, line: bytes, messages: list[Message]) -> None:
        skipping, self._skipping = self._skipping, False
        if not line and not skipping:
            return
        try:
            if skipping or len(line) > self._longest:
                raise WireError("length", "line", self._longest)
            messages.append(self._parse(line))
        except WireError:
            self.discarded += len(line)
            self.bad_frames += 1
            self.bad_in_a_row += 1
        else:
            self.bad_in_a_row = 0
