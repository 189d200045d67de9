"""Crashes at every durable step and at random: acknowledged data survive, files stay whole."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[3]

pytestmark = pytest.mark.skipif(not hasattr(sys, "getdlopenflags"), reason="needs fork and SIGKILL")


def trials(*words: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "tests.backend.annotations.crash_trials", *words]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


@pytest.mark.promise("D1", "D3", "W13")
@pytest.mark.slow
def test_death_at_every_step(place):
    answer = trials("steps", str(place / "data"))
    assert answer["wrong"] == []
    assert answer["deaths"] == len(answer["steps"]) > 40
    wanted = {"__init__", "add_chunk", "fsync", "check_counts", "replace", "COMMIT"}
    assert {name.split()[1] for name in answer["steps"]} >= wanted


@pytest.mark.promise("D1", "D3", "W13")
def test_death_at_random(place):
    answer = trials("random", str(place / "data"), "10")
    assert answer["wrong"] == []
    assert answer["deaths"] == 10
    assert answer["episodes"] > 10
    assert answer["labels"] > 0
