"""The list of recorded runs says what each of them was."""

import threading
import time
from types import SimpleNamespace

import pytest
from PySide6.QtCore import Qt

from tests.app.slot_watch import SLOT_S, SlotWatch
from tests.app.stand_in import StandInBench
from tests.backend.annotations.filling import fill
from touchdown.app.review import recordings
from touchdown.app.review.episodes import EpisodeSeries, list_series
from touchdown.app.review.recordings import RunReader, read_run_summary
from touchdown.backend.annotations import Dataset
from touchdown.backend.annotations import dataset as dataset_module
from touchdown.backend.core import Outcome, PhaseEntered, RunFinished, RunStarted, TrialFinished
from touchdown.backend.runs.event_log import EVENT_LOG_NAME, EventLog, read_events
from touchdown.widgets.base import KeylessList, Theme, WrappedItemDelegate
from touchdown.widgets.lists.recordings import RecordingList, RecordingRow

TIME = "2026-11-21  04:15:11"


def record(folder, outcomes, ending="finished", piece="pot", probes=1):
    """Write a run with the journal that writes real ones."""
    bench, journal = StandInBench(), EventLog(folder)
    bench.events.subscribe(journal)
    bench.tell_start(piece=piece, trials=max(len(outcomes), 1))
    for number, outcome in enumerate(outcomes, start=1):
        if number > 1:
            bench.tell_trial(number)
        for probe in range(1, probes + 1):
            bench.tell_probe(probe, (7.2, 3.1), -3.4)
        bench.tell_end(outcome)
    if ending is not None:
        bench.events.publish(RunFinished(0.0, "run", ending, ""))
    return folder


def texts(main):
    """Return the rows of the list as they are shown."""
    return [row.text for row in main.workspaces["review"].page.runs.shown()]


def described(main, qtbot):
    """Wait until no run, and no line of one, is still being read."""
    presenter = main.workspaces["review"].presenter
    qtbot.waitUntil(
        lambda: not presenter.recordings.describing and not presenter.reading, timeout=60_000
    )


def test_the_times_of_runs_and_series_are_local(far_east):
    assert recordings.run_title("20261121-041511-7") == "2026-11-21  10:00:11"
    assert recordings.run_title("trial run") == "trial run"
    entry = SimpleNamespace(recorded_ns=0, piece="pot", bottom="short")
    assert EpisodeSeries(entry).title.startswith("1970-01-01  05:45:00\n")


def test_series_are_counted_page_by_page(tmp_path, monkeypatch):
    read, pages = Dataset.episodes, []

    def page(self, wanted=None):
        pages.append(wanted.limit)
        return read(self, wanted)

    monkeypatch.setattr(dataset_module, "PAGE", 3)
    monkeypatch.setattr(Dataset, "episodes", page)
    with Dataset.open(tmp_path / "dataset", person="setup") as dataset:
        uuids = fill(dataset, 7)
        (series,) = list_series(dataset)
    assert set(pages) == {3}
    assert [uuid for uuid, _ in series.episodes] == sorted(uuids)
    assert "7 episodes" in series.title
    assert "7 draft; 0 refused" in series.facts


@pytest.mark.parametrize(
    ("outcomes", "ending", "text"),
    [
        ([Outcome.PLACED], "finished", "pot on short: placed"),
        ([Outcome.KNOCKED_OVER], "finished", "pot on short: knocked over"),
        ([Outcome.FELL, Outcome.PLACED, Outcome.PLACED], "finished",
         "pot on short: 2 placed, 1 fell"),
        ([Outcome.ABORTED], "stopped", "pot on short: aborted, run stopped"),
        ([Outcome.PLACED], None, "pot on short: placed, not finished"),
        ([], None, "pot on short: not finished"),
    ],
)  # fmt: skip
def test_a_run_in_one_line(tmp_path, outcomes, ending, text):
    assert read_run_summary(record(tmp_path / "run", outcomes, ending)).text() == text


