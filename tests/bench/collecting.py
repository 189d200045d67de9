"""How fast the simulated bench collects, pictures and durable files included."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from tests.bench.registry import Figure, figure
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import CollectRequest

PROBES = 30


@figure("store")
def collecting() -> list[Figure]:
    """Probes per second of a headless campaign, and bench seconds per probe."""
    with tempfile.TemporaryDirectory() as folder, Dataset.open(Path(folder) / "ds") as dataset:
        session = simulated_session(keep=RecordingOptions(None))
        session.dataset = dataset
        start_s = time.perf_counter()
        session.run(CollectRequest(count=PROBES, person="bench", grips_per_mounting=10))
        took_s = time.perf_counter() - start_s
        bench_s = session.clock_s()
        session.close()
    rate = PROBES / took_s
    return [
        Figure("headless collecting", rate, "probes/s", ">= 0.2 (a real bench)", rate >= 0.2),
        Figure("bench time per probe", bench_s / PROBES, "s", "", True),
    ]
