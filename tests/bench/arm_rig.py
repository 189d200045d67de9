"""Figures of the rig process: STOP through it, and what is left when one side is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import psutil

from tests.backend.devices.emulated_arm import settings as melfa_settings
from tests.backend.devices.waiting import until
from tests.backend.rig.inline import InlineBench
from tests.backend.rig.served import Backend, Served
from tests.bench.registry import Figure, figure
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.bench.session import Session
from touchdown.backend.core.events import Event, TrialFinished
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import StackRequest

STOPS, KILLS, OWN_CYCLES = 100, 10, 285
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
    """The rig is killed, or crashes, while the arm moves: when it is told, who stops the arm."""
    took_ms, moved, again = [], 0, 0
    with served() as bench:
        backend = Backend(bench.settings)
        # The controller ends a stream by itself; the tests give it longer than any stall.
        controller, stream = bench.arm._device.controller, bench.arm._device.stream
        patient, strict = stream._settings, melfa_settings(mxt={"mxttout": OWN_CYCLES})
        try:
            for kill in range(KILLS):
                backend.moving()
                number, stream._settings = backend.link.hello["pid"], strict
                killed_s = time.monotonic()
                os.kill(number, (signal.SIGKILL, signal.SIGSEGV)[kill % 2])
                until(lambda: backend.interlock.latched)
                took_ms.append(1e3 * (time.monotonic() - killed_s))
                until(lambda: not controller.servo or not controller.program)
                height_mm = controller.joints.true_rad.copy()
                threading.Event().wait(0.05)
                moved += bool(np.abs(controller.joints.true_rad - height_mm).max() > 1e-6)
                again += backend.link.hello["pid"] != number
                stream._settings = patient
                backend.disconnect()
                backend.interlock.reset()
                controller.reset_error()
        finally:
            backend.close()
    worst = max(took_ms)
    told = f"{KILLS} times, killed and crashed by turns; median {np.median(took_ms):.0f} ms"
    still = "stopped by the controller itself; no rig began by itself"
    return [
        Figure("rig killed: CONTROL-LOST, worst", worst, "ms", "<= 500", worst <= 500, told),
        Figure("arms that moved on, or rigs begun again, after that", moved + again, "", "0",
               moved + again == 0, still),
    ]  # fmt: skip


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

    def hear(fact: Event) -> None:
        if isinstance(fact, TrialFinished):
            ends.append(fact.outcome.value)

    leave = session.events.subscribe(hear)
    session.run(StackRequest("pot", ("short",), seed))
    leave()
    return ends[0]


@figure("arm")
def trials_through_the_rig() -> list[Figure]:
    """Whole trials through the rig on a hand-wound clock, beside the simulated bench.

    By the compliance over the stream, and by the force program of the controller.
    """
    simulated = simulated_session(keep=RecordingOptions(None))
    try:
        usual = [outcome(simulated, seed) for seed in SEEDS]
    finally:
        simulated.close()
    return [figure for mode in ("software", "controller") for figure in _through(mode, usual)]


def _through(mode: str, usual: Sequence[str]) -> list[Figure]:
    bench = InlineBench(mode=mode)
    try:
        ended = [outcome(bench.session, seed) for seed in SEEDS]
    finally:
        bench.close()
    alike = sum(one == other for one, other in zip(ended, usual, strict=True))
    refused = [text for link in bench.links for text in link.refused]
    return [
        Figure(
            f"trials with {mode} stiffness that end as on the simulated bench",
            f"{alike} of {len(SEEDS)}", "", ">= 90 %", alike >= 0.9 * len(SEEDS), ", ".join(ended),
        ),
        Figure(
            f"orders of the plans, {mode} stiffness, that the rig refused", len(refused), "", "0",
            not refused, "; ".join(refused[:2]),
        ),
    ]  # fmt: skip