def test_a_torn_last_line_is_passed_over(tmp_path):
    run = record(tmp_path / "run", [Outcome.PLACED])
    whole = (run / EVENT_LOG_NAME).read_bytes()
    (run / EVENT_LOG_NAME).write_bytes(whole[:-9])
    assert read_run_summary(run).text() == "pot on short: placed, not finished"


def test_maps_are_not_decoded(tmp_path, monkeypatch):
    run = record(tmp_path / "run", [Outcome.PLACED, Outcome.FELL], probes=5)
    monkeypatch.setattr(
        "touchdown.backend.runs.event_log._array", lambda value: pytest.fail("decoded")
    )
    assert read_run_summary(run).outcomes == (Outcome.PLACED, Outcome.FELL)


def test_the_list_fills_in_newest_first_and_survives_damage(main, qtbot, tmp_path):
    runs = tmp_path / "runs"
    record(runs / "20261121-041511-703", [Outcome.FELL], piece="barrel")
    damaged = record(runs / "20261121-041511-702", [Outcome.FELL])
    text = (damaged / EVENT_LOG_NAME).read_text().replace('"FELL"', '"FLEW"')
    (damaged / EVENT_LOG_NAME).write_text(text)
    main.go("review")
    rows = main.workspaces["review"].page.runs
    described(main, qtbot)
    assert texts(main) == [f"{TIME}\nbarrel on short: fell", f"{TIME}\ncannot be read"]
    tip = rows.model().index(0, 0).data(Qt.ItemDataRole.ToolTipRole)
    assert tip == "barrel on short: fell"


def test_a_slow_disk_holds_up_the_thread_that_reads_never_the_window(main, qtbot, tmp_path):
    """As long as the disk does not answer the list says that it looks, not that there is none."""
    record(tmp_path / "runs" / "20261121-041511-703", [Outcome.FELL])
    review, disk_answers = main.workspaces["review"], threading.Event()
    review.reader.submit(disk_answers.wait, lambda _: None, pytest.fail)
    main.go("review")
    assert texts(main) == []
    assert (review.page.empty.text(), review.page.empty.isHidden()) == (recordings.LOOKING, False)
    disk_answers.set()
    described(main, qtbot)
    assert texts(main) == [f"{TIME}\npot on short: fell"]
    assert review.page.empty.isHidden()
    review.page.filter.setText("barrel")
    assert (review.page.empty.text(), review.page.empty.isHidden()) == (recordings.NO_MATCH, False)


def test_a_folder_that_cannot_be_listed_is_told_on_a_card(main, qtbot, tmp_path, monkeypatch):
    def gone(*_):
        raise OSError(116, "Stale file handle", str(tmp_path / "runs"))

    monkeypatch.setattr(recordings, "_looked_for", gone)
    main.go("review")
    described(main, qtbot)
    assert main.workspaces["review"].page.empty.text() == recordings.UNLISTED
    assert "Stale file handle" in main.cards.card("REPLAY").text.what


