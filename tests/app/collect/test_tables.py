"""The Collect half: form, keys, lists and maps."""

import errno
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QPoint, QRect, QSize, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QLabel

from tests.app.collect.conftest import PROBES
from tests.app.conftest import drop, settle
from touchdown.app.collect import recording_import
from touchdown.app.collect.requests import collect_request
from touchdown.app.shell.errors import log_to
from touchdown.backend.annotations.values import EpisodeFilter
from touchdown.backend.core import Fault, Paused, PhaseEntered
from touchdown.backend.episodes.quality import count_coverage
from touchdown.backend.exchange import RecordedSignal
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.requests import CollectRequest, RunState
from touchdown.widgets.forms.collect_form import PATTERNS, TargetForm
from touchdown.widgets.plots.distribution import NEAR_PX
from touchdown.widgets.shell.fault_cards import CardQuestion, CardText

KEY = Qt.Key


def test_campaigns_that_name_no_seed_have_different_ones() -> None:
    first, second = (collect_request(TargetForm(), "Ann").seed for _ in range(2))
    assert first != second
    assert collect_request(TargetForm(seed=7), "Ann").seed == 7


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


def test_a_recording_for_identify_is_chosen_as_pattern(page):
    target = page.view.target
    target.pattern.setCurrentIndex(target.pattern.findData("contact"))
    target.pattern.activated.emit(target.pattern.currentIndex())
    assert (target.count.value(), target.per_grip.value(), target.within.value()) == (4, 1, 2.0)
    target.count.setValue(6)
    page.press(KEY.Key_F5)
    (request,) = page.bench.started
    assert request == CollectRequest(
        "pot", "circle15", 6, request.seed, "random", "Ann", 2.0, probes_per_grip=1,
        grips_per_mounting=4, stage="contact", depth_mm=1.9, ramp_fraction=0.6, grip_force_n=4.0,
    )  # fmt: skip


@pytest.mark.parametrize("plan", ["rest", "gel", "contact", "drag"])
def test_every_recording_for_identify_is_a_pattern_of_the_form(plan):
    found = collect_request(TargetForm(pattern=plan), "Ann")
    assert (found.stage, found.pattern) == ("contact" if plan == "drag" else plan, "random")
    assert found.drag_mm == (0.9 if plan == "drag" else 0.0)
    assert plan in dict(PATTERNS)
    # A campaign that continues keeps the recording it was begun with.
    again = collect_request(TargetForm(pattern=plan), "Ann", campaign="c")
    assert (again.stage, again.grips_per_mounting, again.pattern) == ("", None, "random")


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
    assert page.view.target.person.hasFocus()
    assert not page.main.cards.codes
    target = page.view.target
    target.bottom.setCurrentIndex(target.bottom.findData("circle25"))
    page.settle()
    assert len(page.view.coverage.scene.bottom), "a pair without a probe shows its bottom"
    assert page.view.table.rows() == []


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
    catalogue = load_pieces()
    faces = (catalogue.piece("pot").face, catalogue.piece("circle15").face)
    counts = count_coverage(np.array(truth), *faces).counts
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


def test_a_person_who_types_keeps_the_focus(page):
    page.press(KEY.Key_U, Qt.KeyboardModifier.ControlModifier)
    page.bench.set_state(RunState.RUNNING)
    settle(page.main)
    assert not page.view.target.start.isEnabled()
    assert page.view.target.person.hasFocus()


def test_each_half_has_its_own_key_and_its_keys_do_nothing_in_the_other(page):
    both = Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier
    page.press(KEY.Key_L, both)
    assert page.workspace.page.front == "label"
    page.settle()
    page.press(KEY.Key_F5)
    page.press(KEY.Key_P)
    assert page.bench.started == []
    before = {e.uuid: e.state for e in page.presenter.dataset.episodes()}
    page.press(KEY.Key_C, both)
    assert page.workspace.page.front == "collect"
    for key in (KEY.Key_Left, KEY.Key_D, KEY.Key_PageDown, KEY.Key_V):
        page.press(key)
    page.settle()
    assert {e.uuid: e.state for e in page.presenter.dataset.episodes()} == before


