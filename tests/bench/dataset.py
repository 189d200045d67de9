"""Speed and durability of a dataset."""

import json
import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np

from tests.backend.annotations.filling import fill, make_files
from tests.bench.figures import Figure, at_least, at_most, figure, stated
from touchdown.backend.annotations import Dataset, EpisodeFilter, Label
from touchdown.backend.annotations.reconciliation import check_catalogue
from touchdown.backend.annotations.training_set import CacheRow, TrainingCache, open_cache
from touchdown.backend.episodes.mcap_container import read_chunks
from touchdown.backend.episodes.packs import MAX_EPISODES, PackedEpisode, PackWriter

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
        with Dataset.open(folder) as dataset:
            dataset.resolve("bench")  # the journal that ``fill`` did not write
        begin, begin_cpu = time.perf_counter(), time.process_time()
        dataset = Dataset.open(folder)
        open_s, cpu_s = time.perf_counter() - begin, time.process_time() - begin_cpu
        with dataset:
            opening = _opening(dataset, open_s, cpu_s)
            figures = [opening, *_picking(dataset), *_committing(dataset, uuids)]
        return [*figures, *_cold_openings(folder)]


def _opening(dataset: Dataset, open_s: float, cpu_s: float) -> Figure:
    size = (dataset.folder / "catalog.db").stat().st_size / 1e6
    note = f"{cpu_s:.2f} s of processor; {size:.0f} MB; {len(dataset.notices)} notices"
    ok = open_s <= OPEN_S and not dataset.notices
    return Figure("catalogue of 100,000 episodes, open", open_s, "s", f"<= {OPEN_S:g}", ok, note)


def _cold_openings(folder: Path) -> list[Figure]:
    """Open with neither catalogue nor journals in the page cache, after a clean close and a crash.

    Recordings are not read, and the entries of their folders stay in memory.
    """
    found = []
    for after in ("a clean close", "a crash"):
        if after == "a crash":
            with closing(sqlite3.connect(folder / "catalog.db")) as connection, connection:
                connection.execute("DELETE FROM checked_folder")
        for path in (folder / "catalog.db", *(folder / "labels").iterdir()):
            drop(path)
        begin = time.perf_counter()
        with Dataset.open(folder) as dataset:
            open_s = time.perf_counter() - begin
            begin = time.perf_counter()
            problems = len(check_catalogue(dataset.parts))
            check_s = time.perf_counter() - begin
        found.append(stated(f"catalogue of 100,000 episodes, cold open after {after}", open_s, "s"))
    note = f"{problems} problems"
    return [*found, stated("catalogue of 100,000 episodes, check by verify", check_s, "s", note)]


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
        figures.append(at_most(whole, p99, "ms", limit_ms))
    return figures


def _committing(dataset: Dataset, uuids: list[str]) -> list[Figure]:
    waiting = iter(uuids[APPROVED:])
    times = _times_ms(
        lambda: dataset.labels.accept("zoe", next(waiting), Label(1, 2, 0, 100)), COMMITS
    )
    p50, p99 = (float(np.percentile(times, q)) for q in (50, 99))
    note = f"one fsync of this disk: p50 {_fsync_ms(dataset.folder):.1f} ms; a commit needs two"
    return [
        at_most("label commit with journal, p50", p50, "ms", COMMIT_MS, note),
        stated("label commit with journal, p99", p99, "ms"),
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


ROOT = Path(__file__).resolve().parents[2]
PACKED = 6000
CACHED = 60_000
BATCH = 256


@contextmanager
def scratch() -> Iterator[Path]:
    """A folder on the disk (a folder in memory would have no cold reads)."""
    (ROOT / "build").mkdir(exist_ok=True)
    folder = Path(tempfile.mkdtemp(dir=ROOT / "build"))
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


def pack_rows(folder: Path) -> list[CacheRow]:
    """Write 6,000 episodes of noise (which does not compress) in packs; return their rows."""
    rng = np.random.default_rng(0)
    rows: list[CacheRow] = []
    for number in range(PACKED // MAX_EPISODES):
        path = folder / "packs" / f"{number}.mcap"
        with PackWriter(path, {}) as pack:
            for _ in range(MAX_EPISODES):
                values = rng.standard_normal((20, 258), dtype=np.float32)
                pack.write(PackedEpisode(values, {"episode": "e"}))
        name = path.relative_to(folder).as_posix()
        for chunk in read_chunks(path):
            place = (chunk.offset, chunk.length)
            rows.append(CacheRow(f"{len(rows):06d}", chunk.sha256, "r", name, place, 0, 0, "p"))
    return rows


def drop(path: Path) -> None:
    """Take a file out of the page cache."""
    descriptor = os.open(path, os.O_RDONLY)
    os.fsync(descriptor)
    os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)
    os.close(descriptor)


def rate(cache: TrainingCache, batches: int, seed: int) -> float:
    """Episodes per second of random batches of 256."""
    rng = np.random.default_rng(seed)
    listed = [rng.integers(0, len(cache), BATCH) for _ in range(batches)]
    began_s = time.perf_counter()
    for index in listed:
        cache.batch(index)
    return batches * BATCH / (time.perf_counter() - began_s)


@figure("store")
def training_cache() -> list[Figure]:
    """Build time from packs, then random batches cold and warm."""
    with scratch() as folder:
        rows = pack_rows(folder)
        began_s = time.perf_counter()
        open_cache(folder, rows).close()
        build_s = time.perf_counter() - began_s
        many = [
            CacheRow(f"{i:06d}", r.sha256, str(i), r.path, r.chunk, 0, 0, "p")
            for i, r in enumerate(rows * (CACHED // PACKED))
        ]
        first = open_cache(folder, many)
        first.close()
        cold, warm = [], []
        for seed in range(5):
            drop(first.path)
            cache = open_cache(folder, many)
            cold.append(rate(cache, 60, seed))
            cache.observation.sum(dtype=np.float64)
            warm.append(rate(cache, 200, 100 + seed))
            cache.close()
    cold_rate, warm_rate = float(np.median(cold)), float(np.median(warm))
    size = f"{CACHED} episodes, batches of {BATCH}, median of 5"
    return [
        stated("training cache of 6,000 packed episodes, build", build_s, "s"),
        at_least("cache, random reads, cold", cold_rate, "episodes/s", 40_000, size),
        at_least("cache, random reads, warm", warm_rate, "episodes/s", 40_000, size),
    ]  # fmt: skip


@figure("store")
def two_hundred_kills() -> list[Figure]:
    """SIGKILL while episodes and labels are recorded: count lost acknowledged ones."""
    with scratch() as folder:
        command = [sys.executable, "-m", "tests.backend.annotations.crash_trials"]
        words = ["random", str(folder / "data"), "200"]
        done = subprocess.run(
            [*command, *words], cwd=ROOT, capture_output=True, text=True, check=True
        )
    answer = json.loads(done.stdout.splitlines()[-1])
    said = f"{answer['deaths']} kills, {answer['episodes']} episodes, {answer['labels']} labels"
    lost = len(answer["wrong"])
    if lost:
        said += "; " + "; ".join(answer["wrong"])
    return [
        Figure("lost or torn after kill -9", str(lost), "", "0", lost == 0, said),
        Figure("slowest start after a kill", answer["slowest_restart_s"], "s",
               "<= 2 per 1,000 episodes", answer["slowest_restart_s"] <= 2.0),
    ]  # fmt: skip
