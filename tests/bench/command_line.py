"""Figures of set-up and command line."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

from tests.bench.registry import Figure, figure

ROOT = Path(__file__).resolve().parents[2]


def _seconds(command: list[str]) -> float:
    start = time.perf_counter()
    subprocess.run(command, cwd=ROOT, check=False, capture_output=True)
    return time.perf_counter() - start


@figure("setup")
def second_setup() -> list[Figure]:
    """Time of ``make setup`` when nothing changed."""
    _seconds(["make", "setup"])
    value = _seconds(["make", "setup"])
    return [Figure("make setup, second time", value, "s", "< 3", ok=value < 3)]


@figure("setup")
def command_line_start() -> list[Figure]:
    """Time until the command line has answered (`--version`)."""
    value = min(_seconds([sys.executable, "-m", "backend", "--version"]) for _ in range(3))
    return [Figure("touchdown --version", value, "s", "< 1 (own)", ok=value < 1)]