FOREIGN = Path(__file__).parents[2] / "data/foreign"


@pytest.fixture
def sheet(page):
    """The sheet of a recording of another laboratory, dropped on the page, with its signals."""
    assert drop(page.view, FOREIGN / "press.mcap")
    made = page.workspace.recordings
    assert made.isVisible()
    page._qtbot.waitUntil(made.preview.isEnabled, timeout=60_000)
    return made


def look(page, sheet):
    """Press *Preview* and wait for its end."""
    QTest.mouseClick(sheet.preview, Qt.MouseButton.LeftButton)
    assert not sheet.preview.isEnabled()
    page._qtbot.waitUntil(sheet.preview.isEnabled, timeout=120_000)


def test_signals_and_mapping_fit_without_scrolling_sideways(page, sheet, qtbot):
    sheet.resize(1180, 600)
    names = ("/lab_2/wrist/force_torque_sensor_broadcaster/wrench_filtered", "/tool_pose")
    sheet._list([RecordedSignal(n, "geometry_msgs/msg/WrenchStamped", 9, 6, 250.0) for n in names])
    qtbot.wait(1)
    bars = (sheet.contents.horizontalScrollBar(), sheet.mapping.horizontalScrollBar())
    assert [bar.maximum() for bar in bars] == [0, 0]
    head = sheet.contents.horizontalHeader()
    assert all(head.sectionSize(at) >= sheet.contents.sizeHintForColumn(at) for at in (1, 2, 3))
    assert sheet.contents.item(0, 0).toolTip() == names[0]
    assert sheet.preview.property("role") == "primary"
    assert sheet.choose.property("role") == ""


