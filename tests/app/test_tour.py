"""What the window shows of a wrist sensor that drifts: read-out, chip, inspector, card."""

import json
from dataclasses import replace

import pytest
from PySide6.QtCore import QPoint, QRect, QSize, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QTableView

from tests.app.conftest import settle
from touchdown.backend.core import Noticed, Outcome
from touchdown.backend.runs.calibrations import drift_notice
from touchdown.backend.sensing.zeroing import WrenchDrift
from touchdown.widgets.base.panel import ElidedLabel, Panel
from touchdown.widgets.forms.collect_form import TargetButtons
from touchdown.widgets.lists.tables import LEAST_ROWS, FigureTable
from touchdown.widgets.shell.top_bar import TopBar
from touchdown.widgets.shell.tour import card_position
from touchdown.widgets.views.tactile import TactileView


def look(live, bench):
    """Draw what is drawn now and then."""
    bench.turn(0.2)
    live._chips._drawn_s = live.workspaces["operate"].live._headers_s = float("-inf")
    settle(live)


@pytest.mark.promise("S8")
def test_a_little_drift_is_a_figure_and_much_is_yellow_and_named(live, bench):
    live.go("operate")
    look(live, bench)
    plot, chip = live.workspaces["operate"].page.force, live.bar.chips["force_torque"]
    assert "drift" not in plot.summary()
    bench.drift = WrenchDrift(0.12, 240.0)
    look(live, bench)
    assert plot.summary().endswith("; drift 0.12 N in 4 min")
    assert chip.value.state == "ready"
    assert chip.value.tip.endswith("drift 0.12 N in 4 min, in still air")
    bench.drift = much = WrenchDrift(0.52, 11.0, named=True)
    bench.events.publish(Noticed(bench.clock_s(), drift_notice(much)))
    look(live, bench)
    assert (chip.value.state, chip.value.detail) == ("degraded", "drift 0.52 N")
    assert live.cards.codes == ("FT-DRIFT",)
    card = live.cards.card("FT-DRIFT").text
    assert "drifted by 0.52 N in 11 s" in card.what
    assert (card.notice, card.reset) == (True, False), "it stops nothing"
    live.inspect.open("force_torque")
    assert live.inspect.sheet.rows()["drift in air"] == "0.52 N in 11 s"
    live.inspect.open("gripper")
    assert "drift in air" not in live.inspect.sheet.rows()


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


def test_the_bench_from_the_side_is_seen_and_one_headline_says_how_it_stands(least, bench):
    least.go("stack")
    settle(least)
    page = least.workspaces["stack"].page
    assert page.side.isVisible()
    bench.tell_start(trials=3)
    bench.tell_probe(1, (7.2, 3.1), -3.4)
    settle(least)
    assert page.side.isVisible()
    assert page.score._count.text() == "No trial finished yet"
    assert page.score._count.property("role") == "title"
    bench.tell_end(Outcome.PLACED)
    settle(least)
    assert page.score._count.property("role") == "figure"


def test_a_form_with_more_lines_is_not_squeezed(least, bench):
    least.go("stack")
    settle(least)
    page = least.workspaces["stack"].page
    page.run.show_form(replace(page.run.form(), piece="brick", strategy="fused"))
    settle(least)
    assert page.run.height() >= page.run.heightForWidth(page.run.width()) > 0
    assert page.side.isHidden() or not page.side.isVisible()


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


KEY = Qt.Key


@pytest.mark.parametrize("size", [(1280, 720), (1600, 940)])
def test_every_stop_lights_its_place_and_the_card_stands_in_the_window(live, size):
    live.window.resize(*size)
    live.actions.action("tour").trigger()
    # No page is made before its stop.
    assert [ws.name for ws in live.workspaces.ready] == ["stack"]
    pages, tour = [], live.tour
    for at in range(len(tour.stops)):
        QApplication.processEvents()
        tour.fit()
        place, hole = tour.stops[at].place(), tour.spotlight.hole
        assert place.isVisible(), tour.stops[at].title
        corner = place.mapTo(live.window, QPoint(0, 0))
        assert hole.contains(QRect(corner, place.size()).intersected(live.window.rect()))
        assert live.window.rect().contains(tour.card.geometry())
        bar = live.window.findChild(TopBar)
        stop = QRect(bar.stop.mapTo(live.window, QPoint(0, 0)), bar.stop.size())
        assert not stop.intersects(tour.card.geometry()), "STOP stays in reach"
        assert tour.card.text.height() >= tour.card.text.heightForWidth(tour.card.text.width())
        pages.append(live.window.front)
        # Collect has a meaning of its own for Enter; the tour comes first.
        QTest.keyClick(live.window.windowHandle(), KEY.Key_Return)
    assert not tour.active
    assert set(pages) >= set(live.workspaces)


def test_it_is_in_nobodys_way_and_esc_ends_it(live, bench):
    live.tour.begin()
    assert not live.toured
    QTest.keyClick(live.window.windowHandle(), KEY.Key_F12)
    assert bench.stops == 1
    settle(live)
    assert live.tour.active
    QApplication.processEvents()
    cards = QRect(live.cards.mapTo(live.window, QPoint(0, 0)), live.cards.size())
    assert live.cards.isVisible()
    assert not live.tour.card.geometry().intersects(cards)
    live.reset()
    settle(live)
    QApplication.processEvents()
    assert not live.cards.isVisible()
    assert live.tour.card.y() < cards.bottom()
    while live.window.front != "train":
        live.tour.turn(1)
    # On this page Esc cancels a training; the tour comes first.
    QTest.keyClick(live.window.windowHandle(), KEY.Key_Escape)
    assert not live.tour.active
    assert live.tour.card is None
    assert live.toured


def test_one_can_go_back_and_begin_again_and_it_ends_where_it_began(live):
    live.go("train")
    live.tour.begin()
    assert not live.tour.card.back.isEnabled()
    QTest.keyClick(live.tour.card.next, Qt.Key.Key_Return)
    assert live.tour.at == 1
    live.tour.card.back.click()
    assert live.tour.at == 0
    live.tour.begin()
    assert live.tour.at == 0
    for _ in live.tour.stops:
        live.tour.turn(1)
    assert not live.tour.active
    assert live.window.front == "train"


def test_it_begins_by_itself_once_on_the_simulated_bench(main, bench, tmp_path):
    bench.simulated = False
    main.tour_due = True
    main.attach(bench)
    assert not main.tour.active
    bench.simulated = True
    first = main.window.front
    main.go("collect")
    main.attach(bench)
    assert not main.tour.active  # work has begun: no page and no focus is taken away
    main.go(first)
    main.attach(bench)
    assert main.tour.active
    # A crash in the middle does not bring it back: it would take the page in front away.
    assert json.loads((tmp_path / "window.json").read_text())["toured"] is True
    main.tour.end()
    main.attach(bench)
    assert not main.tour.active


@pytest.mark.parametrize(
    ("hole", "side"),
    [
        (QRect(0, 0, 300, 200), "right"),
        (QRect(900, 0, 300, 200), "left"),
        (QRect(0, 0, 1200, 100), "below"),
        (QRect(0, 600, 1200, 100), "above"),
    ],
)
def test_the_card_stands_beside_its_place(hole, side):
    card, window = QSize(320, 150), QRect(0, 0, 1200, 700)
    stands = QRect(card_position(hole, card, window), card)
    assert window.contains(stands)
    assert not stands.intersects(hole)
    assert {
        "right": stands.left() > hole.right(),
        "left": stands.right() < hole.left(),
        "below": stands.top() > hole.bottom(),
        "above": stands.bottom() < hole.top(),
    }[side]
