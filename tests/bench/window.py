"""Figures of the window: full load, beside decisions, start-up, pages, at rest, over a day."""

import contextlib
import json
import os
import socket
import subprocess
import sys
import sysconfig
import threading
import time
from pathlib import Path
from statistics import median
from typing import Any, BinaryIO

import psutil

from tests.bench.figures import Figure, at_least, at_most, failures, figure, stated
from touchdown.backend.bench import serve_live, simulated_bench
from touchdown.backend.core import InputError
from touchdown.backend.episodes import LIVE_TOPICS
from touchdown.backend.runs import SceneChoice, SetRequest

STARTS = 5  # fresh processes
START_S = 160  # longest time from the command to the first measured second
SOAK_S = 3600  # longest time for 45 simulated minutes
LOAD_S, DECISIONS_S = 20.0, 660.0  # 660 s hold 100 decisions; a probe takes 6.4 s on the bench

LIMITS = {
    "window_cpu_percent": ("window, share of one core", "%", "<= 30", lambda v: v <= 30),
    "tactile_left_fps": ("tactile left", "fps", ">= 24", lambda v: v >= 24),
    "tactile_right_fps": ("tactile right", "fps", ">= 24", lambda v: v >= 24),
    "traces_fps": ("traces", "fps", ">= 30", lambda v: v >= 30),
    "lag_p99_ms": ("event-loop lag p99", "ms", "<= 20", lambda v: v <= 20),
    "lag_max_ms": ("event-loop lag max", "ms", "<= 100", lambda v: v <= 100),
}


@figure("window")
def window_at_full_load() -> list[Figure]:
    """Run the window offscreen beside the live bench for 20 s."""
    answer = _measured(LOAD_S)
    if isinstance(answer, str):
        return [Figure("window at full load", None, "", "", False, answer)]
    note = f"bench at {answer['pace']:.2f} x real time"
    return [
        Figure(name, float(answer[key]), unit, target, bool(fits(answer[key])), note)
        for key, (name, unit, target, fits) in LIMITS.items()
    ]


@figure("window", long=True)
def decisions_beside_the_window() -> list[Figure]:
    """Let the live bench stack beside the window for some 100 decisions."""
    name = "decision latency beside the window"
    answer = _measured(DECISIONS_S)
    if isinstance(answer, str) or not answer["decisions"]:
        reason = answer if isinstance(answer, str) else "no decision in the time"
        return [Figure(f"{name} p99", None, "ms", "<= 10", False, reason)]
    p50, p99, worst = (answer[f"decision_{key}_ms"] for key in ("p50", "p99", "max"))
    note = f"{answer['decisions']:.0f} decisions at {answer['pace']:.2f} x real time"
    return [
        stated(f"{name} p50", p50, "ms", note),
        at_most(f"{name} p99", p99, "ms", 10, note),
        stated(f"{name} max", worst, "ms", note),
    ]


@figure("window-soak", long=True)
def window_over_a_day() -> list[Figure]:
    """Let the window show a day in 45 simulated minutes: runs, labels, sheets, pages in turn."""
    answer = _child("soak", SOAK_S)
    name = "memory of the window, slope over 45 simulated minutes"
    if isinstance(answer, str):
        return [Figure(name, None, "MB/min", "<= 0.5", False, answer)]
    slope, left = answer["slope_mb_per_min"], answer["threads_left"] + answer["timers_left"]
    note = (
        f"RSS, means of {answer['rounds']:.0f} rounds of four runs after 10 minutes, in which each "
        f"page shows each sheet: {answer['first_round_mb']:.0f} MB in the first round, "
        f"{answer['last_round_mb']:.0f} MB in the last; {answer['wall_s']:.0f} s"
    )
    names = ("trials", "probes", "labels", "sheets", "refused")
    day = ", ".join(f"{answer[key]:.0f} {key}" for key in names)
    left_fps, right_fps = answer["tactile_left_fps"], answer["tactile_right_fps"]
    return [
        at_most(name, slope, "MB/min", 0.5, note),
        stated(f"{name}, second half", answer["later_slope_mb_per_min"], "MB/min"),
        at_most("memory of the window, PSS after the 45 minutes", answer["pss_mb"], "MB", 700, day),
        failures("threads and timers left after the window", left),
        at_least("tactile left, of each simulated second", left_fps, "fps", 24),
        at_least("tactile right, of each simulated second", right_fps, "fps", 24),
        # A stepped bench sends samples 50 times a second, each view has every other turn.
        stated("traces, of each simulated second", answer["traces_fps"], "fps"),
    ]


@figure("window")
def window_start() -> list[Figure]:
    """Start the window in five fresh processes, twice in each; the files are read again."""
    answers, splashes = [], []
    for _ in range(STARTS):
        _drop_cached_files()
        splash = _answer([sys.executable, "-c", SPLASH], START_S)
        _drop_cached_files()
        answer = _child("start", START_S)
        if isinstance(answer, str) or isinstance(splash, str):
            return [Figure("window, start to live pictures", None, "s", "<= 6", False, str(answer))]
        answers.append(answer)
        splashes.append(splash["splash_s"])
    warm_s, cold_s = (median(one[key] for one in answers) for key in ("warm_s", "cold_s"))
    note = f"median of {STARTS} fresh processes"
    return [
        at_most("window, start to live pictures, imports warm", warm_s, "s", 3, note),
        at_most("window, start to live pictures, from the command", cold_s, "s", 6, note),
        at_most("window, start to the splash", median(splashes), "s", 1.5, note),
    ]


