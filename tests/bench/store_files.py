"""Figures of durability and of reading training sets: cache, recovery, kills."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from tests.bench.registry import Figure, figure
from touchdown.backend.annotations.training_set import CacheRow, TrainingCache, open_cache
from touchdown.backend.episodes.mcap import read_chunks
from touchdown.backend.episodes.packs import MAX_EPISODES, PackedEpisode, PackWriter

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
        Figure("training cache of 6,000 packed episodes, build", build_s, "s", "stated", None),
        Figure("cache, random reads, cold", cold_rate, "episodes/s", ">= 40000",
               cold_rate >= 40_000, size),
        Figure("cache, random reads, warm", warm_rate, "episodes/s", ">= 40000",
               warm_rate >= 40_000, size),
    ]  # fmt: skip


@figure("store")
def two_hundred_kills() -> list[Figure]:
    """SIGKILL while episodes and labels are recorded: what was acknowledged and is gone."""
    with scratch() as folder:
        command = [sys.executable, "-m", "tests.backend.catalogue.crash_trials"]
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
