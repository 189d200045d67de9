"""Time of tests, set-up, command line, mass simulation, collection and marker tracking."""

import json
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.backend.sensing.hard_clips import CLIPS, render
from tests.backend.sensing.hard_clips import score as hard_score
from tests.backend.sensing.known_truth import known_truth
from tests.bench.figures import Figure, at_least, failures, figure, stated
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core import GRID_COLS, InputError, MarkerState
from touchdown.backend.runs import CollectRequest, RecordingOptions
from touchdown.backend.sensing import read_pictures, track_frames

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


@figure("simulation")
def six_thousand_episodes() -> list[Figure]:
    """Time for 6,000 episodes of the Pot on two processes, without images."""
    with tempfile.TemporaryDirectory() as folder:
        words = "simulate --piece pot --bottoms circle15,circle25,square15 --episodes 2000 --seed 1"
        done = subprocess.run(
            [sys.executable, "-m", "touchdown", *words.split(), "--out", folder, "--json"],
            check=True,
            capture_output=True,
            text=True,
            cwd=Path(__file__).resolve().parents[2],
        )
    answer = json.loads(done.stdout)
    ok = answer["seconds"] <= 60 and answer["episodes"] == 6000
    return [Figure("6,000 episodes of the pot", answer["seconds"], "s", "<= 60 (goal 20)", ok)]


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