def test_recordings_are_sorted_and_the_chosen_one_stays(main, qtbot, tmp_path):
    for number, piece in ((701, "pot"), (702, "barrel"), (703, "mushroom")):
        record(tmp_path / "runs" / f"20261121-0415{number % 100:02}-703", [Outcome.FELL],
               piece=piece)  # fmt: skip
    main.go("review")
    page, presenter = main.workspaces["review"].page, main.workspaces["review"].presenter
    described(main, qtbot)

    def pieces():
        return [text.partition("\n")[2].split()[0] for text in texts(main)]

    assert pieces() == ["mushroom", "barrel", "pot"]
    page.runs.setCurrentIndex(page.runs.model().index(0, 0))
    described(main, qtbot)
    assert presenter.story.head.piece == "mushroom"
    page.order.setCurrentIndex(page.order.findData("oldest"))
    assert pieces() == ["pot", "barrel", "mushroom"]
    assert page.runs.currentIndex().row() == 2
    page.order.setCurrentIndex(page.order.findData("pair"))
    assert pieces() == ["barrel", "mushroom", "pot"]
    page.runs.setCurrentIndex(page.runs.model().index(0, 0))
    described(main, qtbot)
    assert presenter.story.head.piece == "barrel"
    page.filter.setText("pot")
    page.order.setCurrentIndex(page.order.findData("newest"))
    assert pieces() == ["pot"]
    assert not page.runs.selectedIndexes()
    page.filter.clear()
    page.kind.setCurrentIndex(page.kind.findData("series"))
    assert pieces() == []
    page.kind.setCurrentIndex(page.kind.findData("all"))
    assert [index.row() for index in page.runs.selectedIndexes()] == [1]
    assert presenter.story.head.piece == "barrel"
    record(tmp_path / "runs" / "20261121-041509-703", [Outcome.FELL], piece="pot")
    presenter.recordings.refresh()
    described(main, qtbot)
    assert pieces() == ["pot", "mushroom", "barrel", "pot"]
    assert [index.row() for index in page.runs.selectedIndexes()] == [2]


def test_only_the_newest_are_described_until_one_is_asked_for(main, qtbot, tmp_path, monkeypatch):
    monkeypatch.setattr(recordings, "MOST_DESCRIBED", 1)
    for number, piece in ((701, "barrel"), (702, "pot"), (703, "pot")):
        record(tmp_path / "runs" / f"20261121-041511-{number}", [Outcome.PLACED], piece=piece)
    main.go("review")
    described(main, qtbot)
    page, pot = main.workspaces["review"].page, f"{TIME}\npot on short: placed"
    assert texts(main) == [pot, TIME, TIME]
    page.runs.setCurrentIndex(page.runs.model().index(1, 0))
    described(main, qtbot)
    assert texts(main) == [pot, pot, TIME]
    page.filter.setText("barrel")
    assert texts(main) == []
    described(main, qtbot)
    assert texts(main) == [f"{TIME}\nbarrel on short: placed"]


def test_a_run_that_went_on_is_described_again(main, qtbot, tmp_path):
    run = record(tmp_path / "runs" / "20261121-041511-703", [Outcome.PLACED])
    whole = (run / EVENT_LOG_NAME).read_bytes()
    lines = whole.splitlines(keepends=True)
    (run / EVENT_LOG_NAME).write_bytes(b"".join(lines[:-2]))
    for content, text in ((None, "not finished"), (whole, "placed")):
        if content is not None:
            (run / EVENT_LOG_NAME).write_bytes(content)
        main.go("review")
        described(main, qtbot)
        assert texts(main) == [f"{TIME}\npot on short: {text}"]


@pytest.mark.parametrize(
    ("activity", "text"),
    [("collect", "pot on circle15: collecting, run cancelled"),
     ("probe", "pot on circle15: single probe, run cancelled")],
)  # fmt: skip
def test_a_run_without_trials_is_named_by_what_it_was_for(tmp_path, activity, text):
    journal = EventLog(tmp_path / "run")
    journal(RunStarted(0.0, "run", "pot", "circle15", "random", 0, 1, True, "{}",
                       activity=activity))  # fmt: skip
    journal(RunFinished(0.0, "run", "cancelled", ""))
    assert read_run_summary(tmp_path / "run").text() == text


