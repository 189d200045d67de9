"""Figures of the rig process: STOP through it, and what is left when one side is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import psutil

from backend.assembly import simulated_session
from backend.core.facts import Fact, TrialFinished
from backend.runs.requests import StackRequest
from backend.session import Keep, Session
from tests.backend.devices.waiting import until
from tests.backend.rig.inline import InlineBench
from tests.backend.rig.served import Backend, Served
from tests.bench.registry import Figure, figure

STOPS, KILLS = 100, 10
SEEDS = range(7, 13)


@contextmanager
def served() -> Iterator[Served]:
    """Serve emulated devices until the block ends."""
    made = Served()
    try:
        yield made
    finally:
        made.close()


@figure("arm")
def stop_through_the_rig() -> list[Figure]:
    """Time from the backend's STOP to its arrival at the emulated controller, while the arm moves.

    Also the answer to an order that moves nothing: there and back through the pipe.
    """
    took_ms, asked_ms = [], []
    with served() as bench:
        backend = Backend(bench.settings)
        try:
            while len(took_ms) < STOPS:
                backend.moving()
                before, asked_s = len(bench.arm.stops), time.monotonic()
                backend.arm.stop()
                until(lambda: len(bench.arm.stops) > before)  # noqa: B023 - called at once
                took_ms.append(1e3 * (bench.arm.stops[before] - asked_s))
                asked_s = time.monotonic()
                backend.arm.place_of((0.0, 0.2, 2.0, 0.0, 0.9, 0.0))
                asked_ms.append(1e3 * (time.monotonic() - asked_s))
                threading.Event().wait(0.15)
        finally:
            backend.close()
    p99 = float(np.percentile(took_ms, 99))
    told = f"{STOPS} stops; median {np.median(took_ms):.2f}, worst {max(took_ms):.1f} ms"
    asked = float(np.median(asked_ms))
    return [
        Figure("STOP through the rig to the controller, p99", p99, "ms", "<= 20", p99 <= 20, told),
        Figure("an order to the rig and its answer, median", asked, "ms", "stated", None),
    ]


@figure("arm")
def killed_rig() -> list[Figure]:
    """Time from kill -9 of the rig, while the arm moves, to the fault that is latched."""
    took_ms = []
    with served() as bench:
        backend = Backend(bench.settings)
        try:
            for _ in range(KILLS):
                backend.moving()
                killed_s = time.monotonic()
                os.kill(backend.link.hello["pid"], signal.SIGKILL)
                until(lambda: backend.interlock.latched)
                took_ms.append(1e3 * (time.monotonic() - killed_s))
                backend.disconnect()
                backend.interlock.reset()
        finally:
            backend.close()
    worst = max(took_ms)
    told = f"{KILLS} kills; median {np.median(took_ms):.0f} ms"
    return [Figure("rig killed: CONTROL-LOST, worst", worst, "ms", "<= 500", worst <= 500, told)]


@figure("arm")
def killed_backend() -> list[Figure]:
    """Time from kill -9 of the backend to the end of motion at the controller; what is left."""
    took_ms, left = [], 0
    with served() as bench:
        command = [sys.executable, "-m", "tests.backend.rig.served"]
        for _ in range(KILLS):
            settings = bench.settings.model_dump_json()
            with subprocess.Popen([*command, settings], stdout=subprocess.PIPE, text=True) as child:
                assert child.stdout is not None
                rig = psutil.Process(int(child.stdout.readline()))
                before, killed_s = len(bench.arm.stops), time.monotonic()
                child.kill()
            until(lambda: len(bench.arm.stops) > before)  # noqa: B023 - called at once
            took_ms.append(1e3 * (bench.arm.stops[before] - killed_s))
            _, alive = psutil.wait_procs([rig], timeout=10.0)
            left += len(alive)
    worst = max(took_ms)
    told = f"{KILLS} kills; median {np.median(took_ms):.0f} ms"
    return [
        Figure("backend killed: STOP by the rig, worst", worst, "ms", "<= 100", worst <= 100, told),
        Figure("processes left after that", left, "", "0", left == 0),
    ]


def outcome(session: Session, seed: int) -> str:
    """Return how a trial on ``seed`` ends."""
    ends: list[str] = []

    def hear(fact: Fact) -> None:
        if isinstance(fact, TrialFinished):
            ends.append(fact.outcome.value)

    leave = session.hub.subscribe(hear)
    session.run(StackRequest("pot", ("short",), seed))
    leave()
    return ends[0]


@figure("arm")
def trials_through_the_rig() -> list[Figure]:
    """Whole trials through the rig on a hand-wound clock, beside the simulated bench."""
    bench, simulated = InlineBench(), simulated_session(keep=Keep(None))
    try:
        pairs = [(outcome(bench.session, s), outcome(simulated, s)) for s in SEEDS]
    finally:
        bench.close()
        simulated.close()
    alike = sum(one == other for one, other in pairs)
    refused = [text for link in bench.links for text in link.refused]
    told = ", ".join(one for one, _ in pairs)
    return [
        Figure(
            "trials that end as on the simulated bench", f"{alike} of {len(SEEDS)}", "",
            ">= 90 %", alike >= 0.9 * len(SEEDS), told,
        ),
        Figure(
            "orders of the plans that the rig refused", len(refused), "", "0", not refused,
            "; ".join(refused[:2]),
        ),
    ]  # fmt: skip
