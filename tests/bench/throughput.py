"""Time of tests, set-up, command line, mass simulation, collection and marker tracking."""

import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.backend.devices.cameras.damage import NATIVE_CROP, SCENES, native_pictures
from tests.backend.sensing.hard_clips import CLIPS, render
from tests.backend.sensing.hard_clips import score as hard_score
from tests.backend.sensing.known_truth import known_truth
from tests.bench.figures import Figure, at_least, at_most, failures, figure, paired, stated
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.config import GelsightSettings, load_simulation
from touchdown.backend.core import (
    GRID_COLS,
    TACTILE_CHANNELS,
    InputError,
    MarkerState,
    TactileFrame,
)
from touchdown.backend.devices.cameras.frames import JpegStream, PictureFilter
from touchdown.backend.devices.cameras.sources import CHUNK
from touchdown.backend.experiments.trials import WORLDS, SceneSetup, probing_scene
from touchdown.backend.geometry import load_pieces
from touchdown.backend.runs import CollectRequest, RecordingOptions
from touchdown.backend.sensing import read_pictures, track_frames
from touchdown.backend.sensing.jpeg_damage import DamageCheckingTracker

ROOT = Path(__file__).resolve().parents[2]


def _seconds(command: list[str]) -> float:
    start = time.perf_counter()
    subprocess.run(command, cwd=ROOT, check=False, capture_output=True)
    return time.perf_counter() - start


SUITE = ROOT / "output" / "tests.xml"
LEAST_TESTS, SUITE_S = 5000, 600.0  # fewer tests are a part of the suite


@figure("tests")
def last_test_run() -> list[Figure]:
    """Duration, result and coverage of the last ``make test``; runs no tests."""
    if not SUITE.is_file():
        raise InputError("There is no result of the tests.", str(SUITE), "Run make test first.")
    suite = next(ElementTree.parse(SUITE).iter("testsuite"))
    count, failed, skipped = (
        sum(int(suite.attrib[name]) for name in names)
        for names in (("tests",), ("failures", "errors"), ("skipped",))
    )
    if count < LEAST_TESTS:
        raise InputError(
            f"Only {count} tests were run.", str(SUITE), "Run make test without TESTS."
        )
    seconds = float(suite.attrib["time"])
    note = f"{count - failed - skipped:,} passed, {failed} failed, {skipped} skipped"
    name = f"all tests, CPython {platform.python_version()}"
    took = f"{int(seconds / 60)} min {int(seconds % 60)} s"
    words = [sys.executable, "-m", "coverage", "report", "--format=total"]
    total = subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    return [
        Figure(name, took, "", "< 10 min", not failed and seconds < SUITE_S, note),
        stated("product lines covered by the tests", int(total), "%"),
    ]


@figure("setup")
def second_setup() -> list[Figure]:
    """Time of ``make setup`` when nothing changed."""
    _seconds(["make", "setup"])
    value = _seconds(["make", "setup"])
    return [Figure("make setup, second time", value, "s", "< 3", ok=value < 3)]


@figure("setup")
def command_line_start() -> list[Figure]:
    """Time until the command line has answered (`--version`)."""
    value = min(_seconds([sys.executable, "-m", "touchdown", "--version"]) for _ in range(3))
    return [Figure("touchdown --version", value, "s", "< 1 (own)", ok=value < 1)]


def _simulate(package: str, checkout: Path, episodes: int = 2000) -> tuple[float, float, float]:
    """Simulate the pot on three bottoms by the command ``package`` of ``checkout``.

    Returns the time that the command prints, that of the whole process, and the processor time of
    all its processes, in s.
    """
    words = ["simulate", "--piece", "pot", "--bottoms", "circle15,circle25,square15", "--json",
             "--episodes", str(episodes)]  # fmt: skip
    given = {**os.environ, "PYTHONPATH": str(checkout)}
    given.pop("PYTHONDONTWRITEBYTECODE", None)  # an unpacked version is compiled once only
    # The workers of today lower their priority: other programs would slow them alone.
    alike = ["nice", "-n", "10"] if shutil.which("nice") else []
    with tempfile.TemporaryDirectory() as folder:
        begun_s, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(
            [*alike, sys.executable, "-m", package, *words, "--out", folder],
            check=True, capture_output=True, text=True, cwd=checkout, env=given,
        )  # fmt: skip
        took_s, after = time.perf_counter() - begun_s, resource.getrusage(resource.RUSAGE_CHILDREN)
    answer = json.loads(done.stdout)
    assert answer["episodes"] == 3 * episodes, answer
    spent_s = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return answer["seconds"], took_s, spent_s


