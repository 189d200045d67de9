"""The Collect half on the stand-in bench and a real dataset: form, keys, facts, what is shown."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PySide6.QtCore import QPoint, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QMenu

from app.application import TouchdownApp
from app.collect.origin import note_of
from app.error_hooks import ErrorBox
from backend.catalogue.dataset import Dataset
from backend.catalogue.values import EpisodeContext, EpisodeFilter, Label
from backend.core.facts import (
    CampaignBegan,
    DecisionAwaited,
    EpisodeDecided,
    HandOverAwaited,
    OriginChecked,
    ProbeCollected,
    RunFinished,
    RunStarted,
)
from backend.dataset.coverage import coverage
from backend.objects.catalogue import load_catalogue
from backend.runs.campaign import new_campaign
from backend.runs.requests import CollectRequest, RunState
from tests.app.conftest import settle
from tests.app.label.conftest import make_episode
from tests.app.stand_in import StandInBench
from widgets.distribution_view import NEAR_PX
from widgets.episode_table import DOWN, HEADS, Arrangement

KEY = Qt.Key
PROBES = 6
CAMPAIGN = "01900000-0000-7000-8000-000000000000"


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """A dataset of six probes of a pot on a disc."""
    folder, catalogue = tmp_path_factory.mktemp("collected") / "dataset", load_catalogue()
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
            self.bench.hub.publish(fact)
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
    main = TouchdownApp(qapp, ErrorBox(), tmp_path / "window.json", tmp_path / "runs")
    main.attach(bench)
    with qtbot.waitActive(main.window, timeout=60_000):
        main.window.show()
        main.window.activateWindow()
    made = Page(main, bench, qtbot)
    made.press(KEY.Key_2, Qt.KeyboardModifier.ControlModifier)
    yield made
    main.close()
    main.window.deleteLater()
    main.deleteLater()
    QApplication.processEvents()


@pytest.fixture
def page(unnamed, qtbot):
    made = unnamed
    made.press(KEY.Key_U, Qt.KeyboardModifier.ControlModifier)
    assert made.view.target.person.hasFocus()
    QTest.keyClicks(made.view.target.person, "Ann")
    QTest.keyClick(made.view.target.person, KEY.Key_Return)
    made.view.setFocus()
    workspace = made.workspace.label
    qtbot.waitUntil(lambda: workspace.presenter is not None, timeout=60_000)
    made.settle()
    return made


def test_start_hands_over_the_form_and_the_dataset(page):
    target = page.view.target
    target.count.setValue(7)
    target.per_grip.setValue(3)
    target.within.setValue(4.0)
    target.pattern.setCurrentIndex(target.pattern.findData("grid"))
    target.ask.setChecked(False)
    page.press(KEY.Key_F5)
    assert page.bench.started == [
        CollectRequest("pot", "circle15", 7, 0, "grid", "Ann", 4.0, probes_per_grip=3)
    ]
    assert page.bench.dataset is page.presenter.dataset
    page.press(KEY.Key_F5)
    assert len(page.bench.started) == 1


def test_the_first_range_is_any_displacement(page):
    page.press(KEY.Key_F5)
    (asked,) = page.bench.started
    assert asked.within_mm is None
    assert asked.ask


def test_the_dataset_is_shown_before_anybody_is_named(unnamed, qtbot):
    page = unnamed
    qtbot.waitUntil(lambda: page.presenter.dataset is not None, timeout=60_000)
    page.settle()
    assert page.presenter.person == ""
    assert len(page.uuids) == PROBES
    assert len(page.view.distribution.scene.points_mm) == PROBES
    assert not page.presenter.dataset.writable
    page.press(KEY.Key_F5)
    assert page.bench.started == []


def test_a_pair_without_episodes_shows_its_bottom(unnamed):
    target = unnamed.view.target
    target.bottom.setCurrentIndex(target.bottom.findData("circle25"))
    unnamed.settle()
    assert len(unnamed.view.coverage.scene.bottom)
    assert unnamed.view.table.rows() == []


def test_each_half_has_its_own_key(page):
    both = Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier
    page.press(KEY.Key_L, both)
    assert page.workspace.page.front == "label"
    page.press(KEY.Key_C, both)
    assert page.workspace.page.front == "collect"


def test_nobody_cannot_start(page):
    page.presenter.person = ""
    settle(page.main)
    assert not page.view.target.start.isEnabled()
    assert page.view.target.start.toolTip().startswith("Say who collects")
    assert page.view.target.why_not.isVisible()
    assert page.view.target.why_not.text() == f"{page.view.target.start.toolTip()}."


def test_maps_and_table_show_what_the_dataset_holds(page):
    dataset = page.presenter.dataset
    entries = dataset.episodes(EpisodeFilter())
    truth = [dataset.labels.head(e.uuid).label.offset_mm for e in entries]
    assert page.uuids == [e.uuid for e in entries]
    scene = page.view.distribution.scene
    np.testing.assert_allclose(scene.points_mm, truth)
    last = [dataset.read(e.uuid).observation[-1] for e in entries]
    page.view.signal.setCurrentIndex(4)
    settle(page.main)
    shown = page.view.distribution.scene
    np.testing.assert_allclose(shown.values, [row[254] for row in last], rtol=1e-6)
    catalogue = load_catalogue()
    faces = (catalogue.piece("pot").face, catalogue.piece("circle15").face)
    counts = coverage(np.array(truth), *faces).counts
    np.testing.assert_array_equal(page.view.coverage.scene.bins.counts, counts)
    assert counts.sum() == PROBES


def test_a_click_on_a_dot_chooses_its_episode(page):
    view = page.view.distribution
    area, points = view.area(), view.scene.points_mm
    away = np.hypot(*(points[:, None] - points).T) + 1e3 * np.eye(len(points))
    at = int(away.min(axis=1).argmax())
    spot = QPoint(round(area.x(points[at, 0])), round(area.y(points[at, 1])))
    QTest.mouseClick(view, Qt.MouseButton.LeftButton, pos=spot)
    settle(page.main)
    assert page.presenter.probes.chosen == page.uuids[at] or at == PROBES - 1
    row = page.view.table.currentIndex().row()
    assert page.view.table.rows()[row].uuid == page.uuids[at]
    edge = QPoint(round(area.rect.right() + 2 * NEAR_PX), 4)
    QTest.mouseClick(view, Qt.MouseButton.LeftButton, pos=edge)
    settle(page.main)
    assert page.view.table.rows()[page.view.table.currentIndex().row()].uuid == page.uuids[at]


@pytest.mark.parametrize(
    ("key", "decision"),
    [(KEY.Key_Return, "keep"), (KEY.Key_Backspace, "discard"), (KEY.Key_X, "flag"),
     (KEY.Key_R, "redo"), (KEY.Key_S, "skip"), (KEY.Key_F5, "keep")],
)  # fmt: skip
def test_one_key_answers_for_the_last_probe(page, key, decision):
    page.begin()
    newest = page.uuids[-1]
    page.probed(newest)
    page.tell(DecisionAwaited(1.0, newest, 0))
    assert page.view.probe.detail.text() == "waiting for you"
    page.press(key)
    assert page.bench.decisions == [decision]
    assert page.bench.started == []


def test_space_and_f12_stop_while_the_question_waits(page):
    page.begin()
    page.probed(page.uuids[-1])
    page.tell(DecisionAwaited(1.0, page.uuids[-1], 0))
    page.press(KEY.Key_Space)
    assert page.bench.stops == 1
    page.press(KEY.Key_F12)
    assert page.bench.stops == 2
    assert page.bench.decisions == []


def test_an_older_probe_is_decided_in_the_dataset_and_shown(page):
    first = page.uuids[0]
    page.presenter.probes.choose(first)
    settle(page.main)
    page.press(KEY.Key_X)
    page.settle()
    dataset = page.presenter.dataset
    assert dataset.entry(first).flagged
    assert page.view.distribution.scene.flagged.sum() == 1
    page.press(KEY.Key_Backspace)
    page.settle()
    assert dataset.entry(first).deleted
    assert first not in page.uuids
    assert len(page.view.distribution.scene.points_mm) == PROBES - 1
    assert page.view.coverage.scene.bins.counts.sum() == PROBES - 1
    page.view.deleted.setChecked(True)
    settle(page.main)
    assert page.uuids[0] == first
    page.press(KEY.Key_Return)
    page.settle()
    assert not dataset.entry(first).deleted
    assert page.bench.decisions == []


def test_what_a_run_decides_is_read_again(page):
    page.begin()
    newest = page.uuids[-1]
    page.probed(newest)
    page.presenter.dataset.labels.flag("Ann", newest)
    page.tell(EpisodeDecided(1.0, newest, 0, "flag", "Ann"))
    assert page.view.distribution.scene.flagged[-1]
    assert "flagged" in page.view.probe.verdict.text()


def test_progress_pause_and_end(page):
    page.begin()
    target = page.view.target
    assert (target.bar.value(), target.bar.maximum()) == (2, 20)
    page.probed(page.uuids[-1], done=3)
    assert target.bar.value() == 3
    assert target.eta.text().startswith("17 left")
    page.press(KEY.Key_P)
    assert page.bench.engine.orders == ["pause"]
    settle(page.main)
    assert target.pause.text() == "Resume"
    target.end.click()
    page.tell(RunFinished(2.0, "run", "cancelled", "cancelled by the operator"))
    assert page.bench.engine.orders == ["pause", "cancel"]
    assert target.start.isEnabled()
    assert target.eta.text() == "cancelled by the operator"


def test_the_bar_counts_no_probe_that_was_discarded(page):
    page.begin()
    bar, dataset = page.view.target.bar, page.presenter.dataset
    older, newest = page.uuids[-2:]
    page.probed(newest, done=3)
    page.tell(EpisodeDecided(1.0, newest, 0, "flag", "Ann"))
    assert bar.value() == 3
    page.tell(EpisodeDecided(1.0, newest, 0, "discard", "Ann"))
    assert bar.value() == 2
    # An older one is discarded beside the run, which goes on counting it.
    page.presenter._progress.campaign = CAMPAIGN
    page.presenter.probes.choose(older)
    page.press(KEY.Key_Backspace)
    page.settle()
    assert dataset.entry(older).deleted
    assert bar.value() == 1
    page.press(KEY.Key_Return)
    page.settle()
    assert not dataset.entry(older).deleted
    assert bar.value() == 2


def test_after_a_campaign_the_focus_is_on_the_page(page):
    target = page.view.target
    target.start.setFocus()
    page.begin()
    assert page.view.hasFocus()
    page.bench.set_state(RunState.IDLE)
    page.tell(RunFinished(2.0, "run", "finished", "done"))
    assert page.view.hasFocus()


def test_a_person_who_types_keeps_the_focus(page):
    page.press(KEY.Key_U, Qt.KeyboardModifier.ControlModifier)
    page.bench.set_state(RunState.RUNNING)
    settle(page.main)
    assert not page.view.target.start.isEnabled()
    assert page.view.target.person.hasFocus()


def test_a_discarded_probe_can_be_collected_again_without_a_restart(page):
    dataset = page.presenter.dataset
    plan = new_campaign("pot", "circle15", "random", 0, PROBES, None)
    replace(plan, uuid=CAMPAIGN).save(dataset.folder)
    page.presenter._read_campaign()
    page.settle()
    target = page.view.target
    assert (target.bar.value(), target.bar.maximum()) == (PROBES, PROBES)
    assert not target.go_on.isEnabled()
    page.presenter.probes.choose(page.uuids[0])
    page.press(KEY.Key_Backspace)
    page.settle()
    assert target.bar.value() == PROBES - 1
    assert target.go_on.isEnabled()


def test_the_list_is_sorted_by_a_click_and_its_columns_are_chosen_and_remembered(page, qtbot):
    table, head = page.view.table, page.view.table.horizontalHeader()
    page.presenter.probes.choose(page.uuids[1])
    settle(page.main)

    def click(column):
        at = QPoint(head.sectionViewportPosition(column) + 8, head.height() // 2)
        QTest.mouseClick(head.viewport(), Qt.MouseButton.LeftButton, pos=at)

    click(3)
    away = [row.distance_mm for row in table.rows()]
    assert away == sorted(away)
    click(3)
    assert [row.distance_mm for row in table.rows()] == away[::-1]
    assert table.chosen() == page.presenter.probes.shown
    said = [table.model().headerData(k, Qt.Orientation.Horizontal, Qt.ItemDataRole.DisplayRole)
            for k in range(len(HEADS))]  # fmt: skip
    assert said == [*HEADS[:3], f"{HEADS[3]} {DOWN}", *HEADS[4:]]
    assert table.isColumnHidden(HEADS.index("Person"))
    table.choose_columns()
    menu = table.findChild(QMenu)
    for name in ("Person", "Time"):
        next(a for a in menu.actions() if a.text() == name).trigger()
    menu.close()
    assert not table.isColumnHidden(HEADS.index("Person"))
    assert {row.cells()[-1] for row in table.rows()} == {"setup"}
    memory = page.workspace.memory()
    table.arrange(Arrangement())
    assert page.workspace.recall(memory) == []
    assert table.arrangement == Arrangement(
        (*HEADS[:4], "Person"), sort="x, y (mm)", descending=True
    )
    assert page.workspace.recall({**memory, "list": {"columns": ["Mood"]}}) == ["list"]
    for column in range(len(HEADS)):
        table.show_column(column, shown=False)
    assert not all(table.isColumnHidden(column) for column in range(len(HEADS)))


def test_the_check_of_the_origin_is_dated_used_once_and_remembered(page, qapp, tmp_path):
    page.begin()
    page.tell(OriginChecked(1.0, (0.25, -0.5), 0.11, True))
    target = page.view.target
    assert "x +0.25, y \N{MINUS SIGN}0.50" in target.residual.text()
    assert not target.take.isEnabled() or page.presenter.origin.note is not None
    page.bench.set_state(RunState.IDLE)
    page.tell(RunFinished(2.0, "run", "finished", "done"))
    target.take.click()
    target.take.click()
    assert (target.origin[0].value(), target.origin[1].value()) == (0.25, -0.5)
    assert note_of(page.workspace.memory()["origin"]) == page.presenter.origin.note


def test_the_origin_is_set_where_the_arm_was_jogged_to(page):
    page.begin()
    page.tell(OriginChecked(1.0, (0.25, -0.5), 0.11, True))
    page.bench.set_state(RunState.IDLE)
    page.tell(RunFinished(2.0, "run", "finished", "done"))
    page.bench.turn(0.08)
    (x_mm, y_mm, _), target = page.bench.devices["arm"].poses.since(0).values[-1], page.view.target
    target.here.click()
    assert [field.value() for field in target.origin] == [x_mm, y_mm]
    # A check of another origin says nothing about this one.
    assert page.presenter.origin.note is None
    page.bench.turn(3.0)
    page.bench.devices["arm"].poses.clear()
    target.origin[0].setValue(7.0)
    target.here.click()
    assert target.origin[0].value() == 7.0


def test_in_contact_nothing_starts_and_a_lift_is_offered(page):
    steps = []
    jog = SimpleNamespace(step=lambda *asked: steps.append(asked), active=False)
    page.bench.hand = SimpleNamespace(
        pressing_n=3.0, active=False, powered=True, switching=False, holding=True, jog=jog
    )
    settle(page.main)
    target = page.view.target
    assert not target.start.isEnabled()
    assert target.why_not.text() == "In contact: lift first."
    assert target.lift.isVisible()
    target.lift.click()
    assert steps == [("z", "XYZ", 5.0, 5.0)]
    page.bench.hand.pressing_n = 0.0
    settle(page.main)
    assert target.start.isEnabled()
    assert not target.lift.isVisible()
    page.bench.hand = None


def test_a_hand_at_the_jaws_is_asked_for_and_confirmed_by_f5(page):
    target = page.view.target
    target.hand_over.setChecked(True)
    page.press(KEY.Key_F5)
    assert page.bench.started[0].hand_over
    page.begin()
    page.tell(HandOverAwaited(0.5, "pot", gives=True))
    assert target.why_not.text() == "Hold the pot between the jaws: they close on it."
    assert (target.start.text(), target.start.isEnabled()) == ("Confirm", True)
    page.press(KEY.Key_F5)
    assert page.bench.answers == [True]
    settle(page.main)
    assert (target.start.text(), target.start.isEnabled()) == ("Start collecting", False)
    page.press(KEY.Key_F5)
    assert page.bench.answers == [True]
    assert len(page.bench.started) == 1


def test_keys_of_one_half_do_nothing_in_the_other(page):
    page.workspace.page.show_half("label")
    page.settle()
    page.press(KEY.Key_F5)
    page.press(KEY.Key_P)
    assert page.bench.started == []
    before = {e.uuid: e.state for e in page.presenter.dataset.episodes()}
    page.workspace.page.show_half("collect")
    for key in (KEY.Key_Left, KEY.Key_D, KEY.Key_PageDown, KEY.Key_V):
        page.press(key)
    page.settle()
    assert {e.uuid: e.state for e in page.presenter.dataset.episodes()} == before


def test_no_key_of_the_workspace_clashes(page):
    keys = [row.key for row in page.main.actions.rows if row.context == "collect" and row.key]
    assert len(keys) == len(set(keys))
    names = [row.id for row in page.main.actions.rows if row.command is not None]
    assert len(names) == len(set(names))
