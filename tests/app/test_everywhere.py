"""What holds on every page: nothing is cut off, states are announced, no slot takes long."""

import time

import pytest
from PySide6.QtCore import QRect
from PySide6.QtGui import QAccessible
from PySide6.QtWidgets import QApplication, QLabel, QPushButton

from app.application import TouchdownApp
from app.error_hooks import ErrorBox
from backend.assembly import simulated_session
from backend.runs.requests import ProbeRequest, RunState, SceneChoice
from backend.session import Keep
from tests.app.conftest import settle
from widgets import state_pill

SLOT_S = 0.050


@pytest.mark.parametrize("scale", [0.8, 1.0, 2.0])
def test_no_text_is_cut_off_on_any_page_at_any_scale(live, scale):
    live.window.resize(1280, 720)
    live.look.show("dark", scale)
    cut = []
    for name, workspace in live.workspaces.items():
        live.go(name)
        QApplication.processEvents()
        for kind in (QLabel, QPushButton):
            cut += [
                (name, widget.text())
                for widget in workspace.page.findChildren(kind)
                if widget.isVisible() and widget.text()
                and not (isinstance(widget, QLabel) and widget.wordWrap())
                and widget.sizePolicy().horizontalPolicy() is not widget.sizePolicy().Policy.Ignored
                and widget.width() < widget.minimumSizeHint().width() - 1
            ]  # fmt: skip
    stop = live.bar.stop
    corner = stop.mapTo(live.window, stop.rect().bottomRight())
    assert QRect(live.window.rect()).contains(corner)
    live.look.show("dark", 1.0)
    assert cut == []


def test_a_change_of_state_is_announced(live, bench, monkeypatch):
    said = []
    monkeypatch.setattr(QAccessible, "isActive", staticmethod(lambda: True))
    monkeypatch.setattr(
        state_pill.QAccessible, "updateAccessibility",
        staticmethod(lambda event: said.append(event.message())),
    )  # fmt: skip
    bench.set_state(RunState.RUNNING)
    settle(live)
    live.stop()
    settle(live)
    assert said == ["RUNNING", "STOPPED"]


def test_reset_of_the_layout_puts_the_page_back(live):
    live.go("operate")
    page = live.workspaces["operate"].page
    page.looks.setCurrentIndex(2)
    page.span.setCurrentIndex(1)
    live.window.resize(1300, 730)
    live.actions.action("layout").trigger()
    assert page.looks.currentIndex() == page.span.currentIndex() == 0
    assert (live.window.width(), live.window.height()) == (1600, 940)


@pytest.fixture
def busy_desk(qapp, qtbot, tmp_path):
    session = simulated_session(keep=Keep(tmp_path / "runs"))
    session.prepare(SceneChoice())
    session.open = lambda speed=1.0: None
    main = TouchdownApp(qapp, ErrorBox(), tmp_path / "window.json", tmp_path / "runs")
    main.attach(session)
    with qtbot.waitActive(main.window, timeout=5000):
        main.window.show()
        main.window.activateWindow()
    yield main, session
    main.close()
    main.window.deleteLater()
    main.deleteLater()


@pytest.mark.slow
def test_no_slot_takes_long_while_a_run_goes_on(busy_desk):
    """Processor time of this thread, so that other work on the machine does not count."""
    main, session = busy_desk
    taken = {}

    def timed(what, call):
        start = time.thread_time()
        call()
        taken.setdefault(what, []).append(time.thread_time() - start)

    for name in main.workspaces:
        main.go(name)
        QApplication.processEvents()
    main.go("operate")
    timed("start", lambda: session.start(ProbeRequest()))
    ticks = 0
    while session.status().state is not RunState.IDLE or ticks < 20:
        session.engine.tick()
        session.advance()
        if ticks % 2 == 0:
            timed("tick", main.pump.tick)
            timed("paint", QApplication.processEvents)
        if ticks % 100 == 50:
            names = list(main.workspaces)
            timed("page", lambda names=names, k=ticks: main.go(names[k // 100 % len(names)]))
        ticks += 1
        assert ticks < 3000
    long = {what: max(times) for what, times in taken.items() if max(times) > SLOT_S}
    assert long == {}, f"of {sum(map(len, taken.values()))} slots"
