"""Speed and durability of a dataset."""

from __future__ import annotations

import json
import os
import random
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from safetensors.numpy import save_file

from tests.backend.annotations.filling import fill, make_files
from tests.backend.annotations.test_mcap import an_episode, mutants, record_ends
from tests.backend.learning.test_checkpoint import reseal, save_small
from tests.bench.registry import Figure, figure
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.training_set import CacheRow, TrainingCache, open_cache
from touchdown.backend.annotations.values import EpisodeFilter, Label
from touchdown.backend.core.faults import InputError
from touchdown.backend.episodes.episode_file import read_episode, write_episode
from touchdown.backend.episodes.mcap import read_chunks
from touchdown.backend.episodes.packs import MAX_EPISODES, PackedEpisode, PackWriter
from touchdown.backend.learning.checkpoint import load_checkpoint

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


MUTANTS, HANG_S = 2000, 10.0
BLOCK = 4096
HEADER_BYTES, REFUSED_S = 100_000_000, 1.0


@figure("faults")
def damaged_episodes() -> list[Figure]:
    """Episodes cut, flipped, zeroed, overwritten, with swapped lengths: count wrong reads."""
    refused = wrong = 0
    slowest_s = 0.0
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "e1.mcap"
        write_episode(path, an_episode(), {"episode": "e1", "x_um": 7}, {"mode": "stepped"})
        whole = path.read_bytes()
        truth = an_episode().observation
        for mutant in _damaged(whole):
            path.write_bytes(mutant)
            begun_s = time.process_time()
            try:
                wrong += not np.array_equal(read_episode(path).observation, truth)
            except InputError:
                refused += 1
            slowest_s = max(slowest_s, time.process_time() - begun_s)
    told = f"{refused} refused by an error of the known kind; slowest {1e3 * slowest_s:.0f} ms"
    name = f"damaged episodes of {MUTANTS} read as something else"
    return [Figure(name, wrong, "", "0, none over 10 s", wrong == 0 and slowest_s < HANG_S, told)]


def _damaged(whole: bytes) -> Iterator[bytes]:
    yield from (whole[:at] for at in range(0, len(whole), BLOCK))
    ends = list(record_ends(whole))
    rng, count = random.Random(5), -(-len(whole) // BLOCK)
    for one in ends[:-1]:
        # The length of one record in place of that of another.
        hurt, other = bytearray(whole), rng.choice(ends[:-1])
        hurt[one + 1 : one + 9] = whole[other + 1 : other + 9]
        if hurt != whole:
            count += 1
            yield bytes(hurt)
    yield from (m for m in mutants(whole, MUTANTS - count) if m != whole)


@figure("faults")
def hostile_models() -> list[Figure]:
    """Pickled code, a header of 100 MB, other tensors, no numbers: refused, and how soon."""
    slowest_s, taken, ran = 0.0, [], []
    for name, spoil in _SPOILT.items():
        with tempfile.TemporaryDirectory() as folder:
            path, witness = Path(folder) / "pot.safetensors", Path(folder) / "ran"
            spoil(path, witness, save_small(path))
            reseal(path)
            begun_s = time.process_time()
            try:
                load_checkpoint(path)
                taken.append(name)
            except InputError:
                slowest_s = max(slowest_s, time.process_time() - begun_s)
            ran += [name] if witness.exists() else []
    told = f"{len(_SPOILT)} kinds" + "".join(f"; {name} was taken" for name in [*taken, *ran])
    return [
        Figure("hostile models, slowest refusal", slowest_s, "s", "<= 1, nothing run",
               slowest_s <= REFUSED_S and not taken and not ran, told)
    ]  # fmt: skip


def _pickled(path: Path, witness: Path, _: object) -> None:
    code = f"open({str(witness)!r}, 'w')".encode()
    call = b"cbuiltins\nexec\n(X" + struct.pack("<I", len(code)) + code + b"tR."
    path.write_bytes(b"\x80\x02" + call)


def _long_header(path: Path, _: Path, __: object) -> None:
    path.write_bytes(struct.pack("<Q", HEADER_BYTES) + b"{" + b" " * (HEADER_BYTES - 2) + b"}")


def _with(**changes: np.ndarray) -> Callable[[Path, Path, dict[str, np.ndarray]], None]:
    return lambda path, _, arrays: save_file({**arrays, **changes}, path)


_SPOILT: dict[str, Callable[[Path, Path, dict[str, np.ndarray]], None]] = {
    "pickled code": _pickled,
    "100 MB header": _long_header,
    "extra tensor": _with(extra=np.zeros(1, np.float32)),
    "wrong shape": _with(**{"head.bias": np.zeros(6, np.float32)}),
    "no numbers": _with(**{"head.bias": np.full(5, np.nan, np.float32)}),
}
