"""Speed and durability of a dataset."""

import json
import os
import re
import resource
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from tests.backend.annotations.filling import fill, make_files
from tests.bench.figures import Figure, at_least, at_most, figure, paired, stated
from touchdown.backend.annotations import Dataset, EpisodeFilter, Label
from touchdown.backend.annotations.reconciliation import check_catalogue
from touchdown.backend.annotations.training_set import (
    CacheRow,
    TrainingCache,
    load_training_set,
    open_cache,
    stored_observation,
)
from touchdown.backend.config import load_simulation
from touchdown.backend.core import write_atomically
from touchdown.backend.episodes.mcap_container import read_chunks
from touchdown.backend.episodes.packs import MAX_EPISODES, PackedEpisode, PackWriter
from touchdown.backend.experiments.collection import batch_plan, episode_rows, split_jobs
from touchdown.backend.geometry import load_pieces
from touchdown.backend.simulation import simulate_episodes

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
CACHED = 30_000
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


@figure("store", long=True)
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


STORED, READ, FOREIGN = 500, 200, 10  # LeRobot's writer takes up to 0.8 s an episode


def _rows(count: int) -> list[PackedEpisode]:
    """Return simulated episodes, which compress as real ones."""
    settings, library = load_simulation(), load_pieces()
    plan = batch_plan(library.top("pot"), library.bottom("circle25"), settings, count, 1, 50, 10)
    (job,) = split_jobs(plan, {}, Path())
    return list(episode_rows(job, list(simulate_episodes(plan, job.grips))))


def _hdf5(path: Path, rows: Sequence[PackedEpisode]) -> None:
    """Write rows to a durable HDF5 file: deflated chunks of one episode, labels as JSON."""
    with h5py.File(path, "w") as file:
        values = file.create_dataset("observation", (len(rows), 20, 258), "f4", chunks=(1, 20, 258),
                                     compression="gzip", compression_opts=1)  # fmt: skip
        labels = file.create_dataset("label", (len(rows),), h5py.string_dtype())
        for k, row in enumerate(rows):
            values[k], labels[k] = row.observation, json.dumps(dict(row.label))
    with path.open("rb+") as written:
        os.fsync(written.fileno())


def _pack(path: Path, rows: Sequence[PackedEpisode]) -> None:
    with PackWriter(path, {}) as pack:
        for row in rows:
            pack.write(row)


@figure("peers")
def stores_of_others() -> list[Figure]:
    """Durable writing and random reading of the same simulated episodes, beside HDF5."""
    rows, rng = _rows(STORED), np.random.default_rng(0)
    with scratch() as folder:
        pack, hdf5 = folder / "pack.mcap", folder / "pack.h5"

        def timed(call: Callable[[], object]) -> Callable[[], float]:
            return lambda: _times_ms(call, 1)[0] / 1e3

        def singly(write: Callable[[Path, list[PackedEpisode]], None], suffix: str) -> None:
            for k, row in enumerate(rows[:READ]):
                write(folder / f"{k}{suffix}", [row])

        whole = paired(
            "store / HDF5, time to write 500 episodes to one file",
            timed(lambda: _pack(pack, rows)),
            timed(lambda: _hdf5(hdf5, rows)),
            np.inf,
        )
        single = paired(
            "store / HDF5, time to write a durable file an episode",
            timed(lambda: singly(_pack, ".mcap")),
            timed(lambda: singly(_hdf5, ".h5")),
            np.inf,
        )
        chunks = [(c.offset, c.length) for c in read_chunks(pack)]
        picked = np.unique(rng.integers(0, STORED, READ)).tolist()

        def random_hdf5() -> list[NDArray[np.float32]]:
            with h5py.File(hdf5) as file:
                return [file["observation"][k] for k in picked]

        read = paired("store / HDF5, time to read 200 episodes at random",
                      timed(lambda: [stored_observation(pack, chunks[k]) for k in picked]),
                      timed(random_hdf5), np.inf)  # fmt: skip
        for k, values in zip(picked, random_hdf5(), strict=True):
            assert np.array_equal(values, rows[k].observation)
            assert np.array_equal(stored_observation(pack, chunks[k]), rows[k].observation)
        sizes = [path.stat().st_size / STORED / 1e3 for path in (pack, hdf5)]
        writer = _beside_lerobot(folder, rows, timed(lambda: _pack(pack, rows[:FOREIGN])))
    size = stated("store / HDF5, bytes an episode", sizes[0] / sizes[1], "",
                  f"{sizes[0]:.1f} kB beside {sizes[1]:.1f} kB")  # fmt: skip
    return [whole, single, read, size, writer]


READERS = Path(os.environ.get("READERS") or ROOT / ".venv-readers") / "bin" / "python"
CHECKS = ROOT / ".ci" / "exchange_check"
NO_READERS = "not measured: make exchange-check installs the readers"


