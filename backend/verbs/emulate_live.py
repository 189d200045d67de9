"""Faults by keyboard while an emulated device serves: ``[device] kind [seconds]``, or ``clear``.

A sensor that slows down needs its rate, ``slow=300 5`` for 300 samples a second, and one that
drifts its drift, ``drift=0.05 60`` for 0.05 N a second.
"""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Sequence
from typing import TextIO

from pydantic import ValidationError

from backend.config.load import reason
from backend.emulators.faults import AMOUNTS
from backend.emulators.front import Front

CLEAR = "clear"
CHUNK = 4096
USAGE = (
    "Type a fault and Enter: [device] kind [seconds], slow=Hz, drift=N/s; 'clear' ends all faults."
)


class TypedFaults:
    """Lines of ``source`` as they are typed; a source that cannot be waited on gives none."""

    def __init__(self, fronts: Sequence[Front], source: TextIO | None = None) -> None:
        self._fronts, self._typed = fronts, b""
        self._source: TextIO | None = sys.stdin if source is None else source
        try:
            usable = self._source is not None and self._source.fileno() >= 0
        except (OSError, ValueError):
            usable = False
        if not usable or sys.platform == "win32":
            self._source = None

    @property
    def listens(self) -> bool:
        """Whether anything can still be typed."""
        return self._source is not None

    def take(self, limit_s: float) -> str:
        """Wait for a line, ``limit_s`` at most; return what it did, or why it did nothing."""
        # Lines that came at once wait here: in a buffer of the source no select would see them.
        if b"\n" not in self._typed and self._source is not None:
            if not select.select([self._source], [], [], limit_s)[0]:
                return ""
            data = os.read(self._source.fileno(), CHUNK)
            self._typed += data
            if not data:
                self._source = None  # its end: nobody types any more
        line, ended, rest = self._typed.partition(b"\n")
        if not ended and self._source is not None:
            return ""
        self._typed = rest
        return self.obey(line.decode(errors="replace"))

    def obey(self, line: str) -> str:
        """Do what a line says; return a sentence."""
        words = line.split()
        if not words:
            return ""
        if words == [CLEAR]:
            for front in self._fronts:
                front.faults.clear()
            return "All faults have ended."
        named = {front.faults.device: front for front in self._fronts if front.faults.device}
        device = words[0] if words[0] in named and len(words) > 1 else ""
        struck = named.get(device, self._fronts[0])
        kind, *rest = words[1:] if device else words
        try:
            for_s = float(rest[0]) if rest else None
            kind, _, much = kind.partition("=")
            name, _ = AMOUNTS.get(kind, ("hz", ""))
            struck.inject(kind, for_s, **({name: float(much)} if much else {}))
        except ValidationError as error:
            return f"'{line.strip()}' is no fault: {reason(error)}. {USAGE}"
        except ValueError:
            return f"'{line.strip()}' is no fault of {', '.join(named)}. {USAGE}"
        until = "until 'clear'" if for_s is None else f"for {for_s:g} s"
        return f"{struck.faults.device}: {kind} {until}."
