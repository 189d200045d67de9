"""One line of time in Review: every view shows the newest sample that is not after the cursor."""

import base64
import csv
import html
import io
import re
from contextlib import ExitStack
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from PySide6.QtCore import QPoint, Qt
from PySide6.QtGui import QImage
from PySide6.QtSvg import QSvgRenderer
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QLabel

from tests.app.conftest import opened, settle
from tests.app.label.conftest import make_episode
from tests.app.stand_in import StandInBench
from touchdown.app.review import exports
from touchdown.app.review.timing import patch_score, split_into_trials
from touchdown.backend.annotations import Dataset, EpisodeContext, Label
from touchdown.backend.core.events import (
    EpisodeRecorded,
    PatchEstimated,
    PhaseEntered,
    RunFinished,
    RunStarted,
)
from touchdown.backend.core.values import FINGERS, ContactPatch, Outcome
from touchdown.backend.episodes.episode_mcap import write_episode
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.event_log import EventLog
from touchdown.widgets.views import TimeScene

KEY = Qt.Key
PROBES = 3


def shifted(episode, by_s):
    """Return an episode that was recorded later."""
    r = episode.recording
    moved = replace(
        r,
        wrench_t_s=r.wrench_t_s + by_s,
        pose_t_s=r.pose_t_s + by_s,
        frames=tuple(replace(f, t_s=f.t_s + by_s) for f in r.frames),
        fields=tuple(replace(f, t_s=f.t_s + by_s) for f in r.fields),
    )
    return replace(episode, onset_s=episode.onset_s + by_s, recording=moved)


def make_run(folder):
    """Write a run of one trial: a probe and its decision every four seconds, then the end."""
    bench, journal = StandInBench(), EventLog(folder)
    (folder / "episodes").mkdir()
    bench.events.subscribe(journal)
    bench.tell_start(trials=1)
    episodes, decided_s = [], []
    for probe in range(1, PROBES + 1):
        bench.turn(4.0)
        now_s = bench.clock_s()
        episode = shifted(make_episode(probe), now_s - 3.5)
        name = f"{probe}.mcap"
        write_episode(folder / "episodes" / name, episode, None, {})
        bare = replace(episode, recording=None)
        bench.events.publish(EpisodeRecorded(now_s, bare, probe, name))
        bench.tell_probe(probe, (7.2 - 2.0 * probe, 3.1 - probe), 0.5 if probe == PROBES else -2.0)
        episodes.append(episode)
        decided_s.append(now_s)
    bench.turn(2.0)
    bench.tell_end(Outcome.PLACED)
    bench.events.publish(RunFinished(bench.clock_s(), "run", "finished", ""))
    return episodes, decided_s


class Review:
    """The window at Review, used by keys and clicks."""

    def __init__(self, main, qtbot):
        self.main, self._qtbot = main, qtbot
        self.workspace = main.workspaces["review"]
        self.page, self.presenter = self.workspace.page, self.workspace.presenter
        self.replay = self.presenter.replay

    def settle(self):
        QApplication.processEvents()
        self._qtbot.waitUntil(lambda: not self.workspace.reader.busy, timeout=60_000)

    def press(self, key, modifiers=Qt.KeyboardModifier.NoModifier):
        QTest.keyClick(self.main.window.windowHandle(), key, modifiers)

    def choose(self, row):
        self.page.runs.setCurrentIndex(self.page.runs.model().index(row, 0))
        self.settle()
        self.page.setFocus()


@pytest.fixture
def start(qapp, qtbot, tmp_path):
    """Return what opens the window at Review."""
    with ExitStack() as running:

        def begin():
            review = Review(running.enter_context(opened(tmp_path, active=True)), qtbot)
            review.press(KEY.Key_5, Qt.KeyboardModifier.ControlModifier)
            review.settle()
            return review

        yield begin


@pytest.fixture
def told(start, tmp_path):
    episodes, decided_s = make_run(tmp_path / "runs" / "20261121-041511-703")
    review = start()
    review.choose(0)
    return review, episodes, decided_s


