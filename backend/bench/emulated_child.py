"""Process of an emulated bench: scenes as lines of JSON on its standard input, or a measurement
of its delays.

A separate process, so that the 3.5 ms stream of the arm shares no interpreter with drivers and
plans. It ends at the end of its input.
"""

from __future__ import annotations

import json
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from touchdown.backend import core
from touchdown.backend.bench.assembly import make_scene
from touchdown.backend.bench.emulated_scene import (
    EMULATOR_PRIORITY,
    GONE,
    WORK_S,
    TruthServer,
    longest_delay_s,
    serve_bench,
    shorten_switch_interval,
)
from touchdown.backend.config import SimulationSettings
from touchdown.backend.emulation import FaultPlan, TcpServer
from touchdown.backend.geometry import load_pieces
from touchdown.backend.runs import SceneChoice

END_S = 1.5
LOOK_S = 0.05
# Limits of a rest and of the whole time to set a scene; both are far longer than needed
REST_S, SET_S = 10.0, 60.0


class EmulatedProcess:
    """Starts the process with the first scene; ``close`` ends it.

    ``tell`` is called on a watch thread when the process dies or stalls.
    """

    def __init__(self, tell: Callable[[core.Fault], None]) -> None:
        self._child: subprocess.Popen[str] | None = None
        self._tell = tell
        self._serving, self._over = threading.Event(), threading.Event()
        self._still = False

    def set_scene(
        self,
        choice: SceneChoice,
        settings: SimulationSettings,
        plan: FaultPlan,
        folder: Path,
        pieces: Path | None,
        cancel: threading.Event,
    ) -> tuple[str, int]:
        """Emulate a scene with the bench file in ``folder``; return the address of its ground
        truth.

        Raises ``FaultError`` if the process has died or does not respond, and after ``cancel``.
        """
        self._serving.clear()
        order = {
            "choice": asdict(choice),
            "settings": settings.model_dump(mode="json"),
            "plan": plan.model_dump(mode="json"),
            "folder": str(folder),
            "pieces": None if pieces is None else str(pieces),
        }
        host, port = self._ask(order, cancel)
        self._serving.set()
        return str(host), int(port)

    def longest_delay_s(self, seconds: float) -> float:
        """Return the longest delay of a thread of the process that works as its devices do.

        Raises ``FaultError`` if the process has died or does not respond.
        """
        self._serving.clear()
        return float(self._ask({"measure_s": seconds}, threading.Event()))

    def end_if_still(self) -> None:
        """Kill a stalled process, so that nothing waits for its devices."""
        if self._still and self._child is not None:
            self._over.set()
            self._child.kill()

    def close(self) -> None:
        """End the process."""
        self._over.set()
        child, self._child = self._child, None
        if child is None:
            return
        for pipe in filter(None, (child.stdin, child.stdout)):
            with suppress(BrokenPipeError):  # the child died with an unread order
                pipe.close()
        try:
            child.wait(END_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()

    def _ask(self, order: dict[str, Any], cancel: threading.Event) -> Any:
        child = self._running()
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            child.stdin.write(json.dumps(order) + "\n")
            child.stdin.flush()
        except BrokenPipeError as error:
            raise core.FaultError(GONE) from error
        answer = self._answer_of(child, child.stdout, cancel)
        if not answer:
            raise core.FaultError(GONE)
        return json.loads(answer)

    def _answer_of(
        self, child: subprocess.Popen[str], answers: IO[str], cancel: threading.Event
    ) -> str:
        """Return the next line of the child, "" at its end; kills a stalled or unwanted child."""
        rest, begun_s = core.ThreadStallDetector(child.pid, child.pid), time.monotonic()
        try:
            while not select.select([answers], [], [], LOOK_S)[0]:
                now_s = time.monotonic()
                late = rest.look(now_s) > REST_S or now_s - begun_s > SET_S
                if late or cancel.is_set():
                    self._over.set()  # before the end: the watch tells of no end that is meant
                    child.kill()
                    self.close()
                    raise core.FaultError(NOT_SET)
            return answers.readline()
        except ValueError as error:  # closed meanwhile
            raise core.FaultError(GONE) from error

    def _running(self) -> subprocess.Popen[str]:
        if self._child is None:
            self._child = subprocess.Popen(
                [sys.executable, "-m", __name__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                # Linux shares processor time between sessions: the program takes none of it.
                start_new_session=True,
            )
            name, self._over = "emulated bench watch", threading.Event()
            threading.Thread(
                target=self._watch, args=(self._child, self._over), name=name, daemon=True
            ).start()
        return self._child

    def _watch(self, child: subprocess.Popen[str], over: threading.Event) -> None:
        watch = core.ProcessStallDetector(child.pid)
        while not over.wait(LOOK_S):
            if child.poll() is not None:
                if not over.is_set():
                    self._tell(GONE)
                return
            # Between two scenes the child waits for input.
            still = watch.look(time.monotonic()) and self._serving.is_set()
            if still and not self._still:
                self._tell(STILL)
            self._still = still


STILL = core.Fault(
    "BENCH-STILL",
    "The process of the emulated bench is stalled.",
    "All emulated devices are silent.",
    "Wait, or start Touchdown again.",
)
NOT_SET = core.Fault(
    "SCENE-NOT-SET",
    "The process of the emulated bench does not set the scene.",
    "It was ended, and all emulated devices with it.",
    "Press Reset and start again: the next scene gets a process of its own.",
)


def serve(orders: IO[str], answers: IO[str]) -> None:
    """Emulate the scene of each line, or measure delays, until the input ends."""
    with ExitStack() as present:
        for line in orders:
            present.close()
            order = json.loads(line)
            seconds = order.get("measure_s")
            found = _set(order, present) if seconds is None else longest_delay_s(seconds, WORK_S)
            try:
                answers.write(json.dumps(found) + "\n")
                answers.flush()
            except BrokenPipeError:  # the program has ended meanwhile
                return


def _set(order: dict[str, Any], present: ExitStack) -> tuple[str, int]:
    chosen = {**order["choice"], "bottoms": tuple(order["choice"]["bottoms"])}
    pieces = None if order["pieces"] is None else Path(order["pieces"])
    settings = SimulationSettings.model_validate(order["settings"])
    scene = make_scene(load_pieces(pieces), SceneChoice(**chosen), settings)
    plan = FaultPlan.model_validate(order["plan"])
    emulated, emulation = serve_bench(scene, Path(order["folder"]), plan, terminal=False)
    truth = TcpServer(TruthServer(emulated))
    for ending in (truth.close, emulation.close, emulated.close):
        present.callback(ending)
    shorten_switch_interval()
    emulated.start()
    emulation.start()
    truth.start()
    return truth.address


if __name__ == "__main__":
    # The threads share one interpreter lock, so none may be delayed by other programs.
    with core.round_robin_priority(EMULATOR_PRIORITY) as granted:
        if not granted:
            core.request_short_slices()
        serve(sys.stdin, sys.stdout)