def test_a_recording_comes_in_by_a_mapping_that_nothing_contradicts(page, sheet, qtbot):
    assert [row[:3] for row in sheet.contents.texts()] == [
        ["/ft_sensor", "WrenchStamped", "6"],
        ["/gel_left/compressed", "CompressedImage", ""],
        ["/gel_right/markers", "Float64MultiArray", "126"],
        ["/tool_pose", "PoseStamped", "7"],
    ]
    look(page, sheet)
    said = {name: found.text() for name, found in sheet.findings.items()}
    assert (
        "too long for a hand: 'moment_unit' of 'wrench'. Try moment_unit = \"N mm\""
        in said["wrench"]
    )
    assert "Try turn_deg = 180 in [left]" in said["left"]
    assert said["right"] == "Nothing contradicts 'right'."
    assert [line.name for line in sheet.plots["Force"].lines] == ["x", "y", "z"]
    assert sheet.plots["Force"].lines[2].points[-1][1] == pytest.approx(7.8, abs=0.3)
    moment = sheet.plots["Moment"]
    assert moment.name == "Moment (N\N{MIDDLE DOT}m)"
    assert moment._ending(moment.lines[1]).startswith("y \N{MINUS SIGN}10")
    assert not sheet.add.isEnabled()
    sheet.anyway.setChecked(True)
    assert sheet.add.isEnabled(), "the user may insist"
    sheet.anyway.setChecked(False)
    proposed = sheet.mapping.toPlainText()
    QTest.mouseClick(sheet.correct, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(sheet.preview.isEnabled, timeout=120_000)
    assert {found.property("tone") for found in sheet.findings.values()} == {"good"}
    assert not sheet.correct.isEnabled()
    assert sheet.add.isEnabled()
    sheet.mapping.undo()
    assert sheet.mapping.toPlainText() == proposed
    assert drop(sheet, FOREIGN / "map.toml")
    qtbot.waitUntil(lambda: "payload_kg = 1.5" in sheet.mapping.toPlainText(), timeout=60_000)
    look(page, sheet)
    assert {found.text() for found in sheet.findings.values()} == {
        f"Nothing contradicts '{name}'." for name in sheet.findings
    }
    assert "stored as pot on circle15" in sheet.note.text()
    divided = '[grips]\ngrip = "recording"\nmounting = "folder"\n'
    sheet.mapping.setPlainText(sheet.mapping.toPlainText() + divided)
    assert not sheet.add.isEnabled(), "another mapping needs another preview"
    look(page, sheet)
    assert "Grips: 1; mountings: foreign." in sheet.note.text()
    QTest.mouseClick(sheet.add, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: not sheet.isVisible(), timeout=60_000)
    page.settle()
    assert len(page.uuids) == PROBES + 1
    (entry,) = [e for e in page.presenter.dataset.episodes() if e.mode == "imported"]
    assert (entry.piece, entry.bottom, entry.person) == ("pot", "circle15", "Ann")
    assert (entry.grip_id, entry.mounting_id) == ("foreign/press", "foreign")
    texts = [one.text() for one in page.main.window.findChildren(QLabel)]
    assert "1 new episode from press.mcap." in texts


def test_a_recording_that_cannot_be_read_is_refused_in_words(page, sheet, tmp_path, qtbot):
    broken = tmp_path / "broken.mcap"
    broken.write_bytes((FOREIGN / "press.mcap").read_bytes()[:5000])
    sheet.take(broken)
    qtbot.waitUntil(lambda: "damaged or foreign" in sheet.note.text(), timeout=60_000)
    assert sheet.note.property("tone") == "bad"
    for name in ("pipe.toml", "pipe.mcap"):
        os.mkfifo(tmp_path / name)
        sheet.note.clear()
        sheet.take(tmp_path / name)
        qtbot.waitUntil(lambda: "This is not a file." in sheet.note.text(), timeout=20_000)
        qtbot.waitUntil(sheet.choose.isEnabled)
    sheet.take(broken)
    qtbot.waitUntil(lambda: "damaged or foreign" in sheet.note.text(), timeout=60_000)
    sheet.mapping.setPlainText(sheet.mapping.toPlainText().replace('unit = "m"', 'unit = "inch"'))
    look(page, sheet)
    assert "pose.unit" in sheet.note.text()
    page.workspace.recordings._target = lambda: (None, "", "pot", "circle15")
    sheet.read()
    assert sheet.note.text().startswith("Give your name in Collect")


def test_a_preview_is_cancelled_and_leaves_the_window_free(page, sheet, qtbot):
    QTest.mouseClick(sheet.preview, Qt.MouseButton.LeftButton)
    assert sheet.cancel.isEnabled()
    QTest.mouseClick(sheet.cancel, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(sheet.preview.isEnabled, timeout=60_000)
    assert sheet.note.text() == "Cancelled. Nothing was imported."
    assert not sheet.add.isEnabled()


PAGES_TWICE_AS_FINE = """
import sys
from pathlib import Path
from PySide6.QtWidgets import QApplication
from touchdown.app.application import TouchdownApp
from touchdown.app.shell.errors import ErrorBox
from tests.app.stand_in import StandInBench
application = QApplication([])
box, folder = ErrorBox(), Path(sys.argv[1])
main = TouchdownApp(application, box, folder / "window.json", folder / "runs")
bench = StandInBench()
main.attach(bench)
main.window.resize(1280, 720)
main.window.show()
bench.turn(0.2)
for page in main.workspaces:
    main.go(page)
    for _ in range(12):
        main.pump.tick()
        application.processEvents()
    image = main.window.grab().toImage()
    colours = {image.pixel(x, y) for x in range(160, 2560, 12) for y in range(120, 1400, 12)}
    print(page, image.width(), image.height(), image.devicePixelRatio(), len(colours) > 10)
failure = box.take()
print("failure", failure and failure.what)
main.close()
"""


def place(widget, window):
    return widget.mapTo(window, widget.rect().topLeft()), widget.size()


def test_cards_and_questions_cover_nothing_and_leave_the_controls_in_place(live, bench):
    live.go("stack")
    settle(live)
    page = live.workspaces["stack"].page
    watched = (page.run.start, page.run.cancel, page.decision)
    before = [place(widget, live.window)[0] for widget in watched]
    bench.tell_fault()
    live.stop()
    settle(live)

    def scene():
        corner = live.cards.mapTo(live.window, QPoint(0, 0))
        assert live.cards.isVisible()
        assert [place(widget, live.window)[0] for widget in watched] == before
        for scroll in live.window._scrolls.values():
            if scroll.isVisible():
                above = scroll.mapTo(live.window, scroll.rect().bottomLeft())
                assert above.y() < corner.y(), "no control is below the cards"

    scene()
    one_px = live.cards.height()
    live.cards.card("STOPPED").more.click()
    settle(live)
    assert live.cards.height() > one_px, "unfolded, all of it is seen"
    scene()
    live.reset()
    live.cards.ask(CardQuestion("A piece is held. Opening lets it go.", (("Keep", list),)))
    settle(live)
    scene()
    live.cards.withdraw()
    settle(live)
    assert not live.cards.isVisible()


@pytest.mark.parametrize(
    ("width", "height", "scale"),
    [(800, 600, 1), (800, 470, 1), (1024, 768, 1), (1280, 720, 1.5), (1600, 940, 1.5)],
)
def test_state_and_stop_are_seen_and_all_else_is_reached_in_every_size(live, width, height, scale):
    live.window.resize(width, height)
    live.look.show("dark", scale)
    for name in live.workspaces:
        live.go(name)
        live.cards.ask(CardQuestion("A piece is held. Close the window?", (("Stay", list),)))
        settle(live)
        assert live.window.size() == QSize(width, height)
        within = QRect(0, 0, width, height)
        pill, stop = (QRect(*place(w, live.window)) for w in (live.bar.pill, live.bar.stop))
        assert within.contains(pill)
        assert within.contains(stop)
        assert 0 < stop.left() - pill.right() < 20
        scroll = live.window._scrolls[name]
        page, room = scroll.widget(), scroll.viewport().size()
        reach = QPoint(scroll.horizontalScrollBar().maximum(), scroll.verticalScrollBar().maximum())
        assert page.width() <= room.width() + reach.x()
        assert page.height() <= room.height() + reach.y()
        assert within.contains(QRect(*place(live.cards, live.window)))
        live.cards.withdraw()
        live.stop()
        live.cards.card("STOPPED").offer.show()
        QApplication.processEvents()
        for words in live.cards.card("STOPPED").findChildren(QLabel):
            assert words.height() >= words.heightForWidth(words.width()), words.text()
        live.reset()


def test_a_card_as_high_as_its_words(live):
    long = "The disk is nearly full and this sentence goes on and on. " * 8
    live.cards.show_card(CardText("DISK", long, long, "Look.", reset=False))
    settle(live)
    card = live.cards.card("DISK")
    assert card.height() >= card.layout().totalHeightForWidth(card.width())
    assert live.cards.rect().contains(card.geometry())


def test_a_hint_goes_when_it_no_longer_holds(live):
    wrong = [True]
    live.say("In contact: lift first.", lambda: wrong[0])
    drawn(live)
    assert live.window._message.text().endswith("  In contact: lift first.")
    wrong[0] = False
    drawn(live)
    assert live.window._message.text() == ""
    live.say("The run ended.")
    drawn(live)
    assert re.fullmatch(r"\d\d:\d\d  The run ended\.", live.window._message.text())


def drawn(main):
    """Draw the frame, whatever the clock says."""
    main._chips._drawn_s = float("-inf")
    settle(main)


@pytest.mark.promise("W7")
def test_the_log_tells_stop_runs_faults_and_reset(live, bench, tmp_path):
    path = log_to(tmp_path)
    bench.tell_start()
    bench.tell_finish()
    bench.tell_fault()
    settle(live)
    live.stop()
    live.reset()
    settle(live)
    told = path.read_text().splitlines()
    for words in ("run run: stack, pot on short, seed 7", "run run finished",
                  "fault FT-TRIP: Force trip: 41.3 N over 40 N.", "STOP by the operator",
                  "reset by the operator"):  # fmt: skip
        assert sum(words in line for line in told) == 1, words


def test_with_large_text_the_controls_come_first_and_back(live):
    live.go("stack")
    live.window.resize(1600, 1000)
    page = live.workspaces["stack"].page
    live.look.show("dark", 2.0)
    settle(live)
    start = page.run.start
    corner = start.mapTo(live.window, start.rect().bottomRight())
    assert live.window.rect().contains(corner), "it is reached without scrolling"
    shares = page.columns.arrangement().shares
    live.look.show("dark", 1.0)
    for width in (1600, 1280):
        live.window.resize(width, 720)
        for name in ("operate", "stack"):
            live.go(name)
            settle(live)
            columns = live.workspaces[name].columns
            places = [part.x() for part in columns._parts]
            assert places == sorted(places), f"{name} as usual at {width} px"
            assert not live.window._scrolls[name].horizontalScrollBar().isVisible()
    assert page.columns.arrangement().shares == shares


@pytest.mark.parametrize("number", ["9", "9999", "1000000"])
def test_the_number_of_an_episode_is_shown_in_full(page, number):
    table = page.view.table
    table.show_rows([replace(table.rows()[0], number=number)], "")
    assert table.columnWidth(0) >= table.sizeHintForColumn(0)


def test_every_page_is_drawn_on_a_screen_twice_as_fine(tmp_path):
    env = {**os.environ, "QT_SCALE_FACTOR": "2", "QT_QPA_PLATFORM": "offscreen"}
    done = subprocess.run(
        [sys.executable, "-c", PAGES_TWICE_AS_FINE, str(tmp_path)],
        env=env, capture_output=True, text=True, timeout=110, check=True,
    )  # fmt: skip
    lines = done.stdout.splitlines()
    assert [line.split(maxsplit=1)[1] for line in lines[:5]] == 5 * ["2560 1440 2.0 True"]
    assert lines[5] == "failure None"


def test_a_run_that_paused_by_itself_says_why_until_it_goes_on(live, bench):
    full = Fault("DISK-FULL", "The disk is full.", "The campaign is paused.", "Make room.")
    for times in (1, 2):
        bench.events.publish(Paused(1.0, full))
        settle(live)
        card = live.cards.card("DISK-FULL")
        assert (card.text.reset, card.count) == (False, times)
    assert not bench.interlock.latched
    bench.events.publish(PhaseEntered(2.0, "press", 3))
    settle(live)
    assert live.cards.codes == ()


def test_garbage_nan_and_a_full_disk_are_refused_in_words(page, sheet, tmp_path, monkeypatch):
    (tmp_path / "picture.toml").write_bytes(b"\xff\xd8\xff\xe0 no text")
    assert drop(sheet, tmp_path / "picture.toml")
    page._qtbot.waitUntil(lambda: "no text" in sheet.mapping.toPlainText(), timeout=60_000)
    look(page, sheet)
    assert "not valid TOML" in sheet.note.text()
    sheet.mapping.setPlainText((FOREIGN / "map.toml").read_text().replace("1.5", "nan"))
    look(page, sheet)
    assert "payload_kg': Input should be a finite number" in sheet.note.text()
    assert not sheet.add.isEnabled()

    def full(*_args: object, **_named: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(recording_import, "write_atomically", full)
    look(page, sheet)
    assert sheet.note.text().endswith("cannot be read or written: No space left on device.")
    assert not sheet.add.isEnabled()