def newest(times, cursor_s):
    """Return the greatest time not after the cursor, by looking at all of them."""
    return max((t for t in times if t <= cursor_s + 1e-9), default=None)


def test_nothing_chosen_is_said_once_and_offers_no_act(start):
    review = start()
    settle(review.main)
    page = review.page
    said = [one.text() for one in page.findChildren(QLabel) if "chosen" in one.text()]
    said += [view.why_empty for view in (page.forces, page.moments) if view.why_empty]
    assert said + list(filter(None, page.belief.scene.empty)) == ["No recording chosen"]
    assert not any(button.isEnabled() for button in page.acts)
    shown = page.time_line.grab().toImage()
    page.time_line.show_scene(TimeScene((0.0, 2.0)))
    assert shown != page.time_line.grab().toImage(), "the line of nothing has no times, no cursor"


@pytest.mark.promise("W16")
def test_all_views_show_the_newest_sample_not_after_the_cursor(told):
    review, episodes, decided_s = told
    low, high = review.replay.span_s
    rng = np.random.default_rng(5)
    edges = [f.t_s + d for e in episodes for f in e.recording.frames[:2] for d in (0.0, -0.001)]
    wrench = [(t, v) for e in episodes for t, v in
              zip(e.recording.wrench_t_s, e.recording.wrench, strict=True)]  # fmt: skip
    for cursor_s in [low, high, *decided_s, *edges, *rng.uniform(low, high, 25)]:
        review.replay.seek(float(cursor_s))
        for finger in FINGERS:
            frames = [f.t_s for e in episodes for f in e.recording.frames if f.finger == finger]
            fields = [f for e in episodes for f in e.recording.fields if f.finger == finger]
            view, wanted = review.page.film.views[finger], newest(frames, cursor_s)
            if wanted is not None:
                assert view._frame.t_s == pytest.approx(wanted, abs=1e-6)
                field_s = newest([f.t_s for f in fields], cursor_s)
                (field,) = [f for f in fields if f.t_s == field_s]
                np.testing.assert_allclose(
                    view._field.displacement_px, field.displacement_px, atol=1e-3
                )
            else:
                assert "frame" not in review.page.film.notes[finger].text()
        at = newest([t for t, _ in wrench], cursor_s)
        if at is not None:
            (values,) = [v for t, v in wrench if t == at]
            np.testing.assert_allclose(review.page.forces.at_cursor(), values, atol=1e-6)
        belief = review.page.belief.scene.belief
        probes = sum(t <= cursor_s + 1e-9 for t in decided_s)
        assert (0 if belief is None else belief.probes) == probes


def test_a_probe_of_the_strip_moves_everything_to_its_decision(told, qtbot):
    review, _, decided_s = told
    qtbot.mouseClick(review.page.strip.thumbnails[1], Qt.MouseButton.LeftButton)
    assert review.replay.cursor_s == pytest.approx(decided_s[1])
    assert review.page.belief.scene.belief.probes == 2
    assert [t.chosen for t in review.page.strip.thumbnails] == [False, True, False]
    assert review.page.time_line.cursor_s == review.page.film.cursor_s == review.replay.cursor_s


def test_keys_step_and_jump_and_play(told, qtbot):
    review, episodes, _ = told
    frames = sorted(f.t_s for e in episodes for f in e.recording.frames)
    review.replay.seek(frames[3])
    review.press(KEY.Key_Left)
    assert review.replay.cursor_s == pytest.approx(frames[2], abs=1e-6)
    review.press(KEY.Key_Right)
    review.press(KEY.Key_Right)
    assert review.replay.cursor_s == pytest.approx(frames[4], abs=1e-6)
    review.press(KEY.Key_L)
    assert review.replay.cursor_s == pytest.approx(frames[4] + 1.0, abs=1e-6)
    review.press(KEY.Key_J)
    before = review.replay.cursor_s
    review.press(KEY.Key_Space)
    assert review.page.film.playing
    assert review.page.play.text() == "Pause"
    qtbot.waitUntil(lambda: review.replay.cursor_s > before, timeout=60_000)
    review.press(KEY.Key_Space)
    assert not review.page.film.playing
    assert review.page.play.text() == "Play"
    review.press(KEY.Key_Slash)
    assert review.page.filter.hasFocus()


