"""Several models pre-label together: chosen by a folder, named in the source of what is taken."""

from __future__ import annotations

import sys
import threading
from dataclasses import replace
from datetime import datetime
from importlib.metadata import files, packages_distributions
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import QApplication

from tests.app.label.conftest import CTRL, ITEMS, KEY, SHIFT, WITHOUT_LABEL
from tests.import_contracts import imports
from touchdown.app.label.editing import ViewingTimer
from touchdown.app.label.page import EMPTY_QUEUE, LabelPage
from touchdown.app.label.presenter import group_findings, health_text
from touchdown.app.label.text import evidence_badges, model_evidence_text, scene_evidence_text
from touchdown.app.shell.actions import portable_key
from touchdown.app.shell.label_items import LabelDraft, ModelLabel, SceneObservation, scene_shots
from touchdown.backend.annotations import Label, QualityReport
from touchdown.backend.bench.assembly import shipped_model
from touchdown.backend.episodes.quality import QualityIssue
from touchdown.backend.learning.checkpoint import load_checkpoint, save_checkpoint
from touchdown.backend.placement.estimator import OffsetFit
from touchdown.backend.sensing.scene_camera import Homography


@pytest.fixture
def models(tmp_path):
    """A folder with the shipped model of the pot and two that differ a little."""
    folder, shipped = tmp_path / "seeds", load_checkpoint(shipped_model("pot"))
    folder.mkdir()
    rng = np.random.default_rng(3)
    for number, by in enumerate((0.0, 0.02, 0.02)):
        arrays = {
            name: (values * (1 + by * rng.normal(size=values.shape))).astype(np.float32)
            for name, values in shipped.arrays.items()
        }
        save_checkpoint(folder / f"seed-{number}.safetensors", arrays, shipped.card)
    return folder


def choose(desk, qtbot, words, said):
    desk.workspace.tools.tasks.choose_models()
    desk.page.words.setText(words)
    desk.press(KEY.Key_Return)
    qtbot.waitUntil(lambda: said in desk.page.message.text(), timeout=60_000)
    desk.settle()


def test_models_of_a_folder_pre_label_together(desk, qtbot, models):
    uuid, alone = desk.uuid, desk.now.item.model
    choose(desk, qtbot, str(models), "3 models of pot pre-label together.")
    assert desk.uuid == uuid
    together = desk.now.item.model
    assert len(together.weights.split("+")) == 3
    assert alone.weights in together.weights
    assert together.spread_mm > 0.0
    assert "and 2 more" in desk.page.model_line.text()
    assert "they differ by" in desk.page.model_line.text()
    desk.do(KEY.Key_M)
    head = desk.book.head(uuid)
    assert head.source == together.source
    assert head.label.sigma_um == round(1e3 * together.fit.sigma_mm)
    choose(desk, qtbot, "-", "The model in use pre-labels pot.")
    assert desk.now.item.model.weights == alone.weights


def test_a_folder_without_models_is_refused(desk, qtbot, tmp_path):
    before = desk.now.item.model.weights
    choose(desk, qtbot, str(tmp_path / "nowhere"), "There is no model of 'pot'")
    assert desk.now.item.model.weights == before


LABELLED = ITEMS - WITHOUT_LABEL
ALT = Qt.KeyboardModifier.AltModifier

BY_KEYS = {
    "row_chosen": ("previous", "next", "first", "last", "number"),
    "queue_chosen": ("queue",),
    "face_dragged": ("nudge-left-10", "nudge-right-100", "nudge-up-1000", "nudge-down-100"),
    "face_dropped": ("nudge-left-10",),
    "version_chosen": ("versions",),
    "displacement_typed": ("accept",),
    "key_typed": ("accept",),
    "retry_requested": ("accept",),
    "discard_requested": ("discard",),
    "search_changed": ("log",),
    "person_requested": ("person",),
    "command_requested": ("queue", "score", "person", "next"),
    "tab_chosen": ("versions", "agreement", "log", "bulk", "health"),
    "preview_requested": ("bulk",),
    "apply_requested": ("bulk",),
    "value_entered": ("bulk",),
    "health_requested": ("health",),
    "finding_chosen": ("findings",),
    "filter_typed": ("filter",),
    "filter_kept": ("keep-filter",),
}
"""What a mouse can ask of the page, and the commands that ask for the same."""
BY_HAND = {"play"}  # Space: the page takes it, a stop of the bench goes first