def _beside_lerobot(
    folder: Path, rows: Sequence[PackedEpisode], ours: Callable[[], float]
) -> Figure:
    """Compare with LeRobot's writer in the environment of the readers."""
    rows = rows[:FOREIGN]
    name = f"store / LeRobot's writer, episodes written per second, {len(rows)} episodes"
    if not READERS.exists():
        return Figure(name, None, "", ">= 2", None, NO_READERS)
    np.savez(
        folder / "rows.npz",
        observation=np.stack([row.observation for row in rows]),
        offset_mm=np.array([[row.label[k] for k in ("x_um", "y_um")] for row in rows], "f4") / 1e3,
    )
    words = [READERS, CHECKS / "writer.py", folder / "rows.npz", folder / "lerobot"]
    quiet = {**os.environ, "HF_HOME": str(folder / "hf"), "HF_HUB_OFFLINE": "1", "PYTHONPATH": ""}
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        env=quiet,
    ) as child:  # fmt: skip
        asked, told = child.stdin, child.stdout
        assert asked is not None
        assert told is not None

        def theirs() -> float:
            asked.write("\n")
            asked.flush()
            return float(told.readline())

        theirs()  # its imports and first files
        found = paired(name, ours, theirs, np.inf)
        note = f"time a dataset, ours / theirs {found.value:.3g}, {found.note} s; both durable"
        return at_least(name, 1.0 / float(found.value or np.inf), "", 2.0, note)


@figure("readers")
def exports_read_by_others() -> list[Figure]:
    """Load a small export of each format with the readers of other projects."""
    if not READERS.exists():
        return [Figure("exports read by the real readers", None, "", "ok", None, NO_READERS)]
    done = subprocess.run(
        [ROOT / ".ci" / "exchange-check"], cwd=ROOT, capture_output=True, text=True, check=False,
        env={**os.environ, "READERS": str(READERS.parents[1])},
    )  # fmt: skip
    lines = re.findall(r"^(.{14}) (\S+ \S+) +(ok|FAILED) +(.*)$", done.stdout, re.MULTILINE)
    assert lines, done.stderr
    return [
        Figure(f"export read by {package}: {name.strip()}", told, "", "ok", told == "ok", note)
        for name, package, told, note in lines
    ]


MILLION = int(os.environ.get("EPISODES", "1000000"))
PART = 100_000  # simulated by one call
BOTTOMS = "circle15,circle25,square15,hex20"
START = "2026-01-01T00:00:00Z"
PAGE, PAGES, QUERY_MS, FIRST_MS = 200, 300, 20.0, 100.0


@contextmanager
def _catalogue_folder() -> Iterator[Path]:
    """Return the folder of the variable CATALOGUE, which is kept, or a new one."""
    if kept := os.environ.get("CATALOGUE"):
        yield Path(kept)
        return
    with scratch() as folder:
        yield folder


def _simulate(folder: Path, count: int) -> tuple[float, float]:
    """Write the packs that are missing of ``count`` episodes; return (episodes, seconds).

    These two leave out calls that were interrupted and continued.
    """
    episodes = seconds = 0.0
    (folder / "packs").mkdir(parents=True, exist_ok=True)
    for seed, first in enumerate(range(0, count, PART)):
        part, told = folder / "parts" / str(seed), folder / "parts" / f"{seed}.json"
        each = min(PART, count - first) // len(BOTTOMS.split(","))
        if not told.exists():
            anew = not part.exists()
            words = ["simulate", "--piece", "pot", "--bottoms", BOTTOMS, "--episodes", str(each),
                     "--seed", str(seed), "--start", START, "--out", str(part),
                     "--json"]  # fmt: skip
            done = subprocess.run([sys.executable, "-m", "touchdown", *words], cwd=ROOT, check=True,
                                  capture_output=True, text=True)  # fmt: skip
            answer = json.loads(done.stdout)
            write_atomically(told, json.dumps({**answer, "whole": anew}).encode())
        for path in part.glob("*.mcap"):
            path.replace(folder / "packs" / f"{seed:03d}-{path.name}")
        answer = json.loads(told.read_text())
        if answer["whole"]:
            episodes, seconds = episodes + answer["episodes"], seconds + answer["seconds"]
    return episodes, seconds


def index(folder: Path) -> None:
    """Enter the new packs and print episodes, seconds and memory: run in a process of its own."""
    with closing(sqlite3.connect(folder / "catalog.db")) as connection:
        known = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        sql = "SELECT count(*) FROM episode"
        before = connection.execute(sql).fetchone()[0] if known else 0
        begun_s = time.perf_counter()
        Dataset.open(folder).close()
        seconds = time.perf_counter() - begun_s
        episodes = connection.execute(sql).fetchone()[0] - before
    memory_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    answer = {"episodes": episodes, "seconds": seconds, "memory_gb": memory_gb}
    sys.stdout.write(json.dumps(answer))


