"""Nothing moves under the pointer, hints go when they no longer hold, the log tells the story."""

import os
import subprocess
import sys

import pytest

from tests.app.conftest import settle
from touchdown.app.collect.workspace import LABEL_WORDS
from touchdown.app.shell.errors import log_to
from touchdown.backend.core.events import Paused, PhaseEntered
from touchdown.backend.core.faults import Fault
from touchdown.widgets.shell.fault_cards import CardQuestion, CardText

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


def test_cards_and_questions_move_nothing_below_them(live, bench):
    live.go("stack")
    settle(live)
    page = live.workspaces["stack"].page
    watched = (page.run.start, page.decision, page.tactile["left"], page.force)
    before = [place(widget, live.window) for widget in watched]
    bench.tell_fault()
    live.stop()
    settle(live)
    assert live.cards.isVisible()
    assert live.cards.width() == live.cards.parentWidget().width()
    assert [place(widget, live.window) for widget in watched] == before
    one_px = live.cards.height()
    live.cards.card("STOPPED").more.click()
    settle(live)
    assert live.cards.height() > one_px, "unfolded, all of it is seen"
    live.reset()
    live.cards.ask(CardQuestion("A piece is held. Opening lets it go.", (("Keep", list),)))
    settle(live)
    assert live.cards.isVisible()
    assert [place(widget, live.window) for widget in watched] == before
    live.cards.withdraw()
    settle(live)
    assert not live.cards.isVisible()


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
    assert live.window._message.text() == "In contact: lift first."
    wrong[0] = False
    drawn(live)
    assert live.window._message.text() == ""
    live.say("The run ended.")
    drawn(live)
    assert live.window._message.text() == "The run ended."


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


def test_the_keys_of_label_are_told_on_label_alone(live):
    live.go("collect")
    page, foot = live.workspaces["collect"].page, live.window._message
    for leave in (lambda: page.show_half("collect"), lambda: live.go("stack")):
        live.go("collect")
        page.show_half("label")
        settle(live)
        assert foot.text() == LABEL_WORDS
        leave()
        settle(live)
        assert foot.text() == ""