@pytest.mark.promise("W11")
def test_every_signal_of_the_page_and_every_command_has_a_key(desk):
    commands = {c.name: c for c in desk.workspace.commands}
    assert set(BY_KEYS) == {
        name for name, value in vars(LabelPage).items() if isinstance(value, Signal)
    }
    assert {name for names in BY_KEYS.values() for name in names} <= set(commands)
    assert {name for name, c in commands.items() if not c.key} == BY_HAND
    assert all(portable_key(c.key) for c in commands.values() if c.key)


def test_other_views_pictures_and_curves_come_by_keys(desk):
    desk.do(KEY.Key_E)
    assert front(desk) == 1
    assert "No two people" in desk.page.side.agreement.text()
    page = desk.page
    desk.do(KEY.Key_I)
    assert page.shots.isVisible()
    assert not page.film.isVisible()
    desk.do(KEY.Key_I)
    assert page.film.isVisible()
    desk.press(KEY.Key_W)
    popup = QApplication.activePopupWidget()
    assert popup is not None
    popup.close()
    desk.do(KEY.Key_X)
    assert desk.workspace.presenter.walk.entries[desk.uuid].flagged


def test_the_main_acts_have_buttons_with_their_keys(desk):
    texts = [button.text() for button in desk.page.acts]
    assert texts == [
        "Accept  (Enter)", "Accept grip  (K)", "Reject  (D)", "Flag  (X)",
        "Skip  (PgDown)",
    ]  # fmt: skip
    accept, whole_grip, reject = desk.page.acts[:3]
    assert (accept.property("role"), reject.property("role")) == ("primary", None)
    reject.click()
    assert desk.page.choice.isVisible()
    accept.click()
    assert not desk.page.choice.isVisible()
    assert whole_grip.isEnabled()
    desk.page.show_queue("review")
    assert accept.text() == "Approve  (Enter)"
    assert not whole_grip.isEnabled()
    desk.page.show_nothing(EMPTY_QUEUE)
    assert not accept.isVisible()


def front(desk):
    return desk.page.side.tab


def test_an_earlier_version_comes_back_by_its_digit_but_is_not_told_blind(desk):
    uuid, first = desk.uuid, desk.book.head(desk.uuid)
    desk.do(KEY.Key_O)
    assert "no earlier version" in desk.page.message.text()
    desk.do(KEY.Key_Up)
    desk.press(KEY.Key_E)  # another view: the question brings the versions to the front
    desk.do(KEY.Key_O)
    assert front(desk) == 0
    assert desk.page.choice.isVisible()
    desk.do(KEY.Key_1)
    head = desk.book.head(uuid)
    assert (head.label, head.source) == (first.label, first.source)
    assert len(desk.book.history(uuid)) == 3
    desk.workspace.session.queue = "gold"
    desk.do(KEY.Key_O)
    assert not desk.page.choice.isVisible()
    assert "No versions" in desk.page.message.text()


def test_many_labels_change_by_keys_and_back_by_one(desk):
    uuids = desk.workspace.presenter.walk.order
    before = {u: desk.book.head(u).label for u in uuids}
    desk.do(KEY.Key_B, KEY.Key_1)
    assert front(desk) == 3
    desk.type("0.5,-0.25")
    assert desk.page.bulk.value.text() == "0.5,-0.25"
    desk.do(KEY.Key_Return)
    assert {u: desk.book.head(u).label for u in uuids} == before
    assert desk.page.choice.accessibleName() == f"{LABELLED} labels will change."
    stay = f"{WITHOUT_LABEL} labels will stay. Reason: It has no offset."
    assert stay in desk.page.bulk.found.text()
    desk.do(KEY.Key_1)
    head = desk.book.head(uuids[0])
    first = head.label
    assert (first.x_um, first.y_um) == (before[uuids[0]].x_um + 500, before[uuids[0]].y_um - 250)
    assert head.source == "commanded"
    assert sum(desk.book.head(u).label != before[u] for u in uuids) == LABELLED
    desk.do(KEY.Key_U)
    assert {u: desk.book.head(u).label for u in uuids} == before


