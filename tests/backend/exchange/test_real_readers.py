"""Exports read by the packages of other projects; ``make exchange-check`` installs them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
READERS = Path(os.environ.get("READERS") or ROOT / ".venv-readers") / "bin" / "python"
CHECKS = ROOT / ".ci" / "exchange_check"

pytestmark = [
    pytest.mark.optional,
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(not READERS.exists(), reason="no readers: 'make exchange-check' has them"),
]


def test_real_readers_find_every_number(dataset, hand, tmp_path):
    for kind in ("robomimic", "zarr", "replay-buffer", "coco", "ros2"):
        hand(kind, f"exports/{kind}")
    hand("lerobot", "exports/lerobot", video="sample")
    dataset.close()
    truth = tmp_path / "truth.npz"
    environment = {**os.environ, "HF_HOME": str(tmp_path / "hf"), "PYTHONPATH": str(ROOT)}
    subprocess.run(
        [sys.executable, CHECKS / "truth.py", tmp_path / "data", truth], check=True, env=environment
    )
    found = subprocess.run(
        [READERS, CHECKS / "readers.py", tmp_path / "exports", truth],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert found.returncode == 0, found.stdout + found.stderr[-3000:]
    assert found.stdout.count(" ok ") == 8
