"""Themes: chosen, or as the desktop says, also while the window is open."""

import re
import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PySide6.QtCore import QObject, Qt
from PySide6.QtGui import QColor
from PySide6.QtWidgets import QFrame, QVBoxLayout, QWidget

from tests.app.conftest import settle
from tests.backend.bench.brisk import brisk_bench, brisk_method
from touchdown.app.shell import window as appearance
from touchdown.app.shell.activity import DEGRADED_DELAY_S, start_obstacle
from touchdown.app.shell.live import LivePresenter, column_of
from touchdown.app.shell.top_bar import DeviceChipsPresenter, pill_state
from touchdown.app.shell.window import CHOICES, Appearance, system_theme
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core import RefusedError, SampleStream
from touchdown.backend.devices.sensor_faults import DegradedDevice
from touchdown.backend.runs import LiveThread, ProbeRequest, RunState, SceneChoice
from touchdown.widgets.base.theme import DARK, LIGHT, Theme
from touchdown.widgets.shell.top_bar import TopBar

SCHEME, WISH = Qt.ColorScheme, getattr(Qt, "ContrastPreference", None)


def desktop(scheme, wish=None):
    hints = SimpleNamespace(colorScheme=lambda: scheme)
    if wish is not None:
        hints.accessibility = lambda: SimpleNamespace(contrastPreference=lambda: wish)
    return SimpleNamespace(styleHints=lambda: hints)


@pytest.mark.parametrize(
    ("scheme", "theme"), [(SCHEME.Light, "light"), (SCHEME.Dark, "dark"), (SCHEME.Unknown, "dark")]
)
def test_the_desktop_says_dark_or_light(scheme, theme):
    assert system_theme(desktop(scheme)) == theme


@pytest.mark.skipif(WISH is None, reason="this Qt does not tell the wish for contrast")
def test_a_wish_for_contrast_comes_first():
    assert system_theme(desktop(SCHEME.Light, WISH.HighContrast)) == "contrast"
    assert system_theme(desktop(SCHEME.Light, WISH.NoPreference)) == "light"


@pytest.fixture
def look(qapp):
    owner = QObject()
    made = Appearance(qapp, "dark", 1.0, owner)
    yield made
    made.show("dark", 1.0)
    owner.deleteLater()


def test_the_choices_come_in_turn(look):
    seen = [look.next_theme() or look.choice for _ in CHOICES]
    assert sorted(seen) == sorted(CHOICES)


@pytest.mark.promise("W9")
def test_a_desktop_that_changes_is_followed_only_if_that_is_chosen(look, qapp, monkeypatch):
    wish = ["light"]
    monkeypatch.setattr(appearance, "system_theme", lambda _: wish[0])
    look.show("system", 1.0)
    assert (look.theme.tokens.name, look.words()) == ("light", "as the system (light)")
    wish[0] = "contrast"
    qapp.styleHints().colorSchemeChanged.emit(SCHEME.Dark)
    assert look.theme.tokens.name == "contrast"
    look.show("dark", 1.0)
    qapp.styleHints().colorSchemeChanged.emit(SCHEME.Light)
    assert look.theme.tokens.name == "dark"


def window_with_rail(qtbot):
    window = QWidget()
    qtbot.addWidget(window)
    rail = QFrame()
    rail.setProperty("role", "rail")
    rail.setFixedSize(20, 20)
    QVBoxLayout(window).addWidget(rail)
    return window, rail


def test_a_second_window_takes_all_of_its_last_theme_before_it_shows(qapp, qtbot, look):
    """Beside a first one Qt kept the rules of the earlier sheet for what had been laid out."""
    first, _ = window_with_rail(qtbot)
    theme = Theme()
    theme.apply(qapp, "dark", 1.0, first)
    first.show()
    second, rail = window_with_rail(qtbot)
    for name in ("dark", "light"):
        theme.apply(qapp, name, 1.0, second)
        rail.ensurePolished()
        rail.sizeHint()
    second.show()
    seen = rail.grab().toImage().pixelColor(5, 5)
    assert seen == QColor(LIGHT.panel) != QColor(DARK.panel)


