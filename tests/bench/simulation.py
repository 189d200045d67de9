"""Figures of mass simulation."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.bench.registry import Figure, figure


@figure("simulation")
def six_thousand_episodes() -> list[Figure]:
    """Time for 6,000 episodes of the Pot on two processes, without images."""
    with tempfile.TemporaryDirectory() as folder:
        words = "simulate --piece pot --bottoms circle15,circle25,square15 --episodes 2000 --seed 1"
        done = subprocess.run(
            [sys.executable, "-m", "backend", *words.split(), "--out", folder, "--json"],
            check=True,
            capture_output=True,
            text=True,
            cwd=Path(__file__).resolve().parents[2],
        )
    answer = json.loads(done.stdout)
    ok = answer["seconds"] <= 60 and answer["episodes"] == 6000
    return [Figure("6,000 episodes of the pot", answer["seconds"], "s", "<= 60 (goal 20)", ok)]
