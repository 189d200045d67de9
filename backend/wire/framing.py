"""What all codecs share: one error, the stream decoder, and how it finds its place again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

from backend.core.faults import TouchdownError

Message = TypeVar("Message")


class WireError(TouchdownError):
    """Bytes, or a message, that the protocol does not allow.

    ``what`` is one word such as "length" or "crc"; ``where`` names message and field; ``offset``
    counts bytes from the start of the message.
    """

    def __init__(self, what: str, where: str, offset: int = 0) -> None:
        super().__init__(f"{what} [{where}, byte {offset}]")
        self.what, self.where, self.offset = what, where, offset


class Step(NamedTuple, Generic[Message]):
    """What was found at one place: ``length`` bytes are a message, refused, or noise."""

    length: int
    message: Message | None = None
    refused: bool = False


Take = Callable[[bytes, int], Step[Message] | None]
"""(bytes, place) -> what is found there, or None while the bytes do not suffice to tell."""

Overtake = Callable[[Take[Message], bytes, int], bool]
"""(take, bytes, place of an unfinished message) -> whether to go on without it."""


def two_in_a_row(take: Take[Message], data: bytes, at: int) -> bool:
    """Return whether two whole messages lie end to end behind ``at``.

    So a false header whose length field promises much does not hold up the stream.
    """
    place = at + 1
    while place < len(data):
        first = take(data, place)
        if first is not None and first.message is not None:
            behind = place + first.length
            second = take(data, behind) if behind < len(data) else None
            if second is not None and second.message is not None:
                return True
        place += first.length if first is not None and first.message is None else 1
    return False


class FrameStream(Generic[Message]):
    """The stream decoder of a protocol, given how to ``take`` one message from a place."""

    def __init__(self, take: Take[Message], overtake: Overtake[Message] = two_in_a_row) -> None:
        self._take, self._overtake = take, overtake
        self._rest = b""
        self.bad_frames = self.bad_in_a_row = self.discarded = 0

    @property
    def pending(self) -> int:
        """Bytes kept of an unfinished message."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[Message]:
        """Take the next bytes; return the messages they complete, oldest first."""
        rest, at = self._rest + data, 0
        messages: list[Message] = []
        while at < len(rest):
            step = self._take(rest, at)
            if step is None:
                if not self._overtake(self._take, rest, at):
                    break
                # As where all of it has come and is none: the same however the stream is cut.
                step = Step(1, refused=True)
            at += step.length
            self._count(step)
            if step.message is not None:
                messages.append(step.message)
        self._rest = rest[at:]
        return messages

    def reset(self) -> None:
        """Forget the bytes of an unfinished message; the counts stay."""
        self._rest = b""

    def _count(self, step: Step[Message]) -> None:
        if step.message is None:
            self.discarded += step.length
        elif not step.refused:
            self.bad_in_a_row = 0
        if step.refused:
            self.bad_frames += 1
            self.bad_in_a_row += 1


def expect_length(data: bytes, length: int, where: str) -> None:
    """Raise ``WireError`` unless ``data`` is exactly ``length`` bytes."""
    if len(data) != length:
        raise WireError("length", where, min(len(data), length))


def noise_until(data: bytes, at: int, starts: bytes) -> Step[Message]:
    """Return the step over all bytes up to the next that may start a message, at least one."""
    end = at + 1
    while end < len(data) and data[end] not in starts:
        end += 1
    return Step(end - at)
