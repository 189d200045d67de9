"""A window on a dataset of its own, driven by keys alone."""

from __future__ import annotations

import shutil
import threading
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication

from tests.app.conftest import opened
from tests.app.stand_in import REST
from touchdown.app.application import TouchdownApp
from touchdown.backend.annotations import Dataset, EpisodeContext, Label
from touchdown.backend.core.values import (
    FINGERS,
    Episode,
    EpisodeQuality,
    MarkerField,
    Recording,
    TactileFrame,
)
from touchdown.backend.geometry.pieces import load_pieces

ITEMS = 54
WITHOUT_LABEL = 4  # number of the newest episodes without a displacement
KEY = Qt.Key
CTRL, SHIFT = Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.ShiftModifier
NONE = Qt.KeyboardModifier.NoModifier


def make_episode(seed: int, frames: int = 3) -> Episode:
    """Return a probe with so many frames a finger; without frames it has no native signals."""
    rng = np.random.default_rng(seed)
    films, fields = [], []
    for k in range(frames):
        for finger in FINGERS:
            t_s = 1.0 + 0.04 * k + (0.013 if finger == "right" else 0.0)
            image = np.full((240, 320, 3), 60 + (20 * k) % 160, np.uint8)
            films.append(TactileFrame(finger, k, t_s, image))
            shift = rng.normal(0, 2, (63, 2))
            state = np.zeros(63, np.uint8)
            fields.append(MarkerField(finger, k, t_s, REST + shift, shift, state, 1.0))
    t_s = 0.9 + 0.01 * np.arange(220)
    wrench = rng.normal(0, 0.1, (220, 6))
    recording = Recording(
        t_s, wrench, tuple(fields), tuple(films), t_s[:5], np.zeros((5, 3)), np.zeros(6)
    )
    quality = EpisodeQuality(True, (), 0, 0.0, 0, 5.0, 0.01)
    observation = rng.normal(0, 1, (20, 258)).astype(np.float32)
    return Episode(f"e{seed}", "pot", observation, rng.normal(0, 4, 2), 1.0, quality,
                   recording if frames else None)  # fmt: skip


@pytest.fixture(scope="session")
def template(tmp_path_factory) -> Path:
    """A dataset of probes of a pot on a disc, as a campaign leaves it."""
    folder, catalogue = tmp_path_factory.mktemp("labels") / "dataset", load_pieces()
    with Dataset.open(folder, person="setup") as dataset:
        pair = dataset.geometry.store_pair(catalogue.piece("pot"), catalogue.piece("circle15"))
        context = EpisodeContext("series", "circle15", pair, "setup", "g1", "m1")
        for seed in range(ITEMS):
            episode = make_episode(seed)
            x_um, y_um = np.rint(1e3 * episode.offset_mm).astype(int).tolist()
            label = Label(x_um, y_um, 0, 300)
            if seed >= ITEMS - WITHOUT_LABEL:
                label = Label()
            dataset.record(episode, label, source="commanded", context=context)
    return folder


class Desk:
    """One window, used as a person uses it."""

    def __init__(self, main: TouchdownApp, qtbot) -> None:
        self.main, self._qtbot = main, qtbot
        self.workspace = main.workspaces["collect"].label
        main.workspaces["collect"].page.bring("label")
        self.page = self.workspace.label_page

    @property
    def book(self):
        return self.workspace.presenter.book

    @property
    def now(self):
        return self.workspace.presenter.present

    @property
    def uuid(self):
        return self.now.item.entry.uuid

    @property
    def saving(self):
        return self.workspace.presenter.saving

    def open(self) -> None:
        with self._qtbot.waitActive(self.main.window, timeout=60_000):
            self.main.window.show()
            self.main.window.activateWindow()
        self.press(KEY.Key_2, CTRL)

    def press(self, key, modifiers=NONE) -> None:
        QTest.keyClick(self.main.window.windowHandle(), key, modifiers)

    def type(self, text: str) -> None:
        for letter in text:
            self.press(ord(letter.upper()) if letter.isalnum() else PUNCTUATION[letter])

    def settle(self) -> None:
        """Wait until everything that was asked for is done."""
        self._qtbot.waitUntil(self.is_quiet, timeout=60_000)

    def is_quiet(self) -> bool:
        QApplication.processEvents()
        p = self.workspace.presenter
        return p is not None and not p.saving.busy and not p.editing.waits and p.walk.begun

    def do(self, *keys) -> None:
        """Press keys one after the other, each after the one before has had its effect."""
        for key in keys:
            self.press(*key) if isinstance(key, tuple) else self.press(key)
            self.settle()

    def enter_as(self, person: str) -> None:
        """Change the person with the keyboard."""
        self.press(KEY.Key_U, CTRL)
        for letter in person:
            QTest.keyClicks(QApplication.focusWidget(), letter)
        self.press(KEY.Key_Return)
        self.settle()


PUNCTUATION = {",": KEY.Key_Comma, "-": KEY.Key_Minus, ".": KEY.Key_Period}


@pytest.fixture
def folder(template, isolated_settings) -> Path:
    """The dataset that the window opens by itself."""
    place = isolated_settings / "data" / "dataset"
    shutil.copytree(template, place)
    return place


@pytest.fixture
def start(qapp, qtbot, folder, tmp_path):
    """Return what starts the application anew, as after a restart of the computer."""
    with ExitStack() as running:

        def begin(person: str = "Ann", sigma_mm: float | None = 0.2) -> Desk:
            running.close()
            desk = Desk(running.enter_context(opened(tmp_path)), qtbot)
            desk.workspace.recall({"person": person, "sigma_mm": sigma_mm})
            desk.open()
            if person:
                desk.settle()
            return desk

        yield begin


@pytest.fixture
def desk(start) -> Desk:
    """The window with Ann at the first item of the queue."""
    return start()


@pytest.fixture
def hold_saves(monkeypatch):
    """Return what holds the thread of the saves back until it is told to go on."""
    gate = threading.Event()

    def hold(desk: Desk):
        desk.workspace.worker.submit(gate.wait, lambda _: None, lambda _: None)
        return gate.set

    yield hold
    gate.set()