def test_the_pill_names_the_sensor_and_since_when(live, bench):
    bench.turn(5.0)
    bench.degraded = (DegradedDevice("tactile_left", "silent", bench.clock_s() - 0.2),)
    settle(live)
    pill = live.bar.pill
    assert (pill.state.word, pill.state.shape, pill.state.colour) == ("DEGRADED", "bang", "yellow")
    assert pill.state.note == "Tactile L silent 0.2 s"
    assert pill.accessibleName() == "State: DEGRADED"
    assert pill.accessibleDescription() == pill.state.note
    bench.degraded = ()
    settle(live)
    assert pill.state.word == "READY"


def test_a_run_shows_it_while_it_stands_and_its_pause_afterwards(bench):
    bench.turn(5.0)
    slow = DegradedDevice("force_torque", "slow", bench.clock_s() - 3.0)
    bench.degraded = (slow, replace(slow, device="tactile_right", how="silent"))
    for state, word in ((RunState.RUNNING, "DEGRADED"), (RunState.PAUSED, "PAUSED")):
        bench.set_state(state)
        assert pill_state(bench).word == word
    bench.set_state(RunState.RUNNING)
    assert pill_state(bench).note == "F/T slow 3 s +1"
    bench.set_state(RunState.RUNNING, asks="say the outcome")
    assert pill_state(bench).word == "YOUR TURN"
    bench.interlock.stop()
    assert pill_state(bench).word == "STOPPED"


@pytest.mark.promise("P7", "P10")
def test_a_bench_that_makes_no_step_stands_still_and_one_that_prepares_does_not(bench):
    hangs, made = threading.Event(), threading.Event()

    def step():
        made.set()
        hangs.wait(30.0)

    thread = LiveThread(step, 0.02, pytest.fail, lambda fault: None)
    assert thread.still_s == 0.0
    thread.open(1.0)
    made.wait(30.0)
    thread._stepped_s -= 4.2
    bench.still_s = thread.still_s
    bench.interlock.stop()
    pill = pill_state(bench)
    assert (pill.word, pill.note) == ("STILL", "no step for 4 s")
    bench.set_state(RunState.PREPARING)
    assert pill_state(bench).word == "STOPPED"
    hangs.set()
    thread.close(lambda: None)
    assert thread.still_s == 0.0


def test_what_lasts_keeps_the_start_disabled_and_says_why(live, bench):
    bench.turn(5.0)
    start = live.workspaces["stack"].page.run.start
    live.go("stack")
    bench.degraded = (
        DegradedDevice("force_torque", "slow", bench.clock_s() - 0.5 * DEGRADED_DELAY_S),
    )
    assert start_obstacle(bench) == ""
    bench.turn(DEGRADED_DELAY_S)
    settle(live)
    assert start_obstacle(bench) == "The wrist sensor is slow: check it first"
    assert not start.isEnabled()
    bench.degraded = ()
    bench.interlock.recovering = True
    settle(live)
    assert not start.isEnabled()
    assert "jog away" in start.toolTip()
    bench.interlock.recovering = False
    settle(live)
    assert start.isEnabled()


@pytest.mark.parametrize(
    ("fault", "sensor", "end"),
    [
        ("force_torque:stop@1.5", "wrist sensor", "FAULT"),
        ("tactile_left:stop@1.5+0.3", "left", "READY"),
    ],
)
def test_a_silent_sensor_refuses_a_probe_until_it_comes_back_or_is_a_fault(fault, sensor, end):
    choice = brisk_bench("quiet", faults=(fault,))
    session = simulated_session(choice, method=brisk_method())
    session.prepare(SceneChoice("pot", ("short",)))
    words = []
    while session.clock_s() < 2.2:
        session.advance()
        word = pill_state(session).word
        if word == "DEGRADED" and "DEGRADED" not in words:
            with pytest.raises(RefusedError, match=f"{sensor}.* has been silent") as refused:
                session.start(ProbeRequest())
            assert refused.value.reason == "DEGRADED"
        if word not in words[-1:]:
            words.append(word)
    assert words == ["READY", "DEGRADED", end]
    session.close()


