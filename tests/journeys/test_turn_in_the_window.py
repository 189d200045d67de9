"""An operator turns the hand, drives joints and switches the servo, on the stepped bench."""

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QMessageBox

from tests.journeys.operate_desk import desk, place, press, release, turn
from touchdown.backend.core.rotations import rotation_vector
from touchdown.backend.runs.requests import RunState

__all__ = ["desk"]


def turned(session):
    return rotation_vector(session._stage.arm._world.drive.turn)


def moved(session):
    return np.concatenate([place(session), turned(session)])


@pytest.mark.promise("H6", "H10")
def test_the_same_ends_a_move_and_a_turn(desk):
    main, session = desk
    jog = main.workspaces["operate"].page.jog
    ends = {
        "+rx": "release", "-rz": "page", "+ry": "frozen", "+j4": "frame",
        "-j5": "frozen", "-rx": "mode", "+j6": "stop", "+j1": "dialog", "+x": "page",
        "-x": "dialog",
    }  # fmt: skip
    for what, end in ends.items():
        main.go("operate")
        jog.frame.setCurrentIndex(2 if "j" in what else 0)
        jog.turn.setChecked("r" in what)
        turn(main, session, 0.1)
        pad, before = jog.pads[what], moved(session)
        assert pad.isVisible()
        unit = "mm" if what[1] == "x" else "\N{DEGREE SIGN}"
        assert unit in pad.text(), "each way says how far it goes"
        QTest.mousePress(pad, Qt.MouseButton.LeftButton)
        turn(main, session, 0.4, held=end != "frozen")
        assert np.linalg.norm(moved(session) - before) > 0.004
        end_it(main, pad, end)
        assert not session.hand.jog.active, f"{end} ends it at once"
        turn(main, session, 0.1, held=end == "frozen")
        at = moved(session)
        assert not session.hand.jog.active, end
        assert not jog.hold.held, end
        turn(main, session, 0.2)
        assert np.array_equal(at, moved(session)), end
        if end == "stop":
            main.reset()


def end_it(main, pad, end):
    if end == "release":
        QTest.mouseRelease(pad, Qt.MouseButton.LeftButton)
    elif end == "page":
        main.go("review")
    elif end in ("frame", "mode"):
        main.actions.action(f"operate.{'frame' if end == 'frame' else 'turn'}").trigger()
    elif end == "stop":
        main.stop()
    elif end == "dialog":
        box = QMessageBox(QMessageBox.Icon.NoIcon, "t", "text", parent=main.window)
        box.open()
        QApplication.processEvents()
        box.close()
        main.window.activateWindow()
        assert QTest.qWaitForWindowActive(main.window, 60_000)


@pytest.mark.promise("W4")
def test_keys_turn_and_drive_joints_and_level_brings_the_hand_back(desk):
    main, session = desk
    page = main.workspaces["operate"].page
    main.actions.action("operate.turn").trigger()
    page.jog.pace.steps[-1].click()
    page.jog.keys.click()
    press(main, Qt.Key.Key_PageUp)
    release(main, Qt.Key.Key_PageUp)
    turn(main, session, 1.5)
    assert np.degrees(turned(session)) == pytest.approx([0.0, 0.0, 5.0], abs=1e-6)
    assert "RZ 5.0" in page.jog._pose.text()
    page.jog.frame.setCurrentIndex(2)
    page.jog.keys.click()
    page.jog.keys.click()
    before = session._stage.arm.joints_rad(1.0)
    press(main, Qt.Key.Key_6)
    release(main, Qt.Key.Key_6)
    assert page.jog.pads["+j6"].property("chosen") == "yes"
    assert not session.hand.active, "a digit moves nothing"
    press(main, Qt.Key.Key_Down)
    release(main, Qt.Key.Key_Down)
    turn(main, session, 1.5)
    after = session._stage.arm.joints_rad(1.0)
    assert np.degrees(np.subtract(after, before)) == pytest.approx([0, 0, 0, 0, 0, -5.0], abs=1e-4)
    main.actions.action("operate.probe").trigger()
    assert "level it first" in main.cards.card("TURNED").text.what
    main.actions.action("operate.level").trigger()
    turn(main, session, 1.5)
    assert not turned(session).any()
    assert not page.jog.level.isEnabled()


def test_the_servo_goes_off_at_a_press_and_on_after_a_second(desk, qtbot):
    main, session = desk
    servo, pad = main.bar.servo, main.workspaces["operate"].page.jog.pads["+z"]
    qtbot.waitUntil(lambda: main.pump.tick() or servo.text() == "on", timeout=20_000)
    servo.click()
    switched(main, session, "off", qtbot)
    assert main.bar.pill.state.word == "NOT READY"
    assert not pad.isEnabled()
    main.actions.action("operate.probe").trigger()
    assert session.status().state is RunState.IDLE
    servo.click()
    turn(main, session, 0.1)
    assert not session.hand.powered, "a press alone switches nothing on"
    QTest.mousePress(servo, Qt.MouseButton.LeftButton)
    servo._held.timeout.emit()
    QTest.mouseRelease(servo, Qt.MouseButton.LeftButton)
    switched(main, session, "on", qtbot)
    assert pad.isEnabled()
    main.stop()
    servo.click()
    switched(main, session, "off", qtbot)
    session.hand._switch.join()
    QTest.mousePress(servo, Qt.MouseButton.LeftButton)
    servo._held.timeout.emit()
    QTest.mouseRelease(servo, Qt.MouseButton.LeftButton)
    assert not session.hand.powered, "not while the stop is latched"
    assert "STOPPED" in main.cards.codes


def switched(main, session, word, qtbot):
    session.hand._switch.join()
    qtbot.waitUntil(lambda: main.pump.tick() or main.bar.servo.text() == word, timeout=20_000)
    turn(main, session, 0.1)