def test_space_stops_and_does_not_play_while_something_moves(told, monkeypatch):
    review, *_ = told
    stops = []
    monkeypatch.setattr(review.main._stop_key, "_moving", lambda: True)
    monkeypatch.setattr(review.main._stop_key, "_stop", lambda: stops.append(1))
    review.press(KEY.Key_Space)
    assert stops == [1]
    assert not review.page.film.playing


def test_a_click_on_the_line_moves_the_cursor(told):
    review, *_ = told
    line = review.page.time_line
    area = line.area()
    spot = QPoint(round(area.x(6.0)), round(area.rect.center().y()))
    QTest.mouseClick(line, Qt.MouseButton.LeftButton, pos=spot)
    pixel_s = (area.x1 - area.x0) / area.rect.width()
    assert review.replay.cursor_s == pytest.approx(6.0, abs=pixel_s)


def test_a_bookmark_stands_on_the_line_and_among_what_happened(told, tmp_path):
    review, *_ = told
    replay, note, story = review.replay, review.presenter.note, review.page.story
    for at_s, words in ((8.0, "later"), (3.0, "slipped?")):
        replay.seek(at_s)
        review.main.window.activateWindow()
        review.settle()
        review.press(KEY.Key_B)
        note.field.setText(words)
        note.save.click()
    review.main.window.activateWindow()
    marks = [mark for mark in review.page.time_line.scene.marks if mark.note]
    assert [(mark.t_s, mark.word) for mark in marks] == [(3.0, "slipped?"), (8.0, "later")]
    assert story.currentItem().text() == "Bookmark: slipped?"
    review.page.html.click()
    review.settle()
    (page,) = (tmp_path / "exports").glob("*.html")
    assert "Bookmark, trial 1, 3.00 s: slipped?" in page.read_text("utf-8")
    review.choose(0)
    review.settle()
    assert [mark.note for mark in replay.bookmarks] == ["slipped?", "later"], "read from the disk"
    replay.seek(0.0)
    review.press(KEY.Key_N)
    review.press(KEY.Key_N)
    assert replay.cursor_s == 8.0
    review.press(KEY.Key_N, Qt.KeyboardModifier.ShiftModifier)
    assert replay.cursor_s == 3.0
    review.page.bookmark.click()
    assert note.field.text() == "slipped?"
    note.field.setText("")
    note.save.click()
    assert [mark.note for mark in replay.bookmarks] == ["later"]


def test_an_episode_of_the_dataset_is_shown_with_its_label(start, isolated_settings):
    folder, catalogue = isolated_settings / "data" / "dataset", load_pieces()
    with Dataset.open(folder, person="Ann") as dataset:
        pair = dataset.geometry.store_pair(catalogue.piece("pot"), catalogue.piece("circle15"))
        context = EpisodeContext("s1", "circle15", pair, "Ann", "g1", "m1")
        label = Label(4000, -2500, 0, 150)
        entry = dataset.record(make_episode(3), label, source="measured", context=context)
    review = start()
    assert [r.detail for r in review.page.runs.shown()] == ["series: pot on circle15, 1 episode"]
    review.choose(0)
    review.settle()
    assert review.replay.recorded.missing == ()
    assert review.presenter.file == folder / entry.path
    assert "Label draft, measured, by Ann" in review.page.signals_panel.detail.text()
    scene = review.page.belief.scene
    assert scene.path == ((4.0, -2.5),)
    # Truth is where face and bottom overlap at the labelled place.
    piece, bottom = catalogue.piece("pot").face, catalogue.piece("circle15").face
    assert bottom.contains(0.999 * scene.truth).all()
    assert piece.contains(scene.truth - (4.0, -2.5)).sum() >= 0.9 * len(scene.truth)
    assert "IoU" in review.page.estimate.text()
    review.press(KEY.Key_B)
    review.presenter.note.field.setText("good example")
    review.presenter.note.save.click()
    assert review.page.story.item(0).text() == "Bookmark: good example"
    assert (folder / "bookmarks" / f"{entry.uuid}.json").is_file()
    with Dataset.open(folder, person="Ann") as dataset:
        assert dataset.notices == ()