@figure("window")
def window_pages() -> list[Figure]:
    """Change pages and drag zoomed pictures beside a stepped bench."""
    answer = _child("pages", START_S)
    if isinstance(answer, str):
        return [Figure("page change, p95", None, "ms", "<= 50", False, answer)]
    return [
        at_most("page change, p95", answer["change_p95_ms"], "ms", 50),
        at_most("painting while dragging a map, p95", answer["drag_p95_ms"], "ms", 16),
    ]


@figure("window")
def window_at_rest() -> list[Figure]:
    """Show Operate without a run, then minimise; all processes of the window count."""
    answer = _child("rest", START_S)
    if isinstance(answer, str):
        return [Figure("window at rest", None, "", "", False, answer)]
    return [
        at_most("window at rest, share of one core", answer["idle_percent"], "%", 15),
        at_most("window minimised, share of one core", answer["minimised_percent"], "%", 8),
        at_most("window at rest, PSS of all processes", answer["pss_mb"], "MB", 550),
    ]


# From the command to the splash, in the order of the program.
SPLASH = """
import json, time, psutil
from touchdown.app.__main__ import parser
parser().parse_args([])
from PySide6.QtWidgets import QApplication
from touchdown.app.splash import Splash
application = QApplication([])
Splash().tell("Loading the program")
print(json.dumps({"splash_s": time.time() - psutil.Process().create_time()}))
"""


def _drop_cached_files() -> None:
    """Ask the kernel to forget the files of program and libraries, where no process maps them."""
    root = Path(__file__).resolve().parents[2]
    for folder in (root, Path(sysconfig.get_path("purelib"))):
        for path in folder.rglob("*.[ps][yo]*"):
            with contextlib.suppress(OSError), path.open("rb") as file:
                os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def _child(what: str, most_s: float, *more: str) -> dict[str, float] | str:
    return _answer([sys.executable, "-m", "tests.bench.children.window", what, *more], most_s)


def _measured(seconds: float) -> dict[str, float] | str:
    return _child("load", START_S + seconds, f"{seconds:g}")


def _answer(command: list[str], most_s: float) -> dict[str, float] | str:
    root = Path(__file__).resolve().parents[2]
    try:
        done = subprocess.run(
            command, check=False, capture_output=True, text=True, timeout=most_s, cwd=root
        )
    except subprocess.TimeoutExpired:
        return "it took too long"
    try:
        figures: dict[str, float] = json.loads(done.stdout.strip().splitlines()[-1])
    except (ValueError, IndexError):
        return (done.stderr.strip().splitlines() or ["no answer"])[-1]
    return figures


LIVE_S, LIVE_SHARE = 20.0, 10.0
HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n"
)


def read_everything(port: int, seconds: float) -> None:
    """Subscribe to all topics of a live view and print the bytes received: a process of its own."""
    with (
        socket.create_connection(("127.0.0.1", port), 10.0) as client,
        client.makefile("rb") as told,
    ):
        client.sendall(HANDSHAKE)
        while told.readline().strip():
            pass
        channels: list[int] = []
        while len(channels) < len(LIVE_TOPICS):
            channels += [channel["id"] for channel in _frame(told).get("channels", ())]
        wanted = [{"id": k, "channelId": channel} for k, channel in enumerate(channels)]
        text = json.dumps({"op": "subscribe", "subscriptions": wanted}).encode()
        # RFC 6455: a masked text frame with a length of 16 bits; the mask is zero.
        client.sendall(b"\x81\xfe" + len(text).to_bytes(2, "big") + bytes(4) + text)
        sys.stdout.write("subscribed\n")
        sys.stdout.flush()
        count, end_s = 0, time.monotonic() + seconds
        while time.monotonic() < end_s:
            count += len(client.recv(1 << 20))
    sys.stdout.write(str(count))


def _frame(told: BinaryIO) -> dict[str, Any]:
    """Return the JSON object of the next frame, an empty one for a binary frame."""
    head = told.read(2)
    length = head[1]
    if length >= 126:
        length = int.from_bytes(told.read(2 if length == 126 else 8), "big")
    content = told.read(length)
    return dict(json.loads(content)) if head[0] == 0x81 else {}


def _spent_s(process: psutil.Process, known: set[int]) -> float:
    """Return the processor time of all threads that are not ``known``."""
    times = [one.user_time + one.system_time for one in process.threads() if one.id not in known]
    return float(sum(times))


@figure("window")
def live_view_with_one_client() -> list[Figure]:
    """Processor time of the threads of the live view while one client reads all topics."""
    name, process = "live view with one client, share of one core", psutil.Process()
    with simulated_bench() as bench:
        bench.run(SetRequest(SceneChoice("pot", ("short",), 1)))
        bench.open()
        before = {thread.id for thread in process.threads()}
        try:
            port = int(serve_live(bench, "127.0.0.1:0").rstrip(".").rpartition(":")[2])
        except InputError as error:
            return [Figure(name, None, "%", f"<= {LIVE_SHARE:g}", None, f"not measured: {error}")]
        code = f"from tests.bench.window import read_everything; read_everything({port}, {LIVE_S})"
        with subprocess.Popen(
            [sys.executable, "-c", code],
            cwd=Path(__file__).parents[2],
            stdout=subprocess.PIPE,
            text=True,
        ) as client:
            assert client.stdout is not None
            assert client.stdout.readline() == "subscribed\n"
            begun_s, begun = time.monotonic(), _spent_s(process, before)
            clock_s = bench.clock_s()
            threading.Event().wait(0.6 * LIVE_S)
            took_s = time.monotonic() - begun_s
            pace = (bench.clock_s() - clock_s) / took_s
            share = 100.0 * (_spent_s(process, before) - begun) / took_s
            received = int(client.communicate()[0])
    note = f"{1e-6 * received / LIVE_S:.2g} MB/s received; bench at {pace:.2f} x real time"
    return [at_most(name, share / max(pace, 1e-3), "%", LIVE_SHARE, note)]
