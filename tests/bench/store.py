"""Figures of the catalogue: labels are saved at once, and 100,000 episodes are not too many."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.backend.catalogue.filling import fill, make_files
from tests.bench.registry import Figure, figure
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import EpisodeFilter, Label

EPISODES = 100_000
APPROVED = 10_000
COMMITS = 300
OPEN_S, NEXT_MS, PICK_MS, COMMIT_MS = 1.0, 20.0, 100.0, 20.0


@figure("store")
def catalogue_of_100_000() -> list[Figure]:
    """Opening, picking and committing in a large catalogue, on the disk of temporary files."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "dataset"
        with Dataset.open(folder) as dataset:
            uuids = fill(dataset, EPISODES, APPROVED, batch=1)
            make_files(dataset)
        Dataset.open(folder).close()
        begin, begin_cpu = time.perf_counter(), time.process_time()
        dataset = Dataset.open(folder)
        open_s, cpu_s = time.perf_counter() - begin, time.process_time() - begin_cpu
        with dataset:
            opening = _opening(dataset, open_s, cpu_s)
            return [opening, *_picking(dataset), *_committing(dataset, uuids)]


def _opening(dataset: Dataset, open_s: float, cpu_s: float) -> Figure:
    size = (dataset.folder / "catalog.db").stat().st_size / 1e6
    note = f"{cpu_s:.2f} s of processor; {size:.0f} MB; {len(dataset.notices)} notices"
    ok = open_s <= OPEN_S and not dataset.notices
    return Figure("catalogue of 100,000 episodes, open", open_s, "s", f"<= {OPEN_S:g}", ok, note)


def _picking(dataset: Dataset) -> list[Figure]:
    chosen = EpisodeFilter(states=("draft",), piece="pot", bottom="circle25", limit=200)
    cases: dict[str, tuple[Callable[[], object], float]] = {
        "next in queue": (lambda: dataset.queue("unlabelled", "zoe", limit=1), NEXT_MS),
        "next to review": (lambda: dataset.queue("review", "zoe", limit=1), NEXT_MS),
        "filtered pick of 200": (lambda: dataset.episodes(chosen), PICK_MS),
        "count by state": (dataset.counts, 150.0),
    }
    figures = []
    for name, (call, limit_ms) in cases.items():
        p99 = float(np.percentile(_times_ms(call, 40), 99))
        whole = f"catalogue, {name}, p99"
        figures.append(Figure(whole, p99, "ms", f"<= {limit_ms:g}", p99 <= limit_ms))
    return figures


def _committing(dataset: Dataset, uuids: list[str]) -> list[Figure]:
    waiting = iter(uuids[APPROVED:])
    times = _times_ms(
        lambda: dataset.labels.accept("zoe", next(waiting), Label(1, 2, 0, 100)), COMMITS
    )
    p50, p99 = (float(np.percentile(times, q)) for q in (50, 99))
    note = f"one fsync of this disk: p50 {_fsync_ms(dataset.folder):.1f} ms; a commit needs two"
    return [
        Figure("label commit with journal, p50", p50, "ms", f"<= {COMMIT_MS:g}", p50 <= COMMIT_MS,
               note),
        Figure("label commit with journal, p99", p99, "ms", "stated", None),
    ]  # fmt: skip


def _times_ms(call: Callable[[], object], count: int) -> list[float]:
    found = []
    for _ in range(count):
        begin = time.perf_counter()
        call()
        found.append(1e3 * (time.perf_counter() - begin))
    return found


def _fsync_ms(folder: Path) -> float:
    with (folder / "probe").open("wb") as file:

        def once() -> None:
            file.write(bytes(1000))
            file.flush()
            os.fsync(file.fileno())

        return float(np.median(_times_ms(once, 50)))