def test_a_change_without_a_value_is_previewed_at_once_and_nonsense_keeps_the_line(desk):
    desk.do(KEY.Key_B, KEY.Key_4)
    assert desk.page.choice.accessibleName() == f"{LABELLED} labels will change."
    desk.do(KEY.Key_Escape, KEY.Key_Right)
    assert desk.page.bulk.apply.isEnabled()  # by whoever has a mouse
    assert desk.book.head(desk.uuid).state == "draft"
    desk.settle()
    desk.do(KEY.Key_B, KEY.Key_2)
    desk.type("x")
    desk.do(KEY.Key_Return)
    assert "Type an angle" in desk.page.bulk.found.text()
    assert QApplication.focusWidget() is desk.page.bulk.value
    desk.do(KEY.Key_Escape, KEY.Key_X)
    assert desk.workspace.presenter.walk.entries[desk.uuid].flagged


def test_the_log_is_searched_and_left_by_keys(desk, qtbot):
    desk.do(KEY.Key_Return, KEY.Key_L)
    side = desk.page.side
    assert front(desk) == 2
    desk.type("ACCEPT")
    assert side.needle.text().lower() == "accept"
    side.needle.setText("accept")
    qtbot.waitUntil(lambda: side.log.count() == 1, timeout=60_000)
    assert "Ann: accept next" in side.log.item(0).text()
    uuid = desk.uuid
    desk.do(KEY.Key_Return)  # leaves the line, decides nothing
    assert (desk.uuid, desk.book.head(uuid).state) == (uuid, "draft")
    desk.do(KEY.Key_X)
    assert desk.workspace.presenter.walk.entries[uuid].flagged


def test_lines_to_type_have_captions_and_one_takes_the_number_of_a_place(desk):
    page = desk.page
    assert not page.caption.isVisible()
    desk.press(KEY.Key_U, CTRL)
    assert page.caption.isVisible()
    assert "name" in page.caption.text()
    desk.do(KEY.Key_Escape)
    assert not page.caption.isVisible()
    desk.press(KEY.Key_U, CTRL)
    desk.workspace.be("Ann")  # said in the other half meanwhile
    desk.settle()
    assert not page.caption.isVisible()
    assert QApplication.focusWidget() is page
    desk.do(KEY.Key_3)
    assert "x,y in mm" in page.caption.text()
    desk.do(KEY.Key_Escape)
    assert not page.caption.isVisible()
    order = desk.workspace.presenter.walk.order
    desk.do(KEY.Key_End)
    assert desk.uuid == order[-1]
    assert desk.page.queue_panel.detail.text() == f"{ITEMS} of {ITEMS}"
    desk.do(KEY.Key_Home)
    assert desk.uuid == order[0]
    desk.do(KEY.Key_Q)
    assert f"1 to {ITEMS}" in desk.page.caption.text()
    desk.type("12")
    desk.do(KEY.Key_Return)
    assert desk.uuid == order[11]
    for number in ("0", "55", "x"):
        desk.do(KEY.Key_Q)
        desk.type(number)
        desk.do(KEY.Key_Return)
        assert "no number" in desk.page.message.text()
        assert desk.uuid == order[11]


