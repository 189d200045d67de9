"""The truth of an emulated scene over a wire of its own: for scoring, never for a driver.

Beside it, what the emulated devices have seen of their driver.
"""

from __future__ import annotations

import json
import socket
from dataclasses import asdict
from typing import Any

from backend.emulators.joined import JoinedScene
from backend.emulators.witness import Witnessed
from backend.simulation.scene import Scene
from backend.simulation.scoring import Truth

ANSWER_S = 2.0
LONGEST = 4096
TRUTH, SEEN = b"?\n", b"seen\n"


class EmulatedTruth:
    """Answers every line with one line of JSON: the truth, or what the devices have seen."""

    def __init__(self, joined: JoinedScene) -> None:
        self._joined = joined

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Return one line per line."""
        told = b""
        for line in data.splitlines(keepends=True):
            if line == SEEN:
                told += json.dumps(asdict(self._joined.witnessed())).encode() + b"\n"
            elif line.endswith(b"\n"):
                told += _line(self._joined.truth())
        return told

    def due(self, now_s: float) -> bytes:
        """Nothing."""
        return b""

    def closed(self, now_s: float) -> None:
        """Nothing."""


class RemoteTruth:
    """The truth of ``scene``, which another process emulates at ``address``."""

    def __init__(self, scene: Scene, address: tuple[str, int]) -> None:
        self._scene, self._address = scene, address

    @property
    def scene(self) -> Scene:
        """What was set up."""
        return self._scene

    def truth(self, *, animate: bool = False) -> Truth:
        """Ask how things really are; raises ``OSError``."""
        told = self._ask(TRUTH)
        x, y = told.pop("offset_mm")
        return Truth(offset_mm=(x, y), fall=None, **told)

    def witnessed(self) -> Witnessed:
        """Ask what the devices have seen of their driver; raises ``OSError``."""
        return Witnessed(**self._ask(SEEN))

    def _ask(self, question: bytes) -> dict[str, Any]:
        with socket.create_connection(self._address, timeout=ANSWER_S) as line:
            line.sendall(question)
            heard = b""
            while not heard.endswith(b"\n") and len(heard) < LONGEST:
                more = line.recv(LONGEST)
                if not more:
                    raise ConnectionResetError("the emulated bench is gone")
                heard += more
        answer: dict[str, Any] = json.loads(heard)
        return answer


def _line(truth: Truth) -> bytes:
    told = {
        "offset_mm": list(truth.offset_mm),
        "yaw_rad": truth.yaw_rad,
        "margin_mm": truth.margin_mm,
        "stands": truth.stands,
        "slip_mm": truth.slip_mm,
        "knocked_over": truth.knocked_over,
    }
    return json.dumps(told).encode() + b"\n"
