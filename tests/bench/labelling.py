"""Labelling: the page, slips and queues of wrong labels.

The queue of the episodes of which the model is unsure looks at no label: it is measured by how
often the model itself is wrong there.
"""

import dataclasses
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication

from tests.app.label.conftest import make_episode
from tests.backend.annotations import filling
from tests.backend.bench.brisk import brisk_session
from tests.bench.figures import Figure, at_least, at_most, failures, figure, stated
from touchdown.app.application import TouchdownApp
from touchdown.app.label.text import evidence_badges
from touchdown.app.shell.datasets import ModelPrelabeller, model_path_in_use
from touchdown.app.shell.errors import ErrorBox
from touchdown.app.shell.label_items import LabelDraft, item_reader
from touchdown.app.start import tune_interpreter
from touchdown.backend.annotations import Dataset, EpisodeContext, Label, SetState
from touchdown.backend.annotations.queues import SCORES
from touchdown.backend.bench.assembly import shipped_model
from touchdown.backend.geometry import load_pieces
from touchdown.backend.placement.estimator import NOTABLE_SIGMAS, Ensemble, Estimator
from touchdown.backend.placement.label_review import score_labels
from touchdown.backend.runs import CollectRequest
from touchdown.backend.simulation import conditions
from touchdown.backend.simulation.devices.bench import SimulatedBench

EPISODES, FILMED = 10_000, 120  # length of the queue; episodes with films of 2 s
LOOKS, NUDGES, ACCEPTED = 100, 200, 50


@figure("labelling")
def label_page() -> list[Figure]:
    """Walk a queue of 10,000 episodes by the presenter's own steps, painting each offscreen."""
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with mock.patch.dict(os.environ, {"TOUCHDOWN_DATA": str(folder)}):
            fill(folder / "dataset", EPISODES, FILMED)
            return _walk(folder)


def fill(folder: Path, episodes: int, filmed: int) -> None:
    """Make the dataset without synchronising: nothing has to survive a crash."""
    catalogue = load_pieces()
    with mock.patch("os.fsync"), Dataset.open(folder, person="bench") as dataset:
        pair = dataset.geometry.store_pair(catalogue.piece("pot"), catalogue.piece("circle15"))
        context = EpisodeContext("series", "circle15", pair, "bench", "g", "m")
        for seed in range(episodes):
            episode = make_episode(seed, frames=50 if seed < filmed else 0)
            x_um, y_um = np.rint(1e3 * episode.offset_mm).astype(int).tolist()
            dataset.record(episode, Label(x_um, y_um, 0, 300), source="commanded", context=context)


def _opened(folder: Path) -> tuple[Any, Any, Any]:
    """Return application, window and label workspace, with Ann at the label page."""
    tune_interpreter()
    application = QApplication.instance() or QApplication([])
    assert isinstance(application, QApplication)
    window = TouchdownApp(application, ErrorBox(), folder / "window.json", folder / "runs")
    both: Any = window.workspaces["collect"]
    both.page.bring("label")
    both.label.recall({"person": "Ann", "sigma_mm": 0.2})
    window.window.show()
    window.go("collect")
    return application, window, both.label