@pytest.mark.promise("W16")
def test_an_estimate_against_the_truth_by_counting():
    disc = load_pieces().piece("circle15").face
    points = np.array([[0.0, 0.0], [5.0, 0.0], [9.0, 0.0], [0.0, 9.0]])
    patch = ContactPatch(points, np.array([0.9, 0.2, 0.8, 0.1]))
    # Radius 7.5 mm, moved by (1, 0): the first two points touch, 10 and about 9 mm are beside it.
    score = patch_score(4, patch, (3.0, 1.0), (2.0, 1.0), disc)
    assert (score.probe, score.iou, score.accuracy) == (4, pytest.approx(1 / 3), 0.5)


@pytest.mark.promise("W16")
def test_pictures_tables_and_pages_hold_what_is_shown(told, tmp_path):
    review, _, decided_s = told
    review.press(KEY.Key_E, Qt.KeyboardModifier.ControlModifier)
    review.press(KEY.Key_E, Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier)
    review.settle()
    (png,) = (tmp_path / "exports").glob("*.png")
    (svg,) = (tmp_path / "exports").glob("*.svg")
    (table,) = (tmp_path / "exports").glob("*.csv")
    assert QImage(str(png)).width() == review.page.shown.width()
    assert QImage(str(png)).height() > review.page.shown.height()
    assert QSvgRenderer(str(svg)).isValid()
    head = review.presenter.story.head
    words = f"Run {review.presenter.file.parent.name}: pot on {head.bottom}, trial 1, seed "
    drawn = html.unescape(svg.read_text())
    assert words in drawn
    assert f"at {review.replay.cursor_s:.2f} s" in drawn
    for button in ("Picture", "Table", "Open file", "Play"):
        assert f">{button}<" not in drawn
    assert ">Belief map<" in drawn
    assert review.page.play.isVisible()
    rows = list(csv.DictReader(io.StringIO(table.read_text())))
    assert [int(row["probe"]) for row in rows] == [1, 2, 3]
    assert [float(row["decided_s"]) for row in rows] == pytest.approx(decided_s)
    assert [row["verdict"] for row in rows] == ["unstable", "unstable", "stable"]
    assert {row["outcome"] for row in rows} == {"placed"}
    assert [row["episode"] for row in rows] == ["e1", "e2", "e3"]
    review.workspace._report()
    review.settle()
    (page,) = (tmp_path / "exports").glob("*.html")
    text = page.read_text()
    root = ElementTree.fromstring(
        re.sub(r"<(meta|img|br)([^>]*)>", r"<\1\2/>", text.removeprefix("<!doctype html>"))
    )
    rows = [[cell.text or "" for cell in row] for row in root.iter("tr")]
    names, *lines = csv.reader(io.StringIO(table.read_text()))
    assert rows[1:] == lines
    assert {"decided (s)", "margin (mm)", "iou (%)", "accuracy (%)"} <= set(rows[0])
    # The shown margin and agreement are those of the row.
    last = dict(zip(names, rows[-1], strict=True))
    estimate = f"Estimate: stands, {float(last['margin_mm']):+.1f} mm."
    assert review.page.decision._text.text().endswith(estimate)
    assert review.page.decision._result.text() == "\N{CHECK MARK} Placed", "not the estimate"
    iou = f"IoU {float(last['iou_percent']):.0f} %"
    accuracy = f"{float(last['accuracy_percent']):.0f} % of the points right"
    assert f"{iou}, {accuracy}" in review.page.estimate.text()
    assert iou in review.page.strip.thumbnails[-1].caption.text()
    picture = base64.b64decode(root.find(".//img").get("src").partition(",")[2])
    shown = QImage.fromData(picture)
    assert shown.width() == review.page.shown.width()
    # A page is light, the window stays dark: corners of the picture and of a panel.
    theme, panel = review.main.theme, review.page.signals_panel
    at = panel.mapTo(review.page.shown, QPoint(5, 5 + shown.height() - review.page.shown.height()))
    assert theme.tokens.name == "dark"
    assert (shown.pixelColor(2, 2).name(), shown.pixelColor(at).name()) == ("#ffffff", "#f2f4f6")
    assert panel.grab().toImage().pixelColor(5, 5).name() == theme.tokens.panel.lower()
    assert root.find(".//h1").text.startswith("Run 2026")
    said = "\n".join(line.text or "" for line in root.iter("p"))
    assert "1 of 1 placed" in said
    assert re.search(r"Written on \d{4}-\d\d-\d\d at .* by touchdown \d", said)
    assert re.search(r"Run .*: pot on short, strategy paper, .*seed \d", said)
    assert "SIMULATED BENCH" in said


