"""Figures of the window at full load, and of the decisions beside it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.bench.registry import Figure, figure

START_S = 160
"""Longest time from the command to the first measured second."""
LOAD_S, DECISIONS_S = 20.0, 660.0
"""A probe takes 6.4 s on the bench, so that 660 s hold 100 decisions."""

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
        Figure(f"{name} p50", p50, "ms", "stated", None, note),
        Figure(f"{name} p99", p99, "ms", "<= 10", p99 <= 10, note),
        Figure(f"{name} max", worst, "ms", "stated", None, note),
    ]


def _measured(seconds: float) -> dict[str, float] | str:
    """Return what the window measured of itself in ``seconds``, or why it did not."""
    command = [sys.executable, "-m", "app", "--measure", "--after", f"{seconds:g}"]
    try:
        done = subprocess.run(
            [*command, "--size", "1600x940"],
            check=False,
            capture_output=True,
            text=True,
            timeout=START_S + seconds,
            cwd=Path(__file__).resolve().parents[2],
        )
    except subprocess.TimeoutExpired:
        return "it never began to measure"
    try:
        figures: dict[str, float] = json.loads(done.stdout.strip().splitlines()[-1])
    except (ValueError, IndexError):
        return (done.stderr.strip().splitlines() or ["no answer"])[-1]
    return figures
