"""A camera whose read blocks for 10 s while a real window is open on its bench. Wall time.

As a program with a lab file it is that window; it prints what it measured as JSON and quits while a
second read is blocked.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping
from pathlib import Path

from PySide6.QtCore import Qt, QTimer

from tests.bench.children.failing_window import print_found
from tests.bench.children.lab_window import LabWindow
from tests.bench.children.watched_arm import watched_arm
from tests.bench.registry import Figure, figure
from tests.bench.workers import GONE_S, hooked
from touchdown.app.shell.cards import exit_after_timeout
from touchdown.app.start import THREAD_SWITCH_S
from touchdown.backend.core.values import ImageArray
from touchdown.backend.devices.cameras.sources import PictureSource
from touchdown.backend.devices.gelsight.driver import TactileCamera

BLOCKED_S, TICK_MS = 10.0, 10
MOST_MS, LIMIT_S = 100.0, 240.0
CAMERA = "tactile_left"


class Blocking:
    """A source that stands in for another one; its next read blocks once it is told to."""

    def __init__(self, source: PictureSource, told: threading.Event) -> None:
        self._source, self._told = source, told
        self.lost = 0

    @property
    def facts(self) -> Mapping[str, float]:
        """What the real one answers."""
        return self._source.facts

    def read(self, limit_s: float) -> bytes | ImageArray | None:
        """Return the next picture, or block."""
        if self._told.is_set():
            self._told.clear()
            threading.Event().wait(BLOCKED_S)
        return self._source.read(limit_s)

    def close(self) -> None:
        """Close the real one."""
        self._source.close()


class Ticks:
    """When the window's thread was served: the longest gap between two ticks of 10 ms."""

    def __init__(self, window: LabWindow) -> None:
        self._window, self._last_s, self._longest_s = window, 0.0, 0.0
        self._timer = QTimer(window.main.window)
        self._timer.setTimerType(Qt.TimerType.PreciseTimer)
        self._timer.timeout.connect(self._tick)
        self._timer.start(TICK_MS)

    def longest_ms(self, for_s: float) -> float:
        """Live for so long; return the longest gap in that time."""
        self._last_s, self._longest_s = time.monotonic(), 0.0
        self._window.linger(for_s)
        self._tick()
        return 1e3 * self._longest_s

    def _tick(self) -> None:
        now_s = time.monotonic()
        self._longest_s = max(self._longest_s, now_s - self._last_s)
        self._last_s = now_s


@figure("faults")
def camera_that_blocks_beside_a_window() -> list[Figure]:
    """The longest gap of the window's ticks, and quitting while a read is blocked."""
    with watched_arm() as arm, hooked() as environment:
        child = subprocess.Popen(
            [sys.executable, "-m", __name__, str(arm.lab)],
            env=environment, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert child.stdout is not None
        said = child.stdout.readline()
        try:
            child.wait(LIMIT_S)
        except subprocess.TimeoutExpired:
            child.kill()
        gone_s = time.monotonic()
        child.communicate()
    found = json.loads(said)
    gap_ms, closed_s = found["blocked_ms"], gone_s - found["asked_s"]
    told = f"a read of 10 s; {found['usual_ms']:.0f} ms in 10 s before; cards {found['cards']}"
    return [
        Figure("longest gap of the window's ticks, camera blocked", gap_ms, "ms", "< 100",
               gap_ms < MOST_MS, told),
        Figure("window gone after quitting, camera blocked", closed_s, "s", "<= 3",
               closed_s <= GONE_S, f"exit status {child.returncode}"),
    ]  # fmt: skip


def main(lab: Path) -> int:
    """Measure, then quit."""
    sys.setswitchinterval(THREAD_SWITCH_S)
    block = threading.Event()
    with tempfile.TemporaryDirectory() as name:
        window = LabWindow(Path(name), lab)
        connection = window.session.connection
        assert connection is not None
        camera = connection.devices[CAMERA]
        assert isinstance(camera, TactileCamera)
        real = camera._open_camera
        camera._open_camera = lambda path, settings: Blocking(real(path, settings), block)
        window.ready()
        ticks = Ticks(window)
        window.linger(2.0)
        found: dict[str, object] = {"usual_ms": ticks.longest_ms(BLOCKED_S)}
        block.set()
        found |= {"blocked_ms": ticks.longest_ms(BLOCKED_S), "cards": window.main.cards.codes}
        window.ready()
        block.set()
        window.linger(1.0)
        assert not block.is_set(), "no read is blocked"
        print_found(found | {"asked_s": time.monotonic()})
        window.close()
    exit_after_timeout()
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