class TestWhileSigmaIsAsked:
    """An arrow that is pressed meanwhile moves the face and is saved; it is never lost."""

    @pytest.fixture
    def asked(self, start):
        desk = start(sigma_mm=None)
        desk.before = desk.book.head(desk.uuid).label
        desk.do(KEY.Key_S)
        assert desk.page.choice.isVisible()
        return desk

    def test_arrows_move_the_face_and_the_answer_holds_for_what_they_set(self, asked):
        uuid, before = asked.uuid, asked.before
        at_s = asked.page.film.cursor_s
        asked.do(KEY.Key_Tab, KEY.Key_BracketLeft)
        assert asked.page.film.cursor_s < at_s  # looking closer is no answer
        for key in (KEY.Key_Right, (KEY.Key_Up, SHIFT), (KEY.Key_Left, ALT)):
            asked.do(key)
        assert asked.page.choice.marked == "0.30 mm"  # the question stands as it was
        moved = Label(before.x_um + 100 - 10, before.y_um + 1000, before.theta_mdeg, 200)
        assert asked.book.head(uuid).label == moved
        asked.do(KEY.Key_Return)
        assert asked.book.head(uuid).label == replace(moved, sigma_um=300)

    def test_what_is_left_unanswered_is_saved(self, asked):
        asked.do(KEY.Key_Right, KEY.Key_Escape)
        assert not asked.page.choice.isVisible()
        label = asked.book.head(asked.uuid).label
        assert (label.x_um, label.sigma_um) == (asked.before.x_um + 100, 200)

    def test_a_nudge_key_that_was_changed_still_moves_the_face(self, asked):
        assert asked.main.actions.change_key("collect.nudge-right-100", "Ctrl+Right") == ""
        x_um = asked.now.edit.label.x_um
        asked.do((KEY.Key_Right, CTRL))
        assert asked.now.edit.label.x_um == x_um + 100
        asked.do(KEY.Key_Right)
        assert asked.now.edit.label.x_um == x_um + 100


BOARD = Homography(np.diag([4.0, 4.0, 1.0]), 0.2)
IMAGES = (np.zeros((48, 64, 3), np.uint8),) * 2


def edit(x_mm=1.0, sigma_mm=0.15):
    label = Label(round(1e3 * x_mm), 0, 0, round(1e3 * sigma_mm))
    head = SimpleNamespace(label=label, source="measured", rev_uuid="r1")
    return LabelDraft(head, label, "measured")


def item(seen=None, model=None, pictures=True, doubt=None):
    place = None if seen is None else OffsetFit(seen, 0.12)
    scene = SceneObservation(IMAGES, BOARD, place) if pictures else None
    felt = None if model is None else ModelLabel(OffsetFit(model, 0.5), "ab" * 32)
    return SimpleNamespace(scene=scene, model=felt, doubt=doubt)


class TestBadge:
    def test_a_slip_that_the_camera_saw_is_told_in_sigmas(self):
        sigma = np.hypot(0.15, 0.12)
        assert evidence_badges(edit(1.0), item((2.0, 0.0))) == (
            f"scene {1 / sigma:.1f} \u03c3 off",
        )
        assert evidence_badges(edit(1.0), item((1.3, 0.2))) == ()

    def test_where_the_camera_measured_the_model_is_not_asked(self):
        assert evidence_badges(edit(1.0), item((1.0, 0.0), model=(9.0, 0.0))) == ()

    @pytest.mark.parametrize("pictures", [True, False])
    def test_without_a_measured_face_the_model_speaks(self, pictures):
        (badge,) = evidence_badges(edit(1.0), item(None, model=(9.0, 0.0), pictures=pictures))
        assert badge.startswith("model 15")

    def test_the_other_episodes_are_asked_before_the_model(self):
        seen = item(None, model=(9.0, 0.0), pictures=False, doubt=("r1", 16.0))
        assert evidence_badges(edit(1.0), seen) == ("signals 4.0 \u03c3 off",)
        assert (
            evidence_badges(edit(1.0), SimpleNamespace(**{**vars(seen), "doubt": ("r1", 8.0)}))
            == ()
        )
        later = edit(1.0)
        later.base.rev_uuid = "r2"
        for judged in (edit(1.0).placed(2.0, 0.0), later):
            assert evidence_badges(judged, seen)[0].startswith("model")  # another label was judged

    def test_a_label_without_displacement_has_none(self):
        blank = replace(edit(), label=Label())
        assert evidence_badges(blank, item((2.0, 0.0), model=(9.0, 0.0))) == ()


