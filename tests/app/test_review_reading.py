"""A run is read beside the window: no turn of the window waits for it, and it can be given up."""

import threading
import time

import pytest

from tests.app.slot_watch import SLOT_S, SlotWatch
from tests.app.test_review_list import record
from touchdown.app.review import recordings
from touchdown.app.review.recordings import RunReader
from touchdown.backend.core.values import Outcome
from touchdown.backend.runs.event_log import EVENT_LOG_NAME, read_events

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
            workspace.page.runs.choose_row(1)
            qtbot.waitUntil(lambda: not workspace.reader.busy, timeout=60_000)
            watch.next_visit()
            watch.doing = "a long run"
            workspace.page.runs.choose_row(0)
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
    page.runs.choose_row(0)

    def words():
        main.pump.tick()
        return page.decision._verdict.text(), page.decision._text.text()

    qtbot.waitUntil(lambda: words()[1].startswith("25 % read, "), timeout=60_000)
    assert words()[0] == "Reading the run"
    assert page.trials.count() == 0
    main.actions.action("review.cancel").trigger()
    assert words()[0] == "Not read"
    go_on.set()
    qtbot.waitUntil(lambda: not workspace.reader.busy, timeout=60_000)
    assert page.trials.count() == 0
    # Chosen again it is read as if nothing had been.
    page.runs.choose_row(1)
    page.runs.choose_row(0)
    qtbot.waitUntil(lambda: not workspace.reader.busy, timeout=60_000)
    assert page.trials.count() == 2 * REPEATS