@figure("simulation")
def six_thousand_episodes() -> list[Figure]:
    """Time for 6,000 episodes of the Pot on two processes, without images."""
    seconds, _, _ = _simulate("touchdown", ROOT)
    return [Figure("6,000 episodes of the pot", seconds, "s", "<= 60 (goal 20)", seconds <= 60)]


# The last version before the modules were merged, of 833 modules.
BEFORE = "3d1bd4779040794ac2dea4eeb564b3c250cf78c0"


@figure("peers")
def simulation_of_the_version_before() -> list[Figure]:
    """6,000 episodes by two processes, beside an earlier version out of the history."""
    name, spent = (
        f"6,000 episodes of the pot / the same by version {BEFORE[:8]}, {what}"
        for what in ("time", "processor time")
    )
    with tempfile.TemporaryDirectory() as folder:
        packed = Path(folder) / "before.tar"
        words = ["git", "archive", "--output", str(packed), BEFORE, "backend", "resources"]
        if subprocess.run(words, cwd=ROOT, check=False, capture_output=True).returncode:
            note = "not measured: the checkout has no history of that version"
            return [Figure(name, None, "", "<= 0.9", None, note)]
        before = Path(folder) / "before"
        with tarfile.open(packed) as archive:
            archive.extractall(before, filter="data")
        _simulate("backend", before, 1)  # compiles it
        times: dict[str, list[tuple[float, float, float]]] = {"touchdown": [], "backend": []}
        found = paired(name, lambda: _kept(times, "touchdown", ROOT),
                       lambda: _kept(times, "backend", before), 0.9)  # fmt: skip
    own, other = (np.array([one[2] for one in times[package]]) for package in times)
    note = f"{min(own / other):.3g} to {max(own / other):.3g} in {len(own)} pairs; "
    note += f"{np.median(own):.4g} beside {np.median(other):.4g} s"
    return [found, stated(spent, float(np.median(own / other)), "", note)]


def _kept(times: dict[str, list[tuple[float, float, float]]], package: str, at: Path) -> float:
    """Simulate, add the times to ``times``, and return that of the whole process."""
    times[package].append(_simulate(package, at))
    return times[package][-1][1]


PROBES = 12


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


GELSIGHT = Path(__file__).resolve().parents[1] / "data" / "gelsight"
# other gels, recognised and named by the tracker, not tracked
SMALL_DOTS = (
    GELSIGHT / "artificial_strawberry_exp2_camera_2.avi",
    GELSIGHT / "plug_3D_exp3_camera_0.avi",
)


@figure("tracking")
def real_gels() -> list[Figure]:
    """Speed, and what is seen on real videos and pictures, by file."""
    ms: list[float] = []
    rows, whole_at_start = [], []
    cv2.setNumThreads(1)
    for path in sorted({*GELSIGHT.glob("*.avi"), *GELSIGHT.glob("*.png")} - set(SMALL_DOTS)):
        tracked = list(track_frames(read_pictures(path), None, str(path)))
        state = np.stack([one.field.state for one in tracked])
        ms += [one.ms for one in tracked[1:]]
        whole_at_start.append(bool((state[0] == MarkerState.SEEN).all()))
        inferred, lost = (int((state == kind).sum()) for kind in NOT_SEEN)
        note = f"{len(state)} frames; inferred {inferred}, lost {lost}{_where(state != 0)}"
        share = 100 * float((state == MarkerState.SEEN).mean())
        rows.append(at_least(f"markers seen, {path.stem}", share, "%", 99, note))
    median, slow = float(np.median(ms)), float(np.percentile(ms, 99))
    files = f"{sum(whole_at_start)} of {len(whole_at_start)}"
    return [
        Figure("tracker, median per frame, one thread", median, "ms", "<= 1 (must 2)", median <= 2),
        stated("tracker, 99 % of frames, one thread", slow, "ms"),
        Figure("files with 63/63 on frame 0", files, "", "all", all(whole_at_start)),
        *rows,
    ]


@figure("tracking")
def hard_clips() -> list[Figure]:
    """Visible markers seen beside a strong contact, on clips rendered from real ones."""
    rows, scores = [], []
    cv2.setNumThreads(1)
    for clip in CLIPS:
        scene = render(clip)
        found = hard_score(scene)
        scores.append(found)
        note = (
            f"{len(scene.images)} frames; inferred {found.inferred}, lost {found.lost}, "
            f"false {found.false}{_where(found.unseen_at[None])}"
        )
        share = 100 * found.seen / found.visible
        rows.append(stated(f"visible markers within 1 px, {clip.name}", share, "%", note))
    visible = sum(one.visible for one in scores)
    reported = visible - sum(one.inferred + one.lost for one in scores)
    of = f"{len(CLIPS)} hard clips"
    seen = sum(one.seen for one in scores)
    return [
        at_least(f"visible markers within 1 px, {of}", 100 * seen / visible, "%", 99),
        at_least(f"visible markers reported as seen, {of}", 100 * reported / visible, "%", 99),
        failures(f"hidden markers reported as seen, {of}", sum(one.hidden for one in scores)),
        stated(f"markers reported over 1.5 px off, {of}", sum(one.false for one in scores), ""),
        *rows,
    ]


