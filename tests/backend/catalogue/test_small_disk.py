"""A small disk that is really full: clear messages, no loss, and work continues."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
SMALL = 'mount -t tmpfs -o size=48m none "$0" && exec "$@"'


@pytest.mark.promise("D2")
@pytest.mark.slow
def test_labels_and_a_campaign_outlast_a_full_disk(tmp_path: Path) -> None:
    try:
        allowed = subprocess.run(["unshare", "-Urm", "true"], check=False, capture_output=True)
    except FileNotFoundError:
        pytest.skip("only Linux has disks of one process")
    if allowed.returncode != 0:
        pytest.skip("this system gives users no disks of their own")
    child = [sys.executable, "-m", "tests.backend.catalogue.small_disk", str(tmp_path)]
    inside = ["unshare", "-Urm", "sh", "-c", SMALL, str(tmp_path), *child]
    done = subprocess.run(inside, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout.splitlines()[-1])
    labels, campaign = answer["labels"], answer["campaign"]
    assert labels["codes"] == ["DISK-FULL", "DISK-FULL"]
    assert labels["until_full"] > 0
    assert labels["episodes_when_full"] == 1
    assert (labels["lost"], labels["wrong"]) == ([], [])
    assert labels["states"] == ["complete"] * 2
    assert labels["journal"] == labels["operations"] == labels["until_full"] + 4
    assert campaign == {
        "paused": ["DISK-FULL"], "stored_when_paused": [1], "ending": ["finished"],
        "all_told": True, "ticks": [20, 20, 20], "wrong": [],
    }  # fmt: skip
