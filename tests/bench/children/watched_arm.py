"""Child that serves an emulated bench and answers each line with the time at which its arm came to
rest.

``python -m tests.bench.children.watched_arm FOLDER`` writes the lab file there and prints
``ready``. The controller keeps its joints of the last second; it knows nothing of leases.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from touchdown.backend.bench.assembly import SimulatedBenchChoice, make_scene
from touchdown.backend.bench.emulated_scene import (
    EMULATOR_PRIORITY,
    EmulatedScene,
    lab_toml,
    serve_bench,
    shorten_switch_interval,
)
from touchdown.backend.core.scheduling import round_robin_priority
from touchdown.backend.emulation.fault_plan import FaultPlan
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.requests import SceneChoice

BACK_S, GRID_S = 0.95, 0.001
STANDS_MM = 0.05
LAB = "lab.toml"
SEED = 7


@dataclass(frozen=True, slots=True)
class Rest:
    """``rested_s`` (monotonic): from then on it is within 0.05 mm of where it is now.

    ``way_mm``: how far it went in the second before now.
    """

    rested_s: float
    way_mm: float


def rest_of(joined: EmulatedScene) -> Rest:
    """Look back over the last second of the emulated arm."""
    now_s, pivot_mm = time.monotonic(), joined.frame.pivot_mm
    controller = joined.melfa.controller
    here_mm, rested_s, way_mm = pivot_mm(controller.joints_at(now_s)), now_s - BACK_S, 0.0
    for t_s in np.arange(now_s, now_s - BACK_S, -GRID_S):
        away_mm = float(np.linalg.norm(pivot_mm(controller.joints_at(float(t_s))) - here_mm))
        if away_mm > STANDS_MM and way_mm <= STANDS_MM:
            rested_s = float(t_s)
        way_mm = max(way_mm, away_mm)
    return Rest(rested_s, way_mm)


class LineChild:
    """The parent's end of a module that answers each line with one line; ``first`` came unasked."""

    def __init__(
        self, module: str, *words: str, environment: Mapping[str, str] | None = None
    ) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", module, *words], env=environment,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self.first = self.answer()

    def ask(self, text: str = "") -> str:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{text}\n")
        self.process.stdin.flush()
        return self.answer()

    def close(self) -> None:
        self.process.communicate("", timeout=60.0)

    def answer(self) -> str:
        """Return the next line without its end."""
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()


class WatchedArm(LineChild):
    """``lab`` is the lab file that leads to the bench."""

    def __init__(self, folder: Path) -> None:
        self.lab = folder / LAB
        super().__init__(__name__, str(folder))

    def rest(self) -> Rest:
        return Rest(**json.loads(self.ask()))


@contextmanager
def watched_arm() -> Iterator[WatchedArm]:
    with tempfile.TemporaryDirectory() as folder:
        arm = WatchedArm(Path(folder))
        try:
            yield arm
        finally:
            arm.close()


def main(folder: Path) -> None:
    settings = SimulatedBenchChoice(preset="quiet").settings()
    scene = make_scene(load_pieces(), SceneChoice("pot", ("short",), SEED), settings)
    with round_robin_priority(EMULATOR_PRIORITY):
        joined, emulation = serve_bench(scene, folder, FaultPlan())
        (folder / LAB).write_text(lab_toml(scene, emulation), "utf-8")
        shorten_switch_interval()
        joined.start()
        emulation.start()
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        try:
            for _ in sys.stdin:
                rest = rest_of(joined)
                told = {"rested_s": rest.rested_s, "way_mm": rest.way_mm}
                sys.stdout.write(json.dumps(told) + "\n")
                sys.stdout.flush()
        finally:
            emulation.close()
            joined.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
