"""A sensor that is late or slow: the pill names it, and nothing new begins on it."""

import re
import threading
from dataclasses import replace

import pytest

from tests.app.conftest import settle
from tests.backend.brisk import brisk_bench, brisk_method
from touchdown.app.shell.activity import DEGRADED_DELAY_S, start_obstacle
from touchdown.app.shell.top_bar import DeviceChipsPresenter, pill_state
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core.faults import RefusedError
from touchdown.backend.devices.supervision import DegradedDevice
from touchdown.backend.runs.engine import LiveThread
from touchdown.backend.runs.requests import ProbeRequest, RunState, SceneChoice
from touchdown.widgets.base.theme import Theme
from touchdown.widgets.shell.top_bar import TopBar


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
    settle(live)
    assert start.isEnabled()


def test_a_silent_sensor_refuses_a_probe_is_degraded_then_a_fault():
    choice = brisk_bench("quiet", faults=("force_torque:stop@1.5",))
    session = simulated_session(choice, method=brisk_method())
    session.prepare(SceneChoice("pot", ("short",)))
    words = []
    while session.clock_s() < 2.2:
        session.advance()
        word = pill_state(session).word
        if word == "DEGRADED" and "DEGRADED" not in words:
            with pytest.raises(RefusedError, match="The wrist sensor has been silent") as refused:
                session.start(ProbeRequest())
            assert refused.value.reason == "DEGRADED"
        if word not in words[-1:]:
            words.append(word)
    assert words == ["READY", "DEGRADED", "FAULT"]
    session.close()


@pytest.mark.promise("S6")
def test_a_sensor_that_slows_down_is_yellow_on_the_pill_and_on_its_chip_alone(qtbot):
    faults = ("force_torque:slow=300@1.6+2.0", "tactile_left:slow=5@1.6+2.0")
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

    assert look(1.6)[1] == {}
    pill, unwell = look(3.5)
    assert (pill.word, pill.colour) == ("DEGRADED", "yellow")
    assert re.fullmatch(r"F/T slow \d s \+1", pill.note)
    assert set(unwell) == {"force_torque", "tactile_left"}
    assert unwell["force_torque"].startswith("slow 300 Hz")
    assert unwell["tactile_left"].startswith("slow 5 Hz")
    pill, unwell = look(6.0)
    assert (pill.word, unwell) == ("READY", {})
    session.close()


def test_a_sensor_that_comes_back_leaves_a_bench_that_is_ready():
    choice = brisk_bench("quiet", faults=("tactile_left:stop@1.5+0.3",))
    session = simulated_session(choice, method=brisk_method())
    session.prepare(SceneChoice("pot", ("short",)))
    words = []
    while session.clock_s() < 2.2:
        session.advance()
        if (word := pill_state(session).word) not in words[-1:]:
            words.append(word)
    assert words == ["READY", "DEGRADED", "READY"]
    session.close()