def test_a_viewer_that_is_not_there_is_said(told, monkeypatch):
    review, *_ = told
    monkeypatch.setattr(exports.shutil, "which", lambda _: None)
    review.press(KEY.Key_O, Qt.KeyboardModifier.ControlModifier)
    assert "has no xdg-open" in review.main.window._message.text()
    started = []
    monkeypatch.setattr(exports.shutil, "which", lambda _: "/usr/bin/xdg-open")
    monkeypatch.setattr(
        exports.QProcess, "startDetached", lambda *args: (started.append(args), (True, 1))[1]
    )
    review.press(KEY.Key_O, Qt.KeyboardModifier.ControlModifier)
    assert started == [("/usr/bin/xdg-open", [str(review.presenter.file)])]


def test_a_damaged_episode_leaves_a_gap_and_a_sentence(start, tmp_path):
    run = tmp_path / "runs" / "20261121-041511-703"
    make_run(run)
    (run / "episodes" / "2.mcap").write_bytes(b"torn")
    review = start()
    review.choose(0)
    assert len(review.replay.recorded.traces) == PROBES - 1
    assert review.page.signals_panel.detail.text().startswith("2.mcap")


def test_a_single_probe_tells_what_it_felt_and_that_it_ended(start, tmp_path):
    journal = EventLog(tmp_path / "runs" / "20261121-041511-703")
    head = RunStarted(68.0, "run", "pot", "short", "", 0, 1, True, "{}", activity="probe")
    patch = ContactPatch(np.zeros((4, 2)), np.array([0.9, 0.4, 0.1, 0.2]))
    felt = PatchEstimated(70.0, patch, (5.2, 12.0), 1)
    ended = RunFinished(71.0, "run", "finished", "")
    for fact in (head, PhaseEntered(69.0, "press", 1), felt, PhaseEntered(70.0, "lift", 1), ended):
        journal(fact)
    review = start()
    review.choose(0)
    page = review.page
    assert [page.trials.item(i).text() for i in range(page.trials.count())] == ["1.  single probe"]
    assert page.score.words == "Single probe\npot on short, single probe. Run finished."
    assert review.replay.span_s == (68.0, 71.0)
    for t_s, said in ((69.5, "nothing to show"), (71.0, "Contact on 25 % of the face.")):
        review.replay.seek(t_s)
        assert said in page.decision._text.text()


def test_facts_before_the_first_trial_belong_to_none():
    assert split_into_trials([]) == []
    patch = PatchEstimated(0.0, ContactPatch(np.zeros((1, 2)), np.zeros(1)), (0.0, 0.0), 1)
    assert split_into_trials([patch]) == []