NOT_SEEN = (MarkerState.INFERRED, MarkerState.LOST)


def _where(unseen: NDArray[np.generic]) -> str:
    """Return the three markers most often unseen in (n, 63), as (row, column)."""
    count = np.sum(unseen, axis=0)
    worst = [k for k in np.argsort(-count, kind="stable")[:3].tolist() if count[k]]
    cells = ", ".join(f"({k // GRID_COLS}, {k % GRID_COLS}) {count[k]}" for k in worst)
    return f"; unseen at {cells}" if cells else ""


@figure("tracking")
def truth_that_is_known() -> list[Figure]:
    """Errors against drawn dots, by amplitude and fault."""
    figures = []
    for case, found in known_truth().items():
        limit = 0.10 if case.fault in ("flick", "occl") else 0.05 if case.amplitude == 6 else 0.08
        name = f"known truth {case.amplitude:.0f} px {case.fault}, rms of seen"
        ok = found.rms_seen <= limit and found.wrong == 0 and found.lost == 0
        note = f"off by >= 10 px: {found.wrong}, lost: {found.lost}"
        figures.append(Figure(name, float(found.rms_seen), "px", f"<= {limit}", ok, note))
    return figures


LARGE = sorted(set(GELSIGHT.glob("*.avi")) - set(SMALL_DOTS))
FLOW = {"winSize": (15, 15), "maxLevel": 2, "criteria": (3, 10, 0.03)}


def marked(path: Path) -> dict[int, NDArray[np.float64]]:
    """Return the dots (63, 2) in px that were marked by eye, by frame."""
    lines = (GELSIGHT / "marks.csv").read_text("utf-8").splitlines()
    rows = [line.split(",") for line in lines if line.startswith(path.name)]
    return {int(row[1]): np.array(row[2:], dtype=float).reshape(63, 2) for row in rows}


Track = Callable[[list[TactileFrame]], Iterator[NDArray[np.float64]]]


def ours(frames: list[TactileFrame]) -> Iterator[NDArray[np.float64]]:
    """Yield the places (63, 2) of the product's tracker."""
    for one in track_frames(frames, None, "clip"):
        yield one.field.position_px.astype(float)


def lucas_kanade(frames: list[TactileFrame]) -> Iterator[NDArray[np.float64]]:
    """Yield the places by optical flow from frame to frame, as public GelSight code does."""
    at = next(ours(frames[:1])).astype(np.float32)[:, None]
    before = cv2.cvtColor(frames[0].image, cv2.COLOR_BGR2GRAY)
    yield at[:, 0]
    for frame in frames[1:]:
        grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        at = cv2.calcOpticalFlowPyrLK(before, grey, at, None, **FLOW)[0]
        before = grey
        yield at[:, 0]


def blobs(frames: list[TactileFrame]) -> Iterator[NDArray[np.float64]]:
    """Yield the places by a blob detector, each dot the nearest blob to its last place."""
    asked = cv2.SimpleBlobDetector_Params()
    asked.minArea, asked.maxArea, asked.minDistBetweenBlobs = 25, 600, 10
    asked.filterByCircularity = asked.filterByConvexity = asked.filterByInertia = False
    detector = cv2.SimpleBlobDetector_create(asked)
    at = next(ours(frames[:1]))
    for frame in frames:
        found = np.array([dot.pt for dot in detector.detect(frame.image.max(axis=2))])
        if len(found):
            distance = np.linalg.norm(at[:, None] - found, axis=2)
            near = distance.argmin(axis=1)
            at = np.where(distance.min(axis=1)[:, None] < 15, found[near], at)
        yield at


def _ms(track: Track, frames: list[TactileFrame]) -> float:
    """Return the median time of a frame after the first."""
    found, begun_s = [], time.perf_counter()
    for _ in track(frames):
        found.append(1e3 * (time.perf_counter() - begun_s))
        begun_s = time.perf_counter()
    return float(np.median(found[1:]))


