"""A jump of the wall clock during a probe changes none of its values."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from tests.backend.brisk import brisk_bench, brisk_method
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core.events import Event, PhaseEntered, Said
from touchdown.backend.runs.event_log import read_events
from touchdown.backend.runs.recorder import CLOCK_SET, RecordingOptions
from touchdown.backend.runs.requests import CollectRequest

HOUR_NS = 3600 * 1_000_000_000


def recorded(folder: Path, monkeypatch: pytest.MonkeyPatch, back_ns: int) -> tuple[bytes, int]:
    """Collect one probe while the clock is set back; return its values and time."""
    keep = RecordingOptions(folder / "runs", episodes=False)
    session = simulated_session(brisk_bench("quiet"), keep=keep, method=brisk_method())
    clock, clock_ns = time.time, time.time_ns

    def set_back(fact: Event) -> None:
        if isinstance(fact, PhaseEntered) and fact.phase == "press":
            monkeypatch.setattr(time, "time", lambda: clock() - 1e-9 * back_ns)
            monkeypatch.setattr(time, "time_ns", lambda: clock_ns() - back_ns)

    session.events.subscribe(set_back)
    with Dataset.open(folder / "dataset", person="ann") as dataset:
        session.dataset = dataset
        session.run(CollectRequest(seed=2, person="ann", count=1))
        (entry,) = dataset.episodes()
        episode = dataset.read(entry.uuid)
    session.close()
    monkeypatch.undo()
    (run,) = (folder / "runs").iterdir()
    told = [fact.text for fact in read_events(run) if isinstance(fact, Said)]
    jumps = [text for text in told if "clock of this computer" in text]
    assert jumps == ([CLOCK_SET.format(-1e-9 * back_ns)] if back_ns else [])
    assert np.isfinite(episode.observation).all()
    return episode.observation.tobytes(), entry.recorded_ns


@pytest.mark.promise("P2")
def test_a_clock_set_back_by_an_hour_in_mid_press_changes_no_number_and_no_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain, _ = recorded(tmp_path / "plain", monkeypatch, 0)
    jumped, at_ns = recorded(tmp_path / "jumped", monkeypatch, HOUR_NS)
    assert jumped == plain
    # The time of the recording is what the wall said, and tells of the jump.
    assert time.time_ns() - at_ns > HOUR_NS // 2
