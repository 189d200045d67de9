"""Positions in R3 texts: degrees on the wire, rad in the messages.

Source: BFP-A4288-V; MELFA-BASIC detailed specifications (position constants).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from backend.wire.framing import WireError
from backend.wire.melfa_blocks import Pose
from backend.wire.wrench import Wrench, wrench_of

_ANGLES = re.compile(r"[ABC]|J[1-8]")
_NAME = re.compile(r"[XYZABC]|J[1-8]|L[12]")
_NUMBER = re.compile(r"[-+]?[0-9]{1,9}(?:\.[0-9]{1,9})?")
_NO_FLAGS = "****,****"
_VARIABLE = re.compile(r"([A-Za-z][A-Za-z0-9_]{0,15})=(.+)")
_POSITION = re.compile(r"\(([^()]*)\)\(([0-9]{1,10}),([0-9]{1,10})\)")


@dataclass(frozen=True, slots=True)
class Reading:
    """Answer to PPOSF or JPOSF: named axes in mm and rad.

    ``flags`` are None for joints. ``override`` in %. Limit bits 1 X or J1 to 32 C or J6.
    """

    names: tuple[str, ...]
    values: tuple[float, ...]
    flags: tuple[int, int] | None
    override: int
    speed_mm_s: float
    plus_limit: int = 0
    minus_limit: int = 0

    def answer(self) -> str:
        """Return the text of the answer."""
        axes = (f"{n};{_to_wire(n, v):.2f};" for n, v in zip(self.names, self.values, strict=True))
        flags = _NO_FLAGS if self.flags is None else f"{self.flags[0]},{self.flags[1]}"
        limits = f"{self.plus_limit:02X}{self.minus_limit:02X}0000"
        return f"{''.join(axes)};{flags};{self.override};{self.speed_mm_s:.2f};{limits}"


def read_axes(answer: str) -> Reading:
    """Return the reading; raises ``WireError``."""
    axes, mark, rest = answer.partition(";;")
    parts, tail = axes.split(";"), rest.split(";")
    if not mark or len(parts) % 2 or len(tail) != 4:
        raise WireError("fields", "r3 position")
    names = tuple(parts[::2])
    if not all(map(_NAME.fullmatch, names)) or len(set(names)) != len(names):
        raise WireError("name", "r3 position")
    values = tuple(
        _from_wire(name, number(text)) for name, text in zip(names, parts[1::2], strict=True)
    )
    limits = re.fullmatch(r"([0-9A-F]{2})([0-9A-F]{2})[0-9A-F]{4}", tail[3])
    if limits is None:
        raise WireError("limits", "r3 position")
    plus, minus = int(limits[1], 16), int(limits[2], 16)
    return Reading(names, values, _flags(tail[0]), whole(tail[1]), number(tail[2]), plus, minus)


@dataclass(frozen=True, slots=True)
class Position:
    """A position variable as it stands: six numbers (mm and deg, or N and N·m) and two flags."""

    name: str
    numbers: tuple[float, ...]
    flags: tuple[int, int]

    def pose(self) -> Pose:
        """Return it as a place: mm and rad."""
        axes = (*self.numbers[:3], *map(math.radians, self.numbers[3:]), 0.0, 0.0)
        return Pose(axes, *self.flags)

    def wrench(self) -> Wrench:
        """Return it as a force variable such as ``P_FsCurD``: N and N·m."""
        return wrench_of(self.numbers)

    def answer(self) -> str:
        """Return the printed form."""
        inner = ",".join(f"{value:+.2f}" for value in self.numbers)
        return f"{self.name}=({inner})({self.flags[0]},{self.flags[1]})"


@dataclass(frozen=True, slots=True)
class Number:
    """A number variable."""

    name: str
    value: float

    def answer(self) -> str:
        """Return the printed form."""
        whole_number = math.isfinite(self.value) and self.value == int(self.value)
        return (
            f"{self.name}={self.value:+.0f}" if whole_number else f"{self.name}={self.value:+.6f}"
        )


def read_variable(answer: str) -> Position | Number:
    """Return the variable of an answer to VAL; raises ``WireError``."""
    found = _VARIABLE.fullmatch(answer)
    if found is None:
        raise WireError("fields", "r3 variable")
    place = _POSITION.fullmatch(found[2])
    if place is None:
        return Number(found[1], number(found[2]))
    numbers = tuple(map(number, place[1].split(",")))
    if len(numbers) != 6:
        raise WireError("fields", "r3 variable", len(found[1]) + 1)
    return Position(found[1], numbers, (int(place[2]), int(place[3])))


def number(text: str) -> float:
    """Return a decimal number without exponent; raises ``WireError``."""
    if _NUMBER.fullmatch(text) is None:
        raise WireError("number", "r3 answer")
    return float(text)


def whole(text: str) -> int:
    """Return a whole number, not negative; raises ``WireError``."""
    if re.fullmatch(r"[0-9]{1,10}", text) is None:
        raise WireError("number", "r3 answer")
    return int(text)


def _flags(text: str) -> tuple[int, int] | None:
    if text == _NO_FLAGS:
        return None
    first, _, second = text.partition(",")
    return whole(first), whole(second)


def _from_wire(name: str, value: float) -> float:
    return math.radians(value) if _ANGLES.fullmatch(name) else value


def _to_wire(name: str, value: float) -> float:
    return math.degrees(value) if _ANGLES.fullmatch(name) else value