@figure("peers")
def trackers_of_others() -> list[Figure]:
    """Time a frame beside two usual trackers, and places against the dots marked by eye."""
    cv2.setNumThreads(1)
    rows, errors = [], {track: list[float]() for track in (ours, lucas_kanade, blobs)}
    for path in LARGE:
        frames, truth = list(read_pictures(path)), marked(path)
        for track, found in errors.items():
            places = {k: at for k, at in enumerate(track(frames)) if k in truth}
            found += [float(d) for k, at in places.items()
                      for d in np.linalg.norm(at - truth[k], axis=1)]  # fmt: skip
        rows += [
            paired(f"tracker / {name}, time a frame, {path.stem}", partial(_ms, ours, part),
                   partial(_ms, other, part), np.inf)
            for name, other, part in (("Lucas-Kanade", lucas_kanade, frames),
                                      ("blob detector", blobs, frames[: len(frames) // 3]))
        ]  # fmt: skip
    ratios = [float(row.value or 0) for row in rows[::2]]
    lost, of = sum(error > 3.0 for error in errors[ours]), f"of {len(errors[ours])}"
    note = f"{min(ratios):.3g} to {max(ratios):.3g} over {len(LARGE)} clips"
    whole = at_most("tracker / Lucas-Kanade, median over the clips", float(np.median(ratios)), "",
                    1.5, note)  # fmt: skip
    return [
        whole,
        failures("markers of the tracker over 3 px from their dots", lost, of),
        *rows,
        *(stated(f"{track.__name__.replace('_', ' ')}: distance from the dots, p50, p99, max",
                 ", ".join(f"{np.percentile(found, q):.3g}" for q in (50, 99, 100)), "px",
                 f"over 3 px: {sum(e > 3 for e in found)} of {len(found)}")
          for track, found in errors.items()),
    ]  # fmt: skip


PRESSES = 24


@figure("peers")
def presses_of_mujoco() -> list[Figure]:
    """Time a press on the simulated bench beside MuJoCo, and wrenches of both against statics."""
    case = SceneSetup.of(load_pieces(), "pot", ("circle25",), load_simulation(preset="quiet"))
    scenes = [probing_scene(case, seed) for seed in range(PRESSES)]
    wrench: dict[str, NDArray[np.float32]] = {}

    def pressed_s(name: str) -> float:
        world = WORLDS[name](scenes)
        begun_s = time.perf_counter()
        found = world.press(range(PRESSES), world.start_commands_mm())
        took_s = time.perf_counter() - begun_s
        wrench[name] = found.observation[:, -1, TACTILE_CHANNELS:]
        return took_s / PRESSES

    ratio = paired("press simulation / MuJoCo press, time", lambda: pressed_s("bench"),
                   lambda: pressed_s("elsewhere"), np.inf)  # fmt: skip
    apart = np.abs(wrench["bench"] - wrench["elsewhere"])
    note = f"of {PRESSES} presses, 2 s after contact; the pads of both worlds differ on purpose"
    force, moment = np.median(apart[:, 2]), np.median(np.linalg.norm(apart[:, 3:5], axis=1))
    return [
        ratio,
        stated("bench and MuJoCo apart, vertical force, median", float(force), "N", note),
        stated("bench and MuJoCo apart, moment, median", float(moment), "N·m", note),
    ]


NATIVE_PICTURES, CAMERA_HZ, NATIVE_SHARE = 40, 25.0, 35.0


@figure("peers")
def native_streams() -> list[Figure]:
    """Processor time of both cameras at native size: bytes, decoding, checks and tracking.

    The share follows from the processor time of a picture, so that other programs do not count.
    """
    cv2.setNumThreads(1)
    costs = []
    for clip, at in SCENES:
        pictures = native_pictures(clip, at, NATIVE_PICTURES)
        stream = JpegStream()
        gate = PictureFilter(
            "left", "tactile_left", GelsightSettings(crop_fraction=NATIVE_CROP), 0.0
        )
        tracker, seen = DamageCheckingTracker("left"), 0
        for k, content in enumerate(pictures):
            begun_s = time.process_time()
            for first in range(0, len(content), CHUNK):
                for whole in stream.feed(content[first : first + CHUNK]):
                    image = gate.judge(k / CAMERA_HZ, whole)
                    if image is not None:
                        frame = TactileFrame("left", k, k / CAMERA_HZ, image, from_jpeg=True)
                        seen += tracker.track(frame) is not None
            if k:  # the first one finds the grid
                costs.append(time.process_time() - begun_s)
        assert seen >= 0.9 * len(pictures), seen
    share = 100.0 * 2.0 * CAMERA_HZ * float(np.mean(costs)) / 2.0
    size = f"{1e-6 * len(pictures[-1]):.1f} MB a picture"
    note = f"{1e3 * float(np.mean(costs)):.2g} ms a picture, {size}, {len(costs)} pictures"
    return [at_most("two native 3280x2464 MJPG streams at 25 Hz, share of two cores", share, "%",
                    NATIVE_SHARE, note)]  # fmt: skip
