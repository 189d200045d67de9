"""The window at the Collect half, on the stand-in bench and a real dataset."""

import shutil

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest

from tests.app.conftest import opened, settle
from tests.app.label.conftest import make_episode
from tests.app.stand_in import StandInBench
from touchdown.backend.annotations import Dataset, EpisodeContext, Label
from touchdown.backend.core.events import CampaignBegan, ProbeCollected, RunStarted
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.requests import RunState

KEY = Qt.Key
PROBES = 6
CAMPAIGN = "01900000-0000-7000-8000-000000000000"


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """A dataset of six probes of a pot on a disc."""
    folder, catalogue = tmp_path_factory.mktemp("collected") / "dataset", load_pieces()
    with Dataset.open(folder, person="setup") as dataset:
        pair = dataset.geometry.store_pair(catalogue.piece("pot"), catalogue.piece("circle15"))
        for seed in range(PROBES):
            episode = make_episode(seed)
            x_um, y_um = np.rint(1e3 * episode.offset_mm).astype(int).tolist()
            context = EpisodeContext("s", "circle15", pair, "setup", "g1", "m1", plan_item=seed,
                                     campaign=CAMPAIGN)  # fmt: skip
            label = Label(x_um, y_um, 0, 150)
            dataset.record(episode, label, source="measured", context=context)
    return folder


class Page:
    """The window at the Collect half, used by keys and clicks."""

    def __init__(self, main, bench, qtbot):
        self.main, self.bench, self._qtbot = main, bench, qtbot
        self.workspace = main.workspaces["collect"]
        self.view, self.presenter = self.workspace.collect_page, self.workspace.presenter

    @property
    def uuids(self):
        return [row.uuid for row in reversed(self.view.table.rows())]

    def press(self, key, modifiers=Qt.KeyboardModifier.NoModifier):
        QTest.keyClick(self.main.window.windowHandle(), key, modifiers)

    def settle(self):
        self._qtbot.waitUntil(lambda: not self.workspace.reader.busy, timeout=60_000)
        settle(self.main)

    def tell(self, *facts):
        for fact in facts:
            self.bench.events.publish(fact)
        settle(self.main)
        self.settle()

    def begin(self):
        self.bench.set_state(RunState.RUNNING)
        self.tell(
            RunStarted(
                0.0, "run", "pot", "circle15", "random", 0, 1, True, "{}", activity="collect"
            ),
            CampaignBegan(0.0, "campaign", "s", "dataset", 2, 20),
        )

    def probed(self, uuid, done=3):
        self.tell(
            ProbeCollected(1.0, uuid, 0, 1, done, 20, (1.0, 2.0), (1.0, 2.0), 0.15,
                           (1.0, 2.0, 0.1, 0.2, 7.0), 0.01, 0.0, ""),
        )  # fmt: skip


@pytest.fixture
def unnamed(qapp, qtbot, collected, isolated_settings, tmp_path):
    place = isolated_settings / "data" / "dataset"
    shutil.copytree(collected, place)
    bench = StandInBench()
    with opened(tmp_path, bench, active=True) as main:
        made = Page(main, bench, qtbot)
        made.press(KEY.Key_2, Qt.KeyboardModifier.ControlModifier)
        yield made


@pytest.fixture
def page(unnamed, qtbot):
    made = unnamed
    made.press(KEY.Key_U, Qt.KeyboardModifier.ControlModifier)
    assert made.view.target.person.hasFocus()
    QTest.keyClicks(made.view.target.person, "Ann")
    made.press(KEY.Key_Return)
    qtbot.waitUntil(made.view.hasFocus, timeout=60_000)
    workspace = made.workspace.label
    qtbot.waitUntil(lambda: workspace.presenter is not None, timeout=60_000)
    made.settle()
    return made
