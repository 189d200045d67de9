"""The day of labelling that the tests play with fewer probes, with a hundred of them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.bench.registry import Figure, figure

ROOT = Path(__file__).resolve().parents[2]
DAY = "tests/journeys/test_annotators_day.py"
PROBES = 100


@figure("day")
def a_day_of_labelling() -> list[Figure]:
    """Label by keys in the real window, kill it twice, review, correct, train and export."""
    command = [sys.executable, "-m", "pytest", DAY, "-q", "-x", "-p", "no:cacheprovider"]
    command += ["--timeout", "1800"]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "DAY_PROBES": str(PROBES)}, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    name = f"day of {PROBES} probes, killed twice: parts that did not hold"
    lines = done.stdout.strip().splitlines()
    held = done.returncode == 0
    return [Figure(name, 0.0 if held else 1.0, "", "0", held, lines[-1] if lines else "")]
