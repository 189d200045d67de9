"""Figures of the window: full load, beside decisions, start-up, half an hour."""

import json
import subprocess
import sys
from pathlib import Path

from tests.bench.figures import Figure, at_least, at_most, failures, figure, stated

START_S = 160  # longest time from the command to the first measured second
SOAK_S = 3600  # longest time for 30 simulated minutes
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


@figure("window")
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


@figure("window-soak")
def window_for_half_an_hour() -> list[Figure]:
    """Let the window show 30 simulated minutes of stacking, all pages in turn."""
    answer = _child("soak", SOAK_S)
    name = "memory of the window, slope over 30 simulated minutes"
    if isinstance(answer, str):
        return [Figure(name, None, "MB/min", "<= 1", False, answer)]
    slope, left = answer["slope_mb_per_min"], answer["threads_left"] + answer["timers_left"]
    note = f"{answer['memory_mb']:.0f} MB at the end, {answer['wall_s']:.0f} s"
    left_fps, right_fps = answer["tactile_left_fps"], answer["tactile_right_fps"]
    return [
        at_most(name, slope, "MB/min", 1, note),
        failures("threads and timers left after the window", left),
        at_least("tactile left, of each simulated second", left_fps, "fps", 24),
        at_least("tactile right, of each simulated second", right_fps, "fps", 24),
        # A stepped bench sends samples 50 times a second, each view has every other turn.
        stated("traces, of each simulated second", answer["traces_fps"], "fps"),
    ]


@figure("window")
def window_start() -> list[Figure]:
    """Start the window twice in one process."""
    answer = _child("start", START_S)
    if isinstance(answer, str):
        return [Figure("window, start to live pictures", None, "s", "<= 3", False, answer)]
    warm_s, cold_s = answer["warm_s"], answer["cold_s"]
    return [
        at_most("window, start to live pictures, imports warm", warm_s, "s", 3),
        stated("window, start to live pictures, from the command", cold_s, "s"),
    ]


def _child(what: str, most_s: float) -> dict[str, float] | str:
    return _answer([sys.executable, "-m", "tests.bench.children.window", what], most_s)


def _measured(seconds: float) -> dict[str, float] | str:
    command = [sys.executable, "-m", "touchdown.app", "--measure", "--after", f"{seconds:g}"]
    return _answer([*command, "--size", "1600x940"], START_S + seconds)


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
