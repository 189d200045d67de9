"""No slot takes long: a live window on the live simulated bench, in the real event loop."""

import time

import pytest
from PySide6.QtCore import QEventLoop, QTimer

from tests.app.slot_watch import SLOT_S, SlotWatch
from tests.app.yardstick import USUAL_S, Yardstick
from touchdown.app.application import TouchdownApp
from touchdown.app.shell.errors import ErrorBox
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import ProbeRequest, RunState, SceneChoice

FASTER = 8.0
"""The bench runs this much faster than real time, or as fast as it can."""
VISITS = 3
"""Each page is turned to this many times."""
TIMES = 8
"""So often the yardstick is measured before, and again after."""


@pytest.fixture
def watch(qapp):
    made = SlotWatch()
    yield made
    made.close()


def run_loop(ms):
    loop = QEventLoop()
    QTimer.singleShot(ms, loop.quit)
    loop.exec()


def test_the_watch_can_fail(watch):
    def burn():
        until = time.thread_time() + 1.2 * SLOT_S
        while time.thread_time() < until:
            pass

    watch.begin()
    watch.doing = "resting"
    run_loop(20)
    watch.next_visit()
    watch.doing = "burning"
    QTimer.singleShot(0, burn)
    run_loop(20)
    watch.next_visit()
    assert watch.visits["resting"][0] < SLOT_S < watch.visits["burning"][0]


@pytest.mark.parametrize(("slower", "allowed"), [(2.0, 2.0), (0.5, 1.0)])
def test_only_a_slower_computer_is_allowed_more(slower, allowed):
    yardstick = Yardstick()
    yardstick.best_s = slower * USUAL_S
    assert yardstick.allowed_s(SLOT_S) == pytest.approx(allowed * SLOT_S)


@pytest.mark.slow
@pytest.mark.usual_pace
def test_no_slot_takes_long_while_a_probe_goes_on_and_pages_change(qapp, qtbot, tmp_path, watch):
    session = simulated_session(keep=RecordingOptions(tmp_path / "runs"))
    session.prepare(SceneChoice())
    opened = session.open
    session.open = lambda: opened(FASTER)
    yardstick = Yardstick()
    main = TouchdownApp(qapp, ErrorBox(), tmp_path / "window.json", tmp_path / "runs")
    main.window.show()
    try:
        for name in (*main.workspaces, "operate"):
            # A page is laid out when it is first seen: once, and not while something moves.
            main.go(name)
            qapp.processEvents()
        main.attach(session)
        main.pump.start()
        run_loop(100)
        yardstick.measure(TIMES)
        watch.begin()
        seen = []

        def turn_page():
            if session.status().state is RunState.IDLE:
                # Only a page that is turned while the bench is at work counts.
                session.start(ProbeRequest())
                return
            watch.next_visit()
            watch.doing = [*main.workspaces][len(seen) % len(main.workspaces)]
            seen.append(watch.doing)
            main.go(watch.doing)

        timer = QTimer()
        timer.timeout.connect(turn_page)
        timer.start(150)
        qtbot.waitUntil(lambda: len(seen) > VISITS * len(main.workspaces), timeout=60_000)
        timer.stop()
        yardstick.measure(TIMES)
    finally:
        main.close()
        main.window.deleteLater()
        main.deleteLater()
    assert watch.turns > len(seen)
    assert set(watch.visits) == set(main.workspaces)
    # A slot that is too long is so at every visit; a crowded machine is not.
    best_s = {page: min(longest_s) for page, longest_s in watch.visits.items()}
    assert max(best_s.values()) <= yardstick.allowed_s(SLOT_S), best_s
