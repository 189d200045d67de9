"""The truth of an emulated scene over a wire of its own: for scoring, never for a driver."""

from __future__ import annotations

import json
import socket

from backend.emulators.joined import JoinedScene
from backend.simulation.scene import Scene
from backend.simulation.scoring import Truth

ANSWER_S = 2.0
LONGEST = 4096


class EmulatedTruth:
    """Answers every line with the truth as one line of JSON."""

    def __init__(self, joined: JoinedScene) -> None:
        self._joined = joined

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Return one line per line."""
        return _line(self._joined.truth()) * data.count(b"\n")

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
        with socket.create_connection(self._address, timeout=ANSWER_S) as line:
            line.sendall(b"?\n")
            heard = b""
            while not heard.endswith(b"\n") and len(heard) < LONGEST:
                more = line.recv(LONGEST)
                if not more:
                    raise ConnectionResetError("the emulated bench is gone")
                heard += more
        told = json.loads(heard)
        x, y = told.pop("offset_mm")
        return Truth(offset_mm=(x, y), fall=None, **told)


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
