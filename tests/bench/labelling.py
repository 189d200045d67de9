"""Figures of the label page: how soon the next episode is painted, a nudge, an accepted label."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from tests.bench.registry import Figure, figure

EPISODES, FILMED = 10_000, 120
"""The queue is long; those that are looked at have films of 2 s."""
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
    """Make the dataset; nothing has to survive a crash here, so nothing is synced."""
    from tests.app.label.conftest import make_episode
    from touchdown.backend.annotations.dataset import Dataset
    from touchdown.backend.annotations.values import EpisodeContext, Label
    from touchdown.backend.geometry.pieces import load_pieces

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
    from PySide6.QtWidgets import QApplication

    from touchdown.app.application import TouchdownApp
    from touchdown.app.shell.errors import ErrorBox
    from touchdown.app.start import THREAD_SWITCH_S

    sys.setswitchinterval(THREAD_SWITCH_S)
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
    from PySide6.QtTest import QTest

    application, window, workspace = _opened(folder)

    def until(done: Callable[[], bool]) -> None:
        end_s = time.monotonic() + 120
        while not done() and time.monotonic() < end_s:
            QTest.qWait(1)

    until(lambda: workspace.presenter is not None and workspace.presenter.present is not None)
    p = workspace.presenter

    def ready() -> bool:
        ahead = p.walk.order[p.walk.at + 1]
        return ahead in p.walk.held() and not p.saving.busy

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
        looks.append(timed(lambda want=want: p.go_to(want), _now))  # type: ignore[misc]
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
            workspace.decisions.enter,
            lambda before=before: p.present.item.entry.uuid != before,  # type: ignore[misc]
        ))  # fmt: skip
        working.append(1e3 * (time.thread_time() - start_s))
    held = sum(p.walk.size(uuid) for uuid in p.walk.held())
    window.close()
    note = f"{len(p.walk.order)} episodes, offscreen"
    next_ms, nudge_ms = (float(np.percentile(v, 95)) for v in (looks, nudges))
    return [
        Figure("next episode painted, p95", next_ms, "ms", "<= 50", next_ms <= 50, note),
        *_stated("next episode painted", looks, (50,), note),
        *_stated("next episode, processor time of the window's thread", busy, (50, 95), note),
        Figure("patch, hull and verdict of a nudge, p95", nudge_ms, "ms", "<= 5", nudge_ms <= 5,
               note),
        *_stated("accept saved and next painted", accepted, (50, 95), note),
        *_stated("accept and next, processor time of the window's thread", working, (50, 95), note),
        Figure("episodes read ahead", held / 1e6, "MB", "<= 50", held <= 50e6, note),
    ]  # fmt: skip


def _stated(name: str, times_ms: list[float], shares: tuple[int, ...], note: str) -> list[Figure]:
    """Return percentiles that have no target of their own."""
    return [
        Figure(f"{name}, p{share}", float(np.percentile(times_ms, share)), "ms", "stated", None,
               note)
        for share in shares
    ]  # fmt: skip


def _now() -> bool:
    return True
