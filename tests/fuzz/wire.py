"""Throw damaged bytes at every decoder: ``make fuzz``, or ``python -m tests.fuzz.wire``.

Seeded: random bytes, and published vectors cut, flipped, doubled, spliced and mixed with noise, fed
in pieces. Looked for are crashes (anything raised), hangs (``HANG_S`` for one input) and silently
wrong messages: one that does not decode again to itself, or whose bytes were never sent.
"""

from __future__ import annotations

import argparse
import faulthandler
import random
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from tests.backend.devices.codecs.codecs import CODECS, Codec
from tests.backend.devices.codecs.vectors import VECTORS
from tests.fuzz.readers import READERS
from touchdown.backend.cli.output import VerbOutput
from touchdown.backend.devices.framing import ProtocolError

HANG_S = 5.0
ARMED_S = 1.0
"""The watch for hangs is set anew so often."""
Key = tuple[str, str]
ALL: dict[Key, Codec] = {**CODECS, **{key: reader.codec for key, reader in READERS.items()}}


@dataclass
class Count:
    """What was tried on one decoder, and what came of it."""

    inputs: int = 0
    octets: int = 0
    messages: int = 0
    slowest_s: float = 0.0
    findings: list[str] = field(default_factory=list)


def seeds(key: Key) -> list[bytes]:
    if key in READERS:
        return list(READERS[key].seeds)
    return [
        bytes.fromhex(vector["hex"]) + CODECS[key].end
        for vector in VECTORS.values()
        if (vector["device"], vector["direction"]) == key
    ]


def damaged(rng: random.Random, known: list[bytes], *, whole: bool) -> bytes:
    """One input: mostly known messages, damaged in up to six ways; ``whole``: mostly one message.

    A datagram of the wrong length is refused at once, so most keep theirs.
    """
    if rng.random() < 0.1:
        return rng.randbytes(rng.randrange(400))
    if whole and rng.random() < 0.8:
        content = bytearray(rng.choice(known))
        for _ in range(rng.randrange(9)):
            rng.choice((_flip, _set))(rng, content, known)
        return bytes(content)
    content = bytearray(b"".join(rng.choices(known, k=rng.randint(1, 4))))
    for _ in range(rng.randrange(7)):
        rng.choice(DAMAGES)(rng, content, known)
    return bytes(content)


def _place(rng: random.Random, content: bytearray) -> int:
    return rng.randrange(len(content) + 1)


def _flip(rng: random.Random, content: bytearray, known: list[bytes]) -> None:
    if content:
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)


def _set(rng: random.Random, content: bytearray, known: list[bytes]) -> None:
    if content:
        content[rng.randrange(len(content))] = rng.choice(
            (0, 1, 0x0A, 0x10, 0x7F, 0x80, 0xAA, 0xFF)
        )


def _cut(rng: random.Random, content: bytearray, known: list[bytes]) -> None:
    start = _place(rng, content)
    del content[start : start + rng.randint(1, 12)]


def _truncate(rng: random.Random, content: bytearray, known: list[bytes]) -> None:
    del content[_place(rng, content) :]


def _insert(rng: random.Random, content: bytearray, known: list[bytes]) -> None:
    at = _place(rng, content)
    content[at:at] = rng.randbytes(rng.randint(1, 12))


def _double(rng: random.Random, content: bytearray, known: list[bytes]) -> None:
    at = _place(rng, content)
    content[at:at] = content[at : at + rng.randint(1, 40)]


def _splice(rng: random.Random, content: bytearray, known: list[bytes]) -> None:
    at = _place(rng, content)
    content[at:at] = rng.choice(known)


DAMAGES: tuple[Callable[[random.Random, bytearray, list[bytes]], None], ...] = (
    _flip,
    _set,
    _cut,
    _truncate,
    _insert,
    _double,
    _splice,
)


def wrong(codec: Codec, message: Any, content: bytes) -> str:
    """Say what is silently wrong with a decoded message; empty if nothing is."""
    if (
        codec.encode is None
        or "nan" in repr(message)
        or type(message).__name__ in ("WsgRefusal", "ModbusRefusal")
    ):
        return ""
    try:
        again = codec.encode(message)
    except ProtocolError as error:
        return f"cannot be encoded: {error}"
    if codec.messages(again + codec.end) != [message]:
        return "does not decode to itself"
    if codec.exact and again not in content:
        return "was never sent"
    return ""


def attempt(key: Key, content: bytes, cut: int | None, count: Count) -> None:
    codec, started = ALL[key], time.perf_counter()
    try:
        messages = codec.messages(content, cut)
        flaws = [flaw for message in messages if (flaw := wrong(codec, message, content))]
    except Exception as error:  # noqa: BLE001 any other exception is what is looked for
        messages, flaws = [], [f"raised {type(error).__name__}: {error}"]
    count.inputs += 1
    count.octets += len(content)
    count.messages += len(messages)
    count.slowest_s = max(count.slowest_s, time.perf_counter() - started)
    count.findings += [f"{flaw} (cut {cut}): {content.hex()}" for flaw in flaws]


def inputs(key: Key, seed: int) -> Iterator[tuple[bytes, int | None]]:
    """Inputs without end, the same for the same seed: bytes, and where the stream is cut."""
    rng, known = random.Random(f"{key} {seed}"), seeds(key)
    while True:
        content = damaged(rng, known, whole=ALL[key].stream is None)
        yield content, rng.choice((None, None, 1, 7, 64))


def fuzz(key: Key, seed: int, enough: Callable[[Count], bool]) -> Count:
    count, armed_s = Count(), float("-inf")
    # By processor time, so that a computer that is busy elsewhere is no hang: told, then killed.
    faulthandler.register(signal.SIGVTALRM, chain=True)
    for content, cut in inputs(key, seed):
        if enough(count):
            break
        if time.monotonic() - armed_s > ARMED_S:
            signal.setitimer(signal.ITIMER_VIRTUAL, HANG_S + ARMED_S)
            armed_s = time.monotonic()
        attempt(key, content, cut, count)
    signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
    return count


def main() -> int:
    """Fuzz every decoder (or those named) for some minutes each; exit code 1 with findings."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "devices", nargs="*", help="wsg-binary or wsg-binary/pc-to-device; none: all"
    )
    told = "of processor time per decoder (10)"
    parser.add_argument("--minutes", type=float, default=10.0, help=told)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    screen, bad, names = VerbOutput(), 0, tuple(given.devices)
    for key in [key for key in ALL if not given.devices or "/".join(key).startswith(names)]:
        until = time.process_time() + 60 * given.minutes
        count = fuzz(key, given.seed, lambda _, until=until: time.process_time() >= until)
        bad += len(count.findings)
        screen.say(
            f"{'/'.join(key):28} {count.inputs:9,} inputs {count.octets / 1e6:7.1f} MB "
            f"{count.messages:10,} messages  slowest {1000 * count.slowest_s:6.1f} ms  "
            f"{len(count.findings)} findings"
        )
        for finding in count.findings[:5]:
            screen.say(f"  {finding}")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