def test_rows_are_as_high_as_their_text_beside_the_scroll_bar(qapp, qtbot):
    view = KeylessList("Recorded runs")
    qtbot.addWidget(view)
    view.setStyleSheet("QListWidget::item { padding: 6px 8px; }")
    view.resize(150, 120)
    view.show()
    text = "pot on circle15: aborted, run stopped"
    view.addItems([text] * 20)
    qapp.processEvents()
    metrics, room = view.fontMetrics(), view.viewport().width() - 16
    assert view.verticalScrollBar().isVisible()
    assert metrics.horizontalAdvance(text) > room
    lines = -(-metrics.horizontalAdvance(text) // room)
    assert view.visualItemRect(view.item(0)).height() >= lines * metrics.height()


def test_only_a_device_fault_before_the_release_keeps_a_trial_out_of_the_rate(
    main, qtbot, tmp_path
):
    """Of five trials one counts as placed, one is left out: 1 of 4, by Wilson 4.6 to 69.9 %."""
    run = tmp_path / "runs" / "20261121-041511-703"
    bench, journal = StandInBench(), EventLog(run)
    bench.events.subscribe(journal)
    bench.tell_start(trials=5)
    bench.tell_end(Outcome.PLACED)
    for number, (phase, reason) in enumerate(
        (
            ("press", "stopped by operator"),
            ("hold", "No valid force/torque sample for 0.4 s. Kept. Look. [FT-STALE]"),
            ("release", "No valid force/torque sample for 0.4 s. Kept. Look. [FT-STALE]"),
            ("press", "Force trip: 41.3 N. Kept. Look. [FT-TRIP]"),
        ),
        start=2,
    ):
        bench.tell_trial(number)
        bench.events.publish(PhaseEntered(0.0, phase, 1))
        bench.events.publish(TrialFinished(0.0, number, 7, Outcome.ABORTED, reason, 1, None, None))
    bench.tell_finish()
    main.go("review")
    page = main.workspaces["review"].page
    described(main, qtbot)
    page.runs.setCurrentIndex(page.runs.model().index(0, 0))
    described(main, qtbot)
    words = page.score.words
    assert "1 of 4 placed" in words
    assert "25 % success, 95 % interval 5 to 70 %" in words
    assert "Not counted: 1 trial that a device fault ended before the release (FT-STALE)." in words
    rows = [page.trials.item(row).text() for row in range(page.trials.count())]
    assert ["not counted" in row for row in rows] == [False, False, True, False, False]


@pytest.mark.parametrize(("rows", "most"), [(30, 1000), (10_000, 20)])
def test_a_series_of_10000_episodes_does_not_measure_each_of_its_rows(
    main, monkeypatch, rows, most
):
    trials, measured = main.workspaces["review"].page.trials, []
    known = WrappedItemDelegate.sizeHint

    def size_hint(self, option, index):
        measured.append(index.row())
        return known(self, option, index)

    monkeypatch.setattr(WrappedItemDelegate, "sizeHint", size_hint)
    main.workspaces["review"].presenter._fill([f"{n}.  draft, 1a2b3c4d" for n in range(rows)], -1)
    trials.doItemsLayout()
    assert 0 < len(measured) < most
    assert trials.count() == rows


def test_a_long_list_paints_and_measures_only_what_is_in_sight(qapp, qtbot, monkeypatch):
    """1,400 series are no dearer than ten: neither filter nor a new line touches each row."""
    picked, painted, measured = [], [], []
    view = RecordingList(Theme(), "Recorded runs", picked.append)
    qtbot.addWidget(view)
    painter = type(view.itemDelegate())

    def spied(calls, known):
        def call(self, *args):
            calls.append(1)
            return known(self, *args)

        return call

    monkeypatch.setattr(painter, "paint", spied(painted, painter.paint))
    monkeypatch.setattr(painter, "sizeHint", spied(measured, painter.sizeHint))
    view.resize(240, 300)
    view.show()
    view.take([RecordingRow(f"{k}", f"pot on circle15, {k % 7}") for k in range(1400)])
    for order in (range(1400), range(0, 1400, 7), range(1399, -1, -1)):
        view.show_order(order)
        qapp.processEvents()
    view.show_row(1399, RecordingRow("1399", "barrel"))
    qapp.processEvents()
    assert 3 < len(painted) < 80
    assert 0 < len(measured) < 80
    assert not picked
    view.setCurrentIndex(view.model().index(3, 0))
    assert picked == [1396] == [view.current]
    view.choose(5)
    assert (picked, view.current) == ([1396], 5)
    assert view.shown()[0].detail == "barrel"


def test_a_list_without_lines_says_why_and_falls_silent_with_the_first(qtbot):
    said, silent = KeylessList("Steps", "No steps are told."), KeylessList("Steps")
    for one in (said, silent):
        qtbot.addWidget(one)
        one.resize(240, 80)
    empty = said.viewport().grab().toImage()
    assert empty != silent.viewport().grab().toImage()
    for one in (said, silent):
        one.addItem("Probe 1")
    assert said.viewport().grab().toImage() == silent.viewport().grab().toImage()


REPEATS = 30
CHOICES = 2


@pytest.fixture
def run(tmp_path):
    """A run whose two trials come many times over."""
    made = record(tmp_path / "runs" / "20261121-041511-703", [Outcome.FELL] * 2, probes=2)
    first, head, *trials, end = (made / EVENT_LOG_NAME).read_bytes().splitlines(keepends=True)
    (made / EVENT_LOG_NAME).write_bytes(b"".join([first, head, *trials * REPEATS, end]))
    record(tmp_path / "runs" / "20261121-041511-702", [Outcome.FELL])
    return made


def opened(main, qtbot):
    main.go("review")
    workspace = main.workspaces["review"]
    qtbot.waitUntil(lambda: not workspace.reader.busy, timeout=60_000)
    return workspace


def test_no_turn_of_the_window_waits_for_a_long_journal(main, qtbot, run):
    workspace = opened(main, qtbot)
    begun_s = time.thread_time()
    RunReader(run).read()
    alone_s = time.thread_time() - begun_s
    watch = SlotWatch()
    try:
        for _ in range(CHOICES):
            workspace.page.runs.setCurrentIndex(workspace.page.runs.model().index(1, 0))
            qtbot.waitUntil(lambda: not workspace.reader.busy, timeout=60_000)
            watch.next_visit()
            watch.doing = "a long run"
            workspace.page.runs.setCurrentIndex(workspace.page.runs.model().index(0, 0))
            qtbot.waitUntil(lambda: not workspace.reader.busy, timeout=60_000)
            watch.next_visit()
            watch.doing = ""
    finally:
        watch.close()
    assert workspace.page.trials.count() == 2 * REPEATS
    best_s = min(watch.visits["a long run"])
    assert best_s < min(SLOT_S, 0.5 * alone_s), (best_s, alone_s)


def test_a_long_reading_says_how_far_it_is_and_can_be_given_up(main, qtbot, run, monkeypatch):
    workspace = opened(main, qtbot)
    page, go_on = workspace.page, threading.Event()
    facts = list(read_events(run))

    def halting(_folder):
        yield from facts[: len(facts) // 4]
        go_on.wait(60.0)
        yield from facts[len(facts) // 4 :]

    monkeypatch.setattr(recordings, "read_events", halting)
    monkeypatch.setattr(recordings, "LONG_S", 0.0)
    page.runs.setCurrentIndex(page.runs.model().index(0, 0))

    def words():
        main.pump.tick()
        return page.decision._result.text(), page.decision._text.text()

    qtbot.waitUntil(lambda: words()[1].startswith("25 % read, "), timeout=60_000)
    assert words()[0] == "Reading the run"
    assert page.trials.count() == 0
    main.actions.action("review.cancel").trigger()
    assert words()[0] == "Not read"
    go_on.set()
    qtbot.waitUntil(lambda: not workspace.reader.busy, timeout=60_000)
    assert page.trials.count() == 0
    # Chosen again it is read as if nothing had been.
    page.runs.setCurrentIndex(page.runs.model().index(1, 0))
    page.runs.setCurrentIndex(page.runs.model().index(0, 0))
    qtbot.waitUntil(lambda: not workspace.reader.busy, timeout=60_000)
    assert page.trials.count() == 2 * REPEATS
