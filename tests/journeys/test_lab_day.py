"""A lab day rehearsed: the window on a lab file, real drivers, an emulated bench in a process.

Real time on a busy machine: the stream of the arm may be lost and samples may come too late at any
time, and a link on which nothing comes for long is given up. That ends in one of ``STARVED``, each
with a next step; the operator resets and connects again what is no longer ready, and so does this
test. Nothing else may go wrong.
"""

import os
import subprocess
import sys
import tempfile
import threading
import time

import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication

from tests.app.conftest import opened
from tests.busy_computer import STARVED
from touchdown.app.start import open_bench
from touchdown.backend.core.events import RunFinished
from touchdown.backend.devices.protocols import DeviceState

TRIES = 12
LIMIT_S, PATIENCE_S = 150.0, 300.0
PANEL = ("force_torque", "tactile_left", "tactile_right", "gripper", "arm")


# ``touchdown`` that strikes a device with a fault for each line "device kind seconds" of its input.
STRIKING = """
import sys, threading, time
from touchdown.backend.cli.command_line import main
from touchdown.backend.emulation import fault_plan
begin, made = fault_plan.Faults.__init__, {}
def record(self, device, plan=None):
    begin(self, device, plan)
    made[device] = self
def strike():
    for device, kind, for_s in map(str.split, sys.stdin):
        made[device].inject(time.monotonic(), kind, float(for_s))
fault_plan.Faults.__init__ = record
threading.Thread(target=strike, daemon=True).start()
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture
def served(tmp_path):
    """The lab file of an emulated bench, and the process that serves it: faults by its input."""
    lab = tmp_path / "lab.toml"
    words = ["emulate", "bench", "--lab-file", str(lab), "--preset", "quiet", "--seed", "7"]
    # Emulated devices are known by their place below the folder for temporary files.
    with tempfile.TemporaryDirectory() as room:
        child = subprocess.Popen(
            [sys.executable, "-c", STRIKING, *words, "--for", "600", "--json"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            env={**os.environ, "TMPDIR": room},
        )
        wait(lambda: lab.is_file() and lab.read_text("utf-8"), lambda: None)
        yield lab, child
        child.terminate()
        child.stdin.close()
        child.wait(20.0)


@pytest.fixture
def desk(qapp, qtbot, served, tmp_path):
    with opened(tmp_path) as main:
        main.window.show()
        # Behind a page that draws little: what is drawn here takes time from the stream of the arm.
        main.go("train")
        link = open_bench(served[0])
        main.attach(link)
        link.interlock.override_speed(1.0)
        main.pump.start()
        yield main, link


def wait(condition, turn=QApplication.processEvents, limit_s=LIMIT_S):
    end, never = time.monotonic() + limit_s, threading.Event()
    while not condition():
        assert time.monotonic() < end, "it did not come in time"
        turn()
        never.wait(0.002)


def row(main, name):
    return main.panels.connect.sheet.row(PANEL.index(name))


def states(main):
    return [row(main, name)[0] for name in PANEL]


def codes(link):
    return {fault.code for fault in link.interlock.faults}


def recover(main, link):
    """Do what the cards say after a lost stream or link."""
    assert codes(link) <= STARVED, codes(link)
    main.reset()
    if not link.connection.ready:
        sheet = main.panels.connect.sheet
        main.panels.connect.draw(at_once=True)
        sheet.connect_all.click()
        wait(lambda: not link.connection.busy)


def ready(main, link):
    """Have the bench ready, whatever its wires did meanwhile."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        wait(lambda: not link.connection.busy)
        if link.connection.ready and not link.interlock.latched:
            # A busy computer makes samples late: what begins is refused then, for a moment.
            wait(lambda: not link.degraded or link.interlock.latched)
            if not link.interlock.latched:
                return
        recover(main, link)
    pytest.fail(f"the bench was lost again and again: {codes(link)}")


def until_done(main, link, done, act):
    """Act until ``done`` says so; again only where the stream of the arm was lost."""
    for _ in range(TRIES):
        ready(main, link)
        act()
        if done():
            return
    pytest.fail(f"not done in {TRIES} tries: {codes(link)}, {main.cards.codes}")


def jog_up(main, link):
    main.go("operate")
    pad = main.workspaces["operate"].page.jog.pads["+z"]
    wait(lambda: pad.isEnabled() or link.interlock.latched)
    QTest.mousePress(pad, Qt.MouseButton.LeftButton)
    begun_s = time.monotonic()
    wait(lambda: time.monotonic() - begun_s > 0.4)
    QTest.mouseRelease(pad, Qt.MouseButton.LeftButton)
    main.go("train")


def height_mm(link):
    values = link.raw.poses.since(link.raw.poses.count - 1).values
    return float(values[-1, 2]) if len(values) else float("nan")


def probe_once(main, link):
    """Return how a probe ended; it begins on a bench that is ready."""
    ends = []
    leave = link.events.subscribe(lambda f: ends.append(f) if isinstance(f, RunFinished) else None)
    ready(main, link)
    main.go("operate")
    main.actions.action("operate.probe").trigger()
    wait(lambda: ends)
    main.go("train")
    leave()
    return ends[0]


def unplug(main, link, child):
    """Pull a camera for a while: a card says so, and the same camera is taken again."""
    child.stdin.write("tactile_left unplug 1.5\n")
    child.stdin.flush()
    wait(lambda: {"CAMERA-STALE", "CAMERA-LINK"} & {*main.cards.codes})
    assert link.interlock.latched
    wait(lambda: link.devices["tactile_left"].state is DeviceState.READY)
    main.reset()


@pytest.mark.slow
@pytest.mark.usual_pace
def test_connect_home_jog_probe_stop_unplug_and_quit(desk, served):
    main, link = desk
    assert main.window.windowTitle() == "Touchdown (EMULATED: Rehearsal)"
    assert {device.state for device in link.devices.values()} == {DeviceState.CLOSED}
    assert link.hand is None, "nothing can be moved before the devices are connected"

    panel = main.panels.connect
    panel.sheet.connect_all.click()
    ready(main, link)
    panel.draw(at_once=True)
    assert states(main) == ["ready"] * 5
    assert "12345" in row(main, "gripper")[1], "who answers stands beside the device"
    row(main, "gripper")[3].click()
    panel.sheet.question.yes.click()
    wait(lambda: not link.connection.busy)
    assert link.connection.lines()[3].needs == ""

    panel.sheet.close()
    main.window.activateWindow()
    wait(main.window.isActiveWindow)
    before_mm = height_mm(link)
    until_done(main, link, lambda: height_mm(link) > before_mm + 0.2, lambda: jog_up(main, link))
    assert not link.hand.jog.active

    end = probe_once(main, link)
    assert end.ending == "finished" or codes(link) <= STARVED, end.reason
    ready(main, link)

    QTest.keyPress(main.window.windowHandle(), Qt.Key.Key_F12)
    assert link.interlock.stopped_by == "operator"
    main.reset()

    unplug(main, link, served[1])
    ready(main, link)
    main.close()
    assert {device.state for device in link.devices.values()} == {DeviceState.CLOSED}
