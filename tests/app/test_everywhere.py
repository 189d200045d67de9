"""What holds on every page: nothing is cut off, states are announced, layouts are reset."""

from itertools import pairwise

import pytest
from PySide6.QtCore import QRect, QSize
from PySide6.QtGui import QAccessible
from PySide6.QtWidgets import QApplication, QLabel, QPushButton

from tests.app.conftest import settle
from touchdown.backend.runs.requests import RunState
from touchdown.widgets.shell import state


@pytest.mark.promise("W9")
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
    rail = list(live.window.rail.values())
    for upper, lower in pairwise(rail):
        assert upper.geometry().bottom() < lower.geometry().top()
        assert upper.height() >= upper.sizeHint().height()
    stop = live.bar.stop
    corner = stop.mapTo(live.window, stop.rect().bottomRight())
    assert QRect(live.window.rect()).contains(corner)
    live.look.show("dark", 1.0)
    assert cut == []


@pytest.mark.promise("W9")
def test_at_200_percent_every_control_can_be_reached(live):
    """What does not fit is scrolled to when it gets the focus."""
    live.window.resize(1280, 720)
    live.look.show("dark", 2.0)
    live.go("stack")
    QApplication.processEvents()
    scroll = live.window._scrolls["stack"]
    assert scroll.horizontalScrollBar().maximum() > 0
    for control in (
        live.workspaces["stack"].page.run.start,
        live.workspaces["stack"].page.run._mode,
    ):
        scroll.ensureWidgetVisible(control)
        seen = control.mapTo(scroll.viewport(), control.rect().center())
        assert scroll.viewport().rect().contains(seen)
    live.look.show("dark", 1.0)


def test_a_page_begins_without_a_chosen_control(live):
    live.go("stack")
    live.workspaces["stack"].page.run._seed.setFocus()
    live.go("operate")
    focus = QApplication.focusWidget()
    assert focus is None or not live.workspaces["operate"].page.isAncestorOf(focus)


@pytest.mark.promise("W12")
def test_a_change_of_state_is_announced(live, bench, monkeypatch):
    said = []
    monkeypatch.setattr(QAccessible, "isActive", staticmethod(lambda: True))
    monkeypatch.setattr(
        state.QAccessible, "updateAccessibility",
        staticmethod(lambda event: said.append(event.message())),
    )  # fmt: skip
    bench.set_state(RunState.RUNNING)
    settle(live)
    live.stop()
    settle(live)
    assert said == ["RUNNING", "STOPPED"]


@pytest.mark.promise("W8")
def test_reset_of_the_layout_puts_the_page_back(live):
    live.go("operate")
    page = live.workspaces["operate"].page
    page.looks.setCurrentIndex(2)
    page.span.setCurrentIndex(1)
    live.window.resize(1300, 730)
    live.actions.action("layout").trigger()
    assert page.looks.currentIndex() == page.span.currentIndex() == 0
    # Its usual size, or what the screen has room for.
    room = live.window.screen().availableSize()
    usual = QSize(1600, 940).boundedTo(room).expandedTo(live.window.minimumSize())
    assert live.window.size() == usual