def _walk(folder: Path) -> list[Figure]:
    application, window, workspace = _opened(folder)

    def until(done: Callable[[], bool]) -> None:
        end_s = time.monotonic() + 120
        while not done() and time.monotonic() < end_s:
            QTest.qWait(1)

    until(lambda: workspace.presenter is not None and workspace.presenter.present is not None)
    p = workspace.presenter

    def ready() -> bool:
        ahead = p.walk.order[p.walk.at + 1]
        return ahead in p._prefetch.held() and not p.saving.busy

    def timed(act: Callable[[], None], done: Callable[[], bool]) -> float:
        start_s = time.perf_counter()
        act()
        until(done)
        application.processEvents()
        return 1e3 * (time.perf_counter() - start_s)

    looks, busy, nudges, accepted, working = [], [], [], [], []
    for _ in range(LOOKS // 2):
        until(ready)
        want, start_s = p.walk.at + 1, time.thread_time()
        looks.append(timed(lambda want=want: p.go_to(want), lambda: True))  # type: ignore[misc]
        busy.append(1e3 * (time.thread_time() - start_s))
    for k in range(NUDGES):
        start_s = time.perf_counter()
        p.editing.nudge(10 if k % 2 else -10, 0)
        nudges.append(1e3 * (time.perf_counter() - start_s))
        application.processEvents()
    until(lambda: not p.editing.waits and not p.saving.busy)
    for _ in range(ACCEPTED):
        until(ready)
        before, start_s = p.present.item.entry.uuid, time.thread_time()
        accepted.append(timed(
            workspace.tools.decisions.enter,
            lambda before=before: p.present.item.entry.uuid != before,  # type: ignore[misc]
        ))  # fmt: skip
        working.append(1e3 * (time.thread_time() - start_s))
    held = sum(p._prefetch.get(uuid).bytes for uuid in p._prefetch.held())
    window.close()
    note = f"{len(p.walk.order)} episodes, offscreen"
    next_ms, nudge_ms = (float(np.percentile(v, 95)) for v in (looks, nudges))
    return [
        at_most("next episode painted, p95", next_ms, "ms", 50, note),
        *_stated("next episode painted", looks, (50,), note),
        *_stated("next episode, processor time of the window's thread", busy, (50, 95), note),
        at_most("patch, hull and verdict of a nudge, p95", nudge_ms, "ms", 5, note),
        *_stated("accept saved and next painted", accepted, (50, 95), note),
        *_stated("accept and next, processor time of the window's thread", working, (50, 95), note),
        Figure("episodes read ahead", held / 1e6, "MB", "<= 50", held <= 50e6, note),
    ]  # fmt: skip


LARGE, RECORDED, PAGES, SORTED = 100_000, 120, 100, "piece:pot sort:pair"


@figure("labelling")
def large_dataset() -> list[Figure]:
    """Walk 100,000 episodes in the window by its keys, list and filter, offscreen.

    The last 120 have recordings; the files of the others are holes, which cannot be read.
    """
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with mock.patch.dict(os.environ, {"TOUCHDOWN_DATA": str(folder)}):
            with Dataset.open(folder / "dataset") as dataset:
                filling.fill(dataset, LARGE - RECORDED)
                filling.make_files(dataset)
            with Dataset.open(folder / "dataset") as dataset:
                dataset.resolve("bench")  # the journal that ``filling.fill`` did not write
            fill(folder / "dataset", RECORDED, RECORDED)
            return _walk_large(folder)


def _walk_large(folder: Path) -> list[Figure]:
    never, turns = threading.Event(), list[float]()  # turns of the event loop, ms

    def turn() -> None:
        start_s = time.perf_counter()
        application.processEvents()
        turns.append(1e3 * (time.perf_counter() - start_s))

    def until(done: Callable[[], object]) -> None:
        end_s = time.monotonic() + 300
        while not done():
            assert time.monotonic() < end_s, "the window did not come to it"
            turn()
            never.wait(0.001)

    def press(*keys: Any, **more: Any) -> None:
        for key in keys:
            start_s = time.perf_counter()
            QTest.keyClick(window.window.windowHandle(), key, **more)
            turn()
            pressed.append(1e3 * (time.perf_counter() - start_s))

    def turn_pages() -> None:
        """Page down at some places of the list, from its beginning to its end."""
        bar = page.list.verticalScrollBar()
        for start in np.linspace(0, bar.maximum(), PAGES // 10).astype(int).tolist():
            bar.setValue(start - 9 * bar.pageStep() if start else 0)
            for _ in range(10):
                start_s = time.perf_counter()
                bar.triggerAction(bar.SliderAction.SliderPageStepAdd)
                turn()
                paged.append(1e3 * (time.perf_counter() - start_s))
        assert bar.value() == bar.maximum()

    begun_s = time.monotonic()
    application, window, workspace = _opened(folder)
    page, pressed, paged = workspace.label_page, list[float](), list[float]()
    until(lambda: workspace.presenter is not None and workspace.presenter.walk.order)
    walk, opened_s = workspace.presenter.walk, time.monotonic() - begun_s
    assert len(walk.order) == LARGE
    turn_pages()
    press(Qt.Key.Key_Q, *str(LARGE - RECORDED + 1), Qt.Key.Key_Return)
    for at in range(LARGE - RECORDED, LARGE - 1):
        until(lambda at=at: walk.at == at and not isinstance(walk.ahead(), Exception | None))  # type: ignore[misc]
        press(Qt.Key.Key_PageDown)
    press(Qt.Key.Key_F, modifier=Qt.KeyboardModifier.ControlModifier)
    press(*SORTED)
    begun_s = time.monotonic()
    press(Qt.Key.Key_Return)
    until(lambda: len(walk.order) < LARGE)
    filtered_s, count = time.monotonic() - begun_s, len(walk.order)
    turn_pages()
    window.close()
    note = f"{LARGE:,} episodes, offscreen"
    page_ms, key_ms = (float(np.percentile(v, 95)) for v in (paged, pressed))
    return [
        stated("large dataset, window to its list", opened_s, "s", note),
        at_most("large dataset, page of the list, p95", page_ms, "ms", 50, note),
        at_most("large dataset, key, p95", key_ms, "ms", 50, f"{note}; {len(pressed)} keys"),
        stated("large dataset, filtered and sorted", filtered_s, "s", f"{count:,} pass {SORTED}"),
        at_most("large dataset, longest freeze", max(*turns, *pressed, *paged), "ms", 200, note),
    ]  # fmt: skip


DRAFTS, WRONG_DRAFTS, DRAFT_MM = 100, 30, (1.0, 4.0)
NUMBER = re.compile(r"[+\N{MINUS SIGN}]?\d+\.\d+")


@figure("day")
def scripted_annotator() -> list[Figure]:
    """Label 100 collected drafts by keys, from what the page shows; 30 are off by 1 to 4 mm.

    Enter accepts a label without a badge. With one, M takes the model's displacement; if a badge
    remains, the displacement that the scene camera measured is typed.
    """
    os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with mock.patch.dict(os.environ, {"TOUCHDOWN_DATA": name}):
            true, wrong = _collect_drafts(folder / "dataset")
            keys, seconds = _label_by_keys(folder, len(true))
            with Dataset.open(folder / "dataset") as dataset:
                heads = {uuid: dataset.labels.head(uuid) for uuid in true}
    error_mm = {u: float(np.hypot(*(h.label.offset_mm - true[u]))) for u, h in heads.items()}
    left = sum(head.state == "draft" for head in heads.values())
    note = f"{len(true)} drafts, {len(wrong)} wrong, simulated devices"
    return [
        at_most("day of labelling, median final error", float(np.median([*error_mm.values()])),
                "mm", 0.3, note),
        stated("day of labelling, median final error of the wrong drafts",
               float(np.median([error_mm[uuid] for uuid in wrong])), "mm", note),
        at_most("day of labelling, keys a draft", keys / len(true), "", 2.5, note),
        at_most("day of labelling, time", seconds / 60, "min", 4,
                "of the window; a person looks longer"),
        failures("day of labelling, drafts left", left),
    ]  # fmt: skip


def _collect_drafts(folder: Path) -> tuple[dict[str, Any], list[str]]:
    """Return the true displacement of each probe in mm, and the probes whose draft is wrong."""
    rng = np.random.default_rng(SEED)
    with mock.patch("os.fsync"), Dataset.open(folder, person="Ann") as dataset:
        session = brisk_session("mixed")
        session.dataset = dataset
        session.run(CollectRequest(count=DRAFTS, person="Ann"))
        session.close()
        true = {e.uuid: dataset.labels.head(e.uuid).label.offset_mm for e in dataset.episodes()}
        wrong = rng.choice(list(true), WRONG_DRAFTS, replace=False).tolist()
        for uuid in wrong:
            turn, by_mm = rng.uniform(0, 2 * np.pi), rng.uniform(*DRAFT_MM)
            at_mm = true[uuid] + by_mm * np.array([np.cos(turn), np.sin(turn)])
            x_um, y_um = np.rint(1e3 * at_mm).astype(int).tolist()
            dataset.labels.set("Ann", uuid, Label(x_um, y_um, 0, 300))
    return true, wrong


def _label_by_keys(folder: Path, count: int) -> tuple[int, float]:
    """Return the number of keys and the seconds in which the queue of drafts was labelled."""
    application, window, workspace = _opened(folder)
    page, keys = workspace.label_page, 0

    def calm() -> bool:
        p = workspace.presenter
        return p is not None and p.present is not None and not (p.saving.busy or p.editing.waits)

    def until(done: Callable[[], bool]) -> None:
        end_s = time.monotonic() + 20
        while not done() and time.monotonic() < end_s:
            QTest.qWait(1)

    def press(*pressed: Any) -> None:
        nonlocal keys
        for key in pressed:
            QTest.keyClick(window.window.windowHandle(), key)
            keys += 1
        application.processEvents()
        until(calm)

    def badged() -> bool:
        return any("off" in badge for badge in page.strip.badges)

    def here() -> str:
        present = workspace.presenter.present
        return "" if present is None else present.item.entry.uuid

    until(calm)
    begun_s = time.monotonic()
    for _ in range(count):
        if workspace.presenter.present is None:
            break
        if badged():
            press(Qt.Key.Key_M)
        numbers = NUMBER.findall(page.scene_line.text())
        if badged() and len(numbers) > 1:
            text = ",".join(numbers[:2]).replace("\N{MINUS SIGN}", "-").replace("+", "")
            press(*text, Qt.Key.Key_Return)
        before = here()
        press(Qt.Key.Key_Return)
        until(lambda before=before: here() != before)  # type: ignore[misc]
    taken_s = time.monotonic() - begun_s
    window.quit_at_once()
    window.close()
    return keys, taken_s


def _stated(name: str, times_ms: list[float], shares: tuple[int, ...], note: str) -> list[Figure]:
    """Return percentiles that have no target of their own."""
    return [
        stated(f"{name}, p{share}", float(np.percentile(times_ms, share)), "ms", note)
        for share in shares
    ]  # fmt: skip


# In every third grip the piece is 1 to 3 mm off its place along the jaws.
SLIP_PROBES, PER_GRIP, EVERY = 72, 3, 3


@figure("labelling")
def slips() -> list[Figure]:
    """Collect on the simulated devices with injected slips, then judge each recorded label."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "dataset"
        with mock.patch("os.fsync"), Dataset.open(folder, person="bench") as dataset:
            slipped_at_s = _collect(dataset)
            judged = _judged(dataset, slipped_at_s)
    hits = [badged for slipped, badged in judged if slipped]
    false = [badged for slipped, badged in judged if not slipped]
    hit, wrong = 100 * float(np.mean(hits)), 100 * float(np.mean(false))
    count = f"of {len(hits)} and {len(false)} probes"
    return [
        at_least("slips of 1 to 3 mm that are badged", hit, "%", 95, count),
        at_most("clean probes that are badged", wrong, "%", 5, count),
    ]


# mounting number and time of a picture; the clock restarts with every mounting
Taken = tuple[int, float]


def _collect(dataset: Any) -> dict[Taken, bool]:
    """Return for each picture whether the piece had slipped."""
    rng, grips, slipped = np.random.default_rng(5), [0], dict[Taken, bool]()
    last: Taken = (0, 0.0)
    draw, picture = conditions.draw_gripping, SimulatedBench.scene_picture

    def drawn(*given: Any) -> Any:
        grip = draw(*given)
        grips[0] += 1
        if grips[0] % EVERY:
            return grip
        x_mm, z_mm = grip.grasp_offset_mm
        x_mm += float(rng.choice([-1, 1]) * rng.uniform(1, 3))
        return dataclasses.replace(grip, grasp_offset_mm=(x_mm, z_mm))

    def seen(bench: SimulatedBench) -> Any:
        nonlocal last
        at_s, now = round(bench.clock.now_s(), 6), grips[0] % EVERY == 0
        last = (last[0] + (at_s < last[1]), at_s)
        if slipped.setdefault(last, now) is not now:
            raise RuntimeError("two pictures at one time: nobody could tell which slipped")
        return picture(bench)

    with (
        mock.patch.object(conditions, "draw_gripping", drawn),
        mock.patch.object(SimulatedBench, "scene_picture", seen),
    ):
        session = brisk_session("mixed")
        session.dataset = dataset
        session.run(
            CollectRequest(
                count=SLIP_PROBES, person="bench", probes_per_grip=PER_GRIP, grips_per_mounting=10
            )
        )
        session.close()
    return slipped


def _judged(dataset: Any, slipped: dict[Taken, bool]) -> list[tuple[bool, bool]]:
    """Return (slipped, badged) of each probe that was no refused observation."""
    read = item_reader(dataset, ModelPrelabeller(load_pieces(), model_path_in_use))
    judged, mountings = [], dict[str, int]()
    for entry in dataset.episodes():
        mounting = mountings.setdefault(entry.mounting_id, len(mountings))
        if entry.quality.accepted:
            item = read(entry.uuid)
            assert item.episode.recording is not None
            at_s = round(item.episode.recording.scene[0].t_s, 6)
            badge = evidence_badges(LabelDraft.of(dataset.labels.head(entry.uuid)), item)
            judged.append((slipped[mounting, at_s], bool(badge)))
    return judged


ROOT = Path(__file__).resolve().parents[2]
BOTTOMS, EACH, SEED = "circle15,circle25,square15", 1000, 77
WRONG_SHARE, WRONG_MM = 0.02, (1.0, 3.0)
FIRST = 100
NOT_FOR_ERRORS = {"audit": "random", "training": "looks at no label"}
Wrong = dict[str, Label]  # displacement of each wrong label; all others are as commanded


@figure("queues")
def wrong_labels() -> list[Figure]:
    """3,000 simulated probes of the pot, 2 % of the labels wrong in two ways; shipped model."""
    with tempfile.TemporaryDirectory() as name:
        packs = Path(name) / "packs"
        words = ["simulate", "--piece", "pot", "--bottoms", BOTTOMS, "--episodes", str(EACH)]
        words += ["--seed", str(SEED), "--out", str(packs)]
        command = [sys.executable, "-m", "touchdown", *words]
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
        moved = _measured(packs, Path(name) / "moved", _moved, "off by 1 to 3 mm")
        return [*moved, *_measured(packs, Path(name) / "next", _of_the_next, "of the next probe")]


def _measured(
    packs: Path, folder: Path, make: Callable[[Dataset], Wrong], kind: str
) -> list[Figure]:
    """Set labels wrong in a dataset of its own, submit all, let the model score them, measure."""
    Dataset.open(folder).close()
    shutil.copytree(packs, folder / "packs")
    with Dataset.open(folder) as dataset:
        wrong = make(dataset)
        for uuid, label in wrong.items():
            dataset.labels.set("bench", uuid, label)
        uuids = [entry.uuid for entry in dataset.episodes()]
        dataset.labels.bulk("bench", dataset.labels.preview("bench", uuids, SetState("accept")))
        models = Ensemble([Estimator.load(shipped_model("pot"), load_pieces().top("pot"))])
        count = score_labels(dataset, lambda _: models, lambda done, total: True)
        figures = _precision(dataset, set(wrong), count, kind)
        if make is _moved:
            figures += _badges(dataset, wrong)
        return figures


def _chosen(dataset: Dataset) -> list[int]:
    """Return which episodes get a wrong label, in the order of the dataset."""
    count = len(dataset.episodes())
    rng = np.random.default_rng(SEED)
    return sorted(rng.choice(count, round(WRONG_SHARE * count), replace=False).tolist())


def _moved(dataset: Dataset) -> Wrong:
    """Move labels by 1 to 3 mm, as a slip in the grasp or a wrong origin does."""
    rng, entries, moved = np.random.default_rng(SEED), dataset.episodes(), {}
    for k in _chosen(dataset):
        label = dataset.labels.head(entries[k].uuid).label
        turn, by_mm = rng.uniform(0, 2 * np.pi), float(rng.uniform(*WRONG_MM))
        at = label.offset_mm + by_mm * np.array([np.cos(turn), np.sin(turn)])
        x_um, y_um = np.rint(1e3 * at).astype(int).tolist()
        moved[entries[k].uuid] = Label(x_um, y_um, label.theta_mdeg, label.sigma_um)
    return moved


def _of_the_next(dataset: Dataset) -> Wrong:
    """Give an episode the label of another of its pair, as a slip by one row does."""
    entries, swapped = dataset.episodes(), {}
    for k in _chosen(dataset):
        other = next(e for e in (*entries[k + 1 :], *entries[:k]) if e.bottom == entries[k].bottom)
        swapped[entries[k].uuid] = dataset.labels.head(other.uuid).label
    return swapped


def _precision(dataset: Dataset, wrong: set[str], count: int, kind: str) -> list[Figure]:
    """Return the share of wrong labels in the first 100 of each queue."""
    base = len(wrong) / count
    figures = []
    for queue in (*SCORES, "audit"):
        first = dataset.queue(queue, "zoe", seed=SEED, limit=FIRST)
        hits = sum(uuid in wrong for uuid in first)
        share = hits / max(len(first), 1)
        note = f"{hits} of {len(wrong)} wrong labels in the first {len(first)} of {count}"
        why = NOT_FOR_ERRORS.get(queue)
        ok = None if why else share > base
        target = f"stated ({why})" if why else f"> {100 * base:.1f} (base rate)"
        name = f"queue {queue}, labels {kind} in the first {FIRST}"
        figures.append(Figure(name, 100 * share, "%", target, ok, note))
    return figures


def _badges(dataset: Dataset, wrong: Wrong) -> list[Figure]:
    """Return the shares of wrong and right labels with a badge: by the others, by model alone."""
    rows = dataset.database.rows("SELECT name, episode, value FROM score")
    found = {(name, uuid): value for name, uuid, value in rows}
    uuids = [entry.uuid for entry in dataset.episodes()]
    figures = []
    for by, name, power in (("other episodes", "doubt", 0.5), ("model alone", "disagreement", 1)):
        badged = {u: found[name, u] ** power > NOTABLE_SIGMAS for u in uuids if (name, u) in found}
        bad = [is_badged for uuid, is_badged in badged.items() if uuid in wrong]
        good = [is_badged for uuid, is_badged in badged.items() if uuid not in wrong]
        hits, false = (100 * float(np.mean(one)) for one in (bad, good))
        note = f"{by}, no scene camera; of {len(bad)} off by 1 to 3 mm"
        figures += [
            at_least(f"wrong labels badged by {by}", hits, "%", 95, note),
            at_most(f"right labels badged by {by}", false, "%", 5, f"{len(good)}"),
        ]
    return figures
