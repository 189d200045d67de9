"""Labels saved in a real window while another process holds the catalogue's lock.

As a program it is that window, beside a live simulated bench; it prints what it measured as JSON.
Labels are nudged and accepted by keys, and read again from the closed dataset.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from PySide6.QtCore import Qt, QTimer
from PySide6.QtTest import QTest

from tests.bench.children.failing_window import print_found
from tests.bench.children.window_slices import Sliced
from tests.bench.disk_faults import HELD_S, HOLD
from tests.bench.labelling import fill
from tests.bench.registry import Figure, figure
from tests.bench.workers import hooked, window
from touchdown.app.shell.cards import exit_after_timeout
from touchdown.app.start import THREAD_SWITCH_S
from touchdown.backend.annotations.dataset import Dataset

# labels entered while the lock is held; all episodes; labels before the timing
LABELS, EPISODES, WARM_UP = 4, 30, 3
ROUND_S, KEY_MS = 2.0, 15  # duration of a round after the lock is released; interval of keys
NUDGES, NUDGE_UM, PERSON = 3, 100, "Ann"
MOST_GAP_MS = 100.0
KEY = Qt.Key


@figure("faults")
def labels_while_the_catalogue_is_locked() -> list[Figure]:
    """The longest gap of the window's ticks while labels wait, and what of them was lost."""
    with tempfile.TemporaryDirectory() as name, hooked() as environment:
        own = {**environment, "TOUCHDOWN_DATA": name}
        fill(Path(name) / "dataset", EPISODES, EPISODES)
        found: dict[str, Any] = dict(window(own, module=__name__))
        if "named" in found:
            return [Figure("labels while locked", None, "", "alive", ok=False, note=f"{found}")]
        lost = lost_of(Path(name) / "dataset", found["asked"])
    locked, free = found["locked"], found["free"]
    gap_ms = max(one["gap_ms"] for one in locked.values())
    told = "; ".join(
        f"{held_s} s {one['gap_ms']:.0f} ms ({found['waited'][held_s]} waited), "
        f"not locked {free[held_s]['gap_ms']:.0f} ms" for held_s, one in locked.items()
    )  # fmt: skip
    asked = len(found["asked"])
    return [
        Figure("catalogue locked: longest gap of the window's ticks", gap_ms, "ms",
               f"< {MOST_GAP_MS:g}", gap_ms < MOST_GAP_MS, told),
        Figure("catalogue locked: labels of the Label page lost", len(lost), f"of {asked}", "0",
               not lost and asked == WARM_UP + 2 * LABELS * len(HELD_S), ", ".join(lost)),
    ]  # fmt: skip


def lost_of(place: Path, asked: Mapping[str, tuple[int, int]]) -> list[str]:
    """Return the episodes whose accepted label differs from the entered one."""
    with Dataset.open(place, write=False) as dataset:
        heads = {uuid: dataset.labels.head(uuid) for uuid in asked}
    return [
        uuid for uuid, (x_um, y_um) in asked.items()
        if heads[uuid].state != "submitted"
        or (heads[uuid].label.x_um, heads[uuid].label.y_um) != (x_um, y_um)
    ]  # fmt: skip


class Labelling:
    """The Label page with an emulated operator; ``asked``: entered positions (µm)."""

    def __init__(self, window: Sliced) -> None:
        self._window, main = window, window.main
        both: Any = main.workspaces["collect"]
        both.page.bring("label")
        both.label.recall({"person": PERSON, "sigma_mm": 0.2})
        main.go("collect")
        main.window.activateWindow()
        self.label, self.asked = both.label, dict[str, tuple[int, int]]()
        self.waited, self._keys = 0, list[Qt.Key]()
        self._typing = QTimer(main.window)
        self._typing.timeout.connect(self._type)
        self._typing.start(KEY_MS)
        window.pump(lambda: both.label.presenter is not None)
        self._p = both.label.presenter
        window.pump(lambda: self._p.present is not None and self.quiet)

    @property
    def path(self) -> Path:
        """File of the catalogue."""
        return Path(self._p.dataset.database.path)

    @property
    def quiet(self) -> bool:
        """Return True if all entered labels are saved."""
        waits = self._keys or self._p.saving.busy or self._p.editing.waits
        return not waits and not self._p.saving.waiting

    def accept(self, labels: int) -> None:
        """Nudge and accept labels by keys, one key every ``KEY_MS``."""
        walk = self._p.walk
        for uuid in walk.order[walk.at : walk.at + labels]:
            label = self._p.book.head(uuid).label
            self.asked[uuid] = (label.x_um + NUDGES * NUDGE_UM, label.y_um)
        self._keys = [*[KEY.Key_Right] * NUDGES, KEY.Key_Return] * labels

    def _type(self) -> None:
        if self._keys:
            QTest.keyClick(self._window.main.window.windowHandle(), self._keys.pop(0))
        self.waited = max(self.waited, self._p.saving.waiting)


def measured(window: Sliced) -> dict[str, object]:
    """Accept labels while the lock is held, and while it is not."""
    at = Labelling(window)
    at.accept(WARM_UP)
    window.pump(lambda: at.quiet)
    locked, free, waited = dict[str, object](), dict[str, object](), dict[str, int]()
    for held_s in HELD_S:
        at.accept(LABELS)
        free[f"{held_s:g}"] = asdict(window.slice_of(held_s + ROUND_S))
        window.pump(lambda: at.quiet)
        holding = [sys.executable, "-c", HOLD, str(at.path), str(held_s)]
        with subprocess.Popen(holding, stdout=subprocess.PIPE, text=True) as other:
            assert other.stdout is not None
            other.stdout.readline()
            at.waited = 0
            at.accept(LABELS)
            locked[f"{held_s:g}"] = asdict(window.slice_of(held_s + ROUND_S))
        window.pump(lambda: at.quiet)
        waited[f"{held_s:g}"] = at.waited
    return {"locked": locked, "free": free, "waited": waited, "asked": at.asked}


def main() -> int:
    """Print what was measured."""
    sys.setswitchinterval(THREAD_SWITCH_S)
    with tempfile.TemporaryDirectory() as name:
        window = Sliced(Path(name))
        found = measured(window)
        window.close()
        print_found(found)
    exit_after_timeout()
    return 0


if __name__ == "__main__":
    sys.exit(main())