def test_the_words_say_what_was_seen_and_what_was_not():
    assert "x +2.00, y +0.00 mm \u00b1 0.12, 5.2 sigma off" in scene_evidence_text(
        edit(), item((2.0, 0.0)), hidden=False
    )
    assert "rim" in scene_evidence_text(edit(), item(), hidden=False)
    assert "No scene picture" in scene_evidence_text(edit(), item(pictures=False), hidden=False)
    assert not scene_evidence_text(edit(), item((2.0, 0.0)), hidden=True)
    assert "hidden" in model_evidence_text(edit(), item((2.0, 0.0)), hidden=True)


def test_outlines_stand_where_the_homography_puts_them_and_what_was_seen_can_be_hidden():
    square = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    scene = item((3.0, 0.0)).scene
    pressed, lifted = scene_shots(scene, edit(1.0), (square, 2 * square), hidden=False)
    kinds = {o.kind: o.points_px for o in pressed.outlines}
    assert kinds["bottom"][0].tolist() == [8.0, 8.0]
    assert kinds["label"][0].tolist() == [8.0, 4.0]
    assert kinds["scene"][0].tolist() == [16.0, 4.0]
    assert [o.kind for o in lifted.outlines] == ["bottom"]
    blind = scene_shots(scene, edit(1.0), (square, square), hidden=True)
    assert [o.kind for o in blind[0].outlines] == ["bottom", "label"]
    assert scene_shots(None, edit(), (square, square), hidden=False) == ()


@pytest.mark.promise("W13")
def test_a_deleted_episode_comes_back_with_the_same_bytes_under_the_same_id(desk):
    desk.open()
    desk.settle()
    uuid, dataset = desk.uuid, desk.workspace.presenter.dataset
    path = dataset.path(uuid)
    before = path.read_bytes()
    desk.press(KEY.Key_Delete)
    desk.type("torn")
    desk.do(KEY.Key_Return)
    assert dataset.entry(uuid).deleted
    desk.do(KEY.Key_U)
    assert not dataset.entry(uuid).deleted
    assert dataset.path(uuid) == path
    assert path.read_bytes() == before


def test_findings_are_grouped_by_kind_and_each_episode_keeps_its_words():
    kinds = group_findings([
        QualityIssue("jerk", ("a",), "It jumps by 1 N."),
        QualityIssue("twins", ("a", "b"), "Nearly the same."),
        QualityIssue("jerk", ("c",), "It jumps by 2 N."),
    ])  # fmt: skip
    assert [kind.title for kind in kinds] == ["Jerk: 2 episodes", "Twins: 2 episodes"]
    assert kinds[0].said == {"a": "It jumps by 1 N.", "c": "It jumps by 2 N."}
    assert kinds[0].first == "It jumps by 1 N."
    at = datetime(2026, 1, 1, 9, 5)
    assert health_text(QualityReport((), 1200, 1200), 0, at) == (
        "Checked 1,200 episodes at 09:05: no problems were found."
    )
    assert health_text(QualityReport((), 7, 9), 2, at).startswith("Checked 7 of 9 episodes")


def test_a_finding_opens_its_episodes_as_a_queue(desk, qtbot):
    desk.press(KEY.Key_F)
    assert "Ctrl+H" in desk.page.message.text()
    standing = desk.page.queue.currentText()
    desk.press(KEY.Key_H, CTRL)
    qtbot.waitUntil(lambda: desk.page.health.list.count() > 0, timeout=60_000)
    assert desk.page.health.isVisible()
    assert f"Checked {ITEMS} episodes" in desk.page.health.said.text()
    kinds = desk.workspace.tools.health.kinds
    at = next(k for k, kind in enumerate(kinds) if kind.name == "Jerk")
    desk.press(KEY.Key_F)
    desk.press(KEY.Key_1 + at)
    desk.settle()
    assert desk.workspace.presenter.walk.order == list(kinds[at].said)
    assert desk.page.queue.currentText() == kinds[at].title
    assert desk.page.message.text() == kinds[at].said[desk.uuid]
    first = desk.uuid
    desk.do(KEY.Key_Return)
    assert desk.book.head(first).state == "submitted"
    assert desk.page.message.text() == kinds[at].said[desk.uuid]
    assert desk.workspace.memory()["queue"] == "unlabelled"  # a finding does not outlive the window
    desk.workspace._choose_queue("unlabelled")
    desk.workspace.recall(desk.workspace.memory())
    desk.settle()
    assert desk.page.queue.currentText() == standing