def _index(folder: Path) -> tuple[float, float, float]:
    """Enter the new packs; return (episodes, seconds, GB of memory) of the last call that did."""
    code = "import sys; from tests.bench import dataset; dataset.index(dataset.Path(sys.argv[1]))"
    done = subprocess.run([sys.executable, "-c", code, str(folder)], cwd=ROOT, check=True,
                          capture_output=True, text=True)  # fmt: skip
    answer, told = json.loads(done.stdout), folder / "indexed.json"
    if answer["episodes"] or not told.exists():
        write_atomically(told, json.dumps(answer).encode())
    answer = json.loads(told.read_text())
    return answer["episodes"], answer["seconds"], answer["memory_gb"]


def _browsing(folder: Path) -> tuple[float, float, dict[str, list[float]]]:
    """Return the seconds of opening, the ms of the first page, and those of each kind of query."""
    begun_s = time.perf_counter()
    with Dataset.open(folder) as dataset:
        open_s = time.perf_counter() - begun_s
        first = _times_ms(lambda: dataset.episodes(EpisodeFilter(limit=PAGE)), 1)[0]
        places = [uuid for (uuid,) in dataset.parts.database.rows("SELECT uuid FROM episode")]
        rng = np.random.default_rng(0)
        queries: dict[str, list[float]] = {"page": [], "page of a bottom": [], "next": []}
        for _ in range(PAGES):
            place = places[int(rng.integers(len(places)))]
            page = EpisodeFilter(after=place, limit=PAGE)
            part = EpisodeFilter(after=place, limit=PAGE, bottom="circle25")
            queries["page"] += _times_ms(lambda page=page: dataset.episodes(page), 1)
            queries["page of a bottom"] += _times_ms(lambda p=part: dataset.episodes(p), 1)
            queries["next"] += _times_ms(lambda: dataset.queue("unlabelled", "zoe", limit=1), 1)
    return open_s, first, queries


@figure("catalogue", long=True)
def catalogue_of_simulated_episodes() -> list[Figure]:
    """Simulate a large catalogue, index it, browse it and stream it to training.

    The variable EPISODES sets the number of episodes (default: 1,000,000). With CATALOGUE, a
    folder, an interrupted call is continued there, and a larger number builds on a smaller one.
    """
    count = MILLION - MILLION % len(BOTTOMS.split(","))
    name = f"{count:,} simulated episodes"
    with _catalogue_folder() as folder:
        made, made_s = _simulate(folder, count)
        size = sum(path.stat().st_size for path in (folder / "packs").glob("*.mcap"))
        indexed, indexed_s, index_gb = _index(folder)
        open_s, first, queries = _browsing(folder)
        catalogue = (folder / "catalog.db").stat().st_size
        shutil.rmtree(folder / "cache", ignore_errors=True)
        begun_s = time.perf_counter()
        rows = load_training_set(folder, "pot", "drafts")
        cached_s = time.perf_counter() - begun_s
        rng = np.random.default_rng(0)
        listed = [rng.integers(0, len(rows), BATCH) for _ in range(400)]
        begun_s = time.perf_counter()
        for index in listed:
            rows.inputs(index)
        streamed = len(listed) * BATCH / (time.perf_counter() - begun_s)
        assert len(rows) == count
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    load = f"load of the machine {os.getloadavg()[2]:.1f}"
    return [
        *([stated(f"{name}: made, two processes", made / made_s, "episodes/s",
                  f"{made:,.0f} in {made_s:.0f} s; {load}")] if made else []),
        stated(f"{name}: packs", size / count, "bytes an episode"),
        stated(f"{name}: catalogue", catalogue / count, "bytes an episode"),
        *([stated(f"{name}: indexed", indexed / indexed_s, "episodes/s",
                  f"{indexed:,.0f} in {indexed_s:.0f} s; {load}")] if indexed else []),
        stated(f"{name}: largest memory while indexing", index_gb, "GB"),
        stated(f"{name}: opened again", open_s, "s", load),
        at_most(f"{name}: first page of {PAGE}", first, "ms", FIRST_MS),
        *(at_most(f"{name}: {key}, p99", float(np.percentile(times, 99)), "ms", QUERY_MS,
                  f"{PAGES} queries, median {np.median(times):.2g}; {load}")
          for key, times in queries.items()),
        stated(f"{name}: training cache", count / cached_s, "episodes/s", f"{cached_s:.0f} s"),
        stated(f"{name}: streamed to training, random batches of {BATCH}", streamed, "episodes/s",
               load),
        stated(f"{name}: largest memory of the training", memory, "GB"),
    ]  # fmt: skip
