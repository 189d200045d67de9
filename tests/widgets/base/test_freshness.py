"""The pump stays within its budget whatever the load; ages are judged by the reader's clock."""

from collections import Counter, deque
from functools import partial

import pytest
from PySide6.QtCore import QDir, QObject
from PySide6.QtGui import QColor, QFontDatabase

from touchdown.widgets.base.freshness import BUDGET_S, Age, EventPump, Freshness
from touchdown.widgets.base.theme import load_resources, pixmap


class Wound:
    """A clock that the test winds."""

    s = 0.0

    def __call__(self):
        return self.s


@pytest.fixture
def clock():
    return Wound()


def test_the_budget_is_checked_after_every_fact(qapp, clock):
    owner = QObject()
    facts = deque(range(100))

    def pull():
        if not facts:
            return False
        facts.popleft()
        clock.s += 0.003
        return True

    pump = EventPump(owner, pull, now_s=clock)
    pump.tick()
    assert len(facts) == 97  # 3 x 3 ms is over 8 ms: no fourth one
    for _ in range(40):
        pump.tick()
    assert not facts


def test_a_slow_view_does_not_starve_the_others(qapp, clock):
    owner = QObject()
    drawn = Counter()

    def draw(name, cost_s):
        drawn[name] += 1
        clock.s += cost_s

    pump = EventPump(owner, lambda: False, now_s=clock)
    for name, cost_s in (("slow", 0.030), ("a", 0.001), ("b", 0.001)):
        pump.add(partial(draw, name, cost_s))
    for _ in range(18):
        pump.tick()
        clock.s += 0.016
    assert min(drawn[name] for name in ("slow", "a", "b")) >= 4


def test_neighbours_are_drawn_in_turn_each_as_often(qapp, clock):
    owner = QObject()
    drawn = []
    pump = EventPump(owner, lambda: False, now_s=clock)
    for name in "abc":
        pump.add(partial(drawn.append, name))
    for seen in ("ac", "acb", "acbac"):
        pump.tick()
        assert "".join(drawn) == seen
    assert BUDGET_S == 0.008


def test_the_timer_ticks_and_stops(qtbot):
    owner = QObject()
    pump = EventPump(owner, lambda: False)
    pump.start()
    qtbot.waitUntil(lambda: pump.ticks >= 2, timeout=60_000)
    pump.stop()


@pytest.mark.promise("W5")
def test_never_fresh_stale_gone_and_fresh_again_with_a_new_count():
    fresh = Freshness()
    assert not fresh.note(0, 5.0)
    assert fresh.judge(5.0) is Age.NEVER
    assert fresh.note(1, 10.0)
    assert fresh.judge(10.2) is Age.FRESH
    assert fresh.judge(10.201) is Age.STALE
    assert not fresh.note(1, 12.0)
    assert fresh.age_s(12.0) == 2.0
    assert fresh.judge(12.01) is Age.GONE
    assert fresh.note(2, 12.01)
    assert fresh.judge(12.01) is Age.FRESH


def test_nothing_is_drawn_and_nothing_lost_while_a_decision_is_due(qapp, clock):
    owner, drawn, facts, hushed = QObject(), [], deque(range(3)), [True]

    def pull():
        return bool(facts) and facts.popleft() >= 0

    pump = EventPump(owner, pull, hold=lambda: hushed[0], now_s=clock)
    pump.add(lambda: drawn.append("view"))
    pump.tick()
    assert (drawn, len(facts)) == ([], 3)
    hushed[0] = False
    pump.tick()
    assert (drawn, len(facts)) == (["view"], 0)


def test_a_calm_window_draws_each_view_eight_times_a_second_and_at_the_full_rate_afterwards(
    qapp, clock
):
    owner, drawn, calm = QObject(), [], [True]
    pump = EventPump(owner, lambda: False, now_s=clock)
    pump.calm = lambda: calm[0]
    for name in "ab":
        pump.add(partial(drawn.append, name))
    for _ in range(2):
        pump.tick()
    assert (drawn, pump._timer.interval()) == (["a", "b", "a", "b"], 125)
    calm[0] = False
    pump.tick()
    assert (len(drawn), pump._timer.interval()) == (5, 16)


def test_a_hidden_window_handles_events_and_draws_again_once_it_is_shown(qapp, clock):
    owner, drawn, facts, hidden = QObject(), [], deque(range(3)), [True]

    def pull():
        return bool(facts) and facts.popleft() >= 0

    pump = EventPump(owner, pull, hidden=lambda: hidden[0], now_s=clock)
    pump.add(lambda: drawn.append("view"))
    pump.tick()
    pump.tick()
    assert (drawn, len(facts), pump._timer.interval()) == ([], 0, 100)
    hidden[0] = False
    pump.tick()
    pump.tick()
    assert (drawn, pump._timer.interval()) == (["view"], 16)


def test_a_second_window_registers_nothing_again(qapp):
    load_resources()
    load_resources()
    assert len(QDir.searchPaths("icons")) == 1
    assert "Inter" in QFontDatabase.families()


def test_an_icon_is_drawn_once_per_colour_and_size(qapp):
    ink, other = QColor("#123456"), QColor("#654321")
    drawn = pixmap("stop", ink, 24)
    assert pixmap("stop", ink, 24).cacheKey() == drawn.cacheKey()
    assert drawn.toImage() != pixmap("stop", other, 24).toImage()
    assert pixmap("stop", ink, 30).width() == 30