def test_a_pause_of_more_than_a_minute_is_not_looking_and_each_episode_counts_for_itself():
    time_s = [100.0]
    clock = ViewingTimer(lambda: time_s[0])
    for seconds in (5.0, 60.0, 61.0, 3600.0, 2.0):
        time_s[0] += seconds
        clock.alive()
    assert clock.seen_ms() == 67_000
    clock.restart()
    time_s[0] += 3.0
    assert clock.seen_ms() == 3_000


ELSEWHERE = (
    "touchdown.app.operate.workspace",
    "touchdown.app.stack.workspace",
    "touchdown.app.train.workspace",
)
ONLINE = {"requests", "urllib3", "httpx", "aiohttp", "websockets", "socketserver", "http"}
MOST_BYTES = 1_000_000


def needed(*starts: str) -> set[str]:
    """Return all foreign top-level packages that these modules reach."""
    graph = imports()
    waiting, seen, foreign = list(starts), set(starts), set()
    while waiting:
        for other in graph.get(waiting.pop(), ()):
            if other.split(".")[0] != "touchdown":
                foreign.add(other.split(".")[0])
            elif other not in seen:
                seen.add(other)
                waiting.append(other)
    return foreign - set(sys.stdlib_module_names) - {"__future__"} | (foreign & ONLINE)


def size_of(package: str) -> int:
    """Return the bytes of the distributions that a package comes from."""
    return sum(
        Path(file.locate()).stat().st_size
        for name in packages_distributions().get(package, ())
        for file in files(name) or ()
        if Path(file.locate()).is_file() and "__pycache__" not in file.parts
    )


def test_the_page_asks_for_less_than_a_megabyte_more_and_for_no_network() -> None:
    page = needed("touchdown.app.label.workspace")
    assert {"PySide6", "numpy", "zstandard"} <= page  # the walk found what is known to be there
    extra = page - needed(*ELSEWHERE)
    assert all(find_spec(package) for package in extra)
    assert sum(map(size_of, extra)) < MOST_BYTES
    assert not page & ONLINE


def test_the_former_episode_stays_in_sight_until_the_next_is_there(desk, monkeypatch):
    presenter, gate = desk.workspace.presenter, threading.Event()
    read = presenter._prefetch._read
    monkeypatch.setattr(presenter._prefetch, "_read", lambda uuid: (gate.wait(120), read(uuid))[1])
    page, first = desk.page, desk.uuid
    view, frame = page.film.views["left"], page.film.views["left"]._frame
    far = presenter.walk.order[30]
    presenter.go_to(30)
    desk.press(KEY.Key_Return)  # meant for the episode that is asked for, not for the one in sight
    page.repaint()
    assert presenter.walk.uuid == far
    assert desk.uuid == first
    assert view._frame is frame
    assert page.view.scene is not None
    assert desk.book.head(first).state == desk.book.head(far).state == "draft"
    gate.set()
    desk.settle()
    assert desk.book.head(far).state == "submitted"
    assert desk.book.head(first).state == "draft"
    assert desk.uuid == presenter.walk.order[31]
    assert page.film.views["left"]._frame is not frame


def test_where_nothing_was_in_sight_the_page_says_that_it_loads(desk, monkeypatch):
    presenter, gate, page = desk.workspace.presenter, threading.Event(), desk.page
    presenter.choose_queue("conflicts")
    desk.settle()
    assert page.nothing.title.text() == "There are no conflicts"
    read = presenter._prefetch._read
    monkeypatch.setattr(presenter._prefetch, "_read", lambda uuid: (gate.wait(120), read(uuid))[1])
    presenter.choose_queue("unlabelled")
    desk._qtbot.waitUntil(lambda: presenter.walk.uuid is not None, timeout=60_000)
    assert page.nothing.isVisible()
    assert page.nothing.title.text() == "Loading the episode"
    assert not page.nothing.button.isVisible(), "there is nothing to do but wait"
    gate.set()
    desk.settle()
    assert not page.nothing.isVisible()
    assert page.view.scene is not None
