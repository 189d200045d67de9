"""At 1280x720 and the usual text: nothing is cut that has to be read, no table is a slit."""

import pytest
from PySide6.QtCore import QPoint
from PySide6.QtWidgets import QApplication, QTableView

from tests.app.conftest import settle
from touchdown.backend.core.values import Outcome
from touchdown.widgets.base.panel import ElidedLabel, Panel
from touchdown.widgets.forms.collect_form import TargetButtons
from touchdown.widgets.lists.tables import LEAST_ROWS, FigureTable
from touchdown.widgets.views.tactile import TactileView

PAGES = ("operate", "collect", "train", "stack", "review")


@pytest.fixture
def least(live):
    live.window.resize(1280, 720)
    for name in PAGES:
        live.go(name)
        settle(live)
    return live


def seen(main, kind):
    page = main.workspaces[main.window.front].page
    return [one for one in page.findChildren(kind) if one.isVisible()]


def test_titles_side_by_side_are_in_line_and_no_tactile_picture_is_cut(least):
    for name in PAGES:
        least.go(name)
        settle(least)
        for view in seen(least, TactileView):
            assert view.visibleRegion().boundingRect() == view.rect(), (name, view.geometry())
        rows = {}
        for panel in seen(least, Panel):
            top = panel.mapTo(least.window, QPoint(0, 0)).y()
            title = panel._title.mapTo(least.window, panel._title.rect().center()).y()
            rows.setdefault(top, []).append(title)
        assert max(map(len, rows.values())) > 1
        for top, titles in rows.items():
            assert max(titles) - min(titles) <= 1, (name, top, titles)


def test_every_table_of_trainings_shows_three_rows(least):
    least.go("train")
    settle(least)
    tables = seen(least, FigureTable)
    assert len(tables) == 4
    for table in tables:
        room = table.viewport().height() / table.verticalHeader().defaultSectionSize()
        assert room >= LEAST_ROWS, table.accessibleName()


def test_no_column_of_the_probes_is_cut(least):
    least.go("collect")
    settle(least)
    (table,) = seen(least, QTableView)
    head, metrics = table.horizontalHeader(), table.horizontalHeader().fontMetrics()
    shown = [at for at in range(head.count()) if not head.isSectionHidden(at)]
    for at in shown:
        word = table.model().headerData(at, head.orientation())
        assert head.sectionSize(at) >= metrics.horizontalAdvance(word), word
    assert sum(map(head.sectionSize, shown)) <= table.viewport().width()


def test_the_header_of_the_trials_has_room_for_its_count(least, bench):
    least.go("stack")
    bench.tell_start(trials=10)
    bench.tell_end(Outcome.ABORTED)
    settle(least)
    detail = least.workspaces["stack"].page.score.detail
    assert detail.text() == "1 of 10, 1 aborted"
    assert detail.shown() == detail.text()
    for line in seen(least, ElidedLabel):
        assert line.shown() == line.text(), line.text()


def test_the_form_of_a_campaign_has_room_for_all_it_may_say(least):
    least.go("collect")
    settle(least)
    target = least.workspaces["collect"].collect_page.target
    target.show_buttons(
        TargetButtons(start=False, pause=True, end=True, paused=False,
                      why_not="In contact: lift first", in_contact=True)
    )  # fmt: skip
    target.show_progress(12, 20, "8 left, about 4 min at 30.0 s each")
    QApplication.processEvents()
    assert all(one.isVisible() for one in (target.lift, target.bar, target.eta))
    assert target.layout().minimumSize().height() <= target.height()