@pytest.mark.promise("S6")
def test_a_sensor_that_slows_down_is_yellow_on_the_pill_and_on_its_chip_alone(qtbot):
    faults = ("force_torque:slow=300@2.4+2.0", "tactile_left:slow=5@2.4+2.0")
    session = simulated_session(brisk_bench("quiet", faults=faults), method=brisk_method())
    session.prepare(SceneChoice("pot", ("short",)))
    bar = TopBar(Theme(), lambda: None)
    qtbot.addWidget(bar)
    chips = DeviceChipsPresenter(session, bar, session.clock_s)

    def look(until_s):
        while session.clock_s() < until_s:
            session.advance()
            chips.draw()
        shown = {name: bar.chips[name].value for name in session.devices}
        return pill_state(session), {n: v.detail for n, v in shown.items() if v.state != "ready"}

    assert look(2.4)[1] == {}
    pill, unwell = look(4.3)
    assert (pill.word, pill.colour) == ("DEGRADED", "yellow")
    assert re.fullmatch(r"F/T slow \d s \+1", pill.note)
    assert set(unwell) == {"force_torque", "tactile_left"}
    assert unwell["force_torque"].startswith("slow 300 Hz")
    assert unwell["tactile_left"].startswith("slow 5 Hz")
    pill, unwell = look(6.6)
    assert (pill.word, unwell) == ("READY", {})
    session.close()


class NotedPlot:
    """Keeps what it is told to draw."""

    def __init__(self, limit):
        self.t_s, self.values, self.span_s, self.limit = [], [], 10.0, limit

    def isVisible(self):  # noqa: N802
        return True

    def add(self, t_s, values):
        self.t_s.append(t_s)
        self.values.append(values)

    def show_span(self, span_s):
        self.span_s = span_s

    def show_age(self, age, age_s, reason):
        pass


def test_forces_and_moments_go_into_their_own_plots_axis_by_axis():
    wrench = SampleStream("wrench", 6, 100)
    t_s = 0.001 * np.arange(3)
    values = np.array([1.0, -2.0, 8.0, 0.1, -0.2, 0.3]) + 0.01 * np.arange(3)[:, None]
    wrench.put(t_s, values)
    force, moment = NotedPlot(10.0), NotedPlot(0.2)
    live = LivePresenter(
        SimpleNamespace(wrench=wrench), SimpleNamespace(force=force, moment=moment), lambda: 0.1
    )
    live.draw_wrench()
    np.testing.assert_array_equal(force.values, [values[:, :3]])
    np.testing.assert_array_equal(moment.values, [values[:, 3:]])
    np.testing.assert_array_equal(force.t_s, [t_s])
    np.testing.assert_array_equal(moment.t_s, [t_s])
    live.draw_wrench()
    assert len(force.values) == 1, "nothing new came"
    live.show_span(30.0)
    assert (force.span_s, moment.span_s) == (30.0, 30.0)
    np.testing.assert_array_equal(force.values[1], values[:, :3])
    np.testing.assert_array_equal(moment.values[1], values[:, 3:])


def test_stop_has_a_shorter_text_where_the_room_ends(qtbot):
    bar = TopBar(Theme(), lambda: None)
    qtbot.addWidget(bar)
    bar.resize(1280, 60)
    bar.fit()
    assert bar.stop.text() == "STOP motion (software)"
    bar.resize(bar.minimumSizeHint())
    bar.fit()
    assert bar.stop.text() == "STOP (software)"
    assert bar.pill.sizeHint().width() + bar.stop.sizeHint().width() < bar.width() < 400


def test_figures_of_chips_have_their_room_at_once(qtbot):
    bar = TopBar(Theme(), lambda: None)
    qtbot.addWidget(bar)
    bar.resize(420, 100)
    bar.show()
    for width in (640, 1024, 1600):
        bar.resize(width, 100)
        chips = bar.chips.values()
        assert [chip.width() for chip in chips] == [chip.sizeHint().width() for chip in chips]
    assert not any(chip.short for chip in chips)


def test_a_column_is_as_wide_as_its_views_need(qtbot):
    view = QWidget()
    view.setMinimumWidth(300)
    column = column_of((view, 1))
    qtbot.addWidget(column)
    column.least_px = 200
    assert column.minimumSizeHint().width() == 300
    column.least_px = 400
    assert column.minimumSizeHint().width() == 400
