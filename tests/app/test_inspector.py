"""A chip opens the raw fields of its device, and they stay live."""

import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest

from tests.app.conftest import settle
from touchdown.app.shell.activity import inspector_rows
from touchdown.backend.devices.protocols import Identity
from touchdown.backend.runs.requests import RunState


@pytest.mark.promise("W6")
def test_a_click_on_a_chip_opens_its_device_and_follows_it(live, bench, qtbot):
    bench.devices["gripper"].describe = lambda: {"kind": "stand-in", "width_mm": -1.25}
    qtbot.mouseClick(live.bar.chips["gripper"], Qt.MouseButton.LeftButton)
    sheet = live.inspect.sheet
    assert sheet.isVisible()
    assert not sheet.isModal()
    shown = sheet.rows()
    assert shown["serial"] == "0001"
    assert shown["state"] == "ready"
    assert shown["kind"] == "stand-in"
    assert shown["width_mm"] == "\N{MINUS SIGN}1.25"
    received = int(shown["received"])
    bench.turn(0.4)
    live._chips._drawn_s = 0.0
    settle(live)
    assert int(sheet.rows()["received"]) == received + 10
    qtbot.mouseClick(live.bar.chips["arm"], Qt.MouseButton.LeftButton)
    assert sheet.key == "arm"
    assert "width_mm" not in sheet.rows()
    sheet.close()


def test_a_press_that_leaves_the_chip_opens_nothing(live, qtbot):
    chip = live.bar.chips["arm"]
    QTest.mousePress(chip, Qt.MouseButton.LeftButton)
    QTest.mouseRelease(chip, Qt.MouseButton.LeftButton, pos=chip.rect().bottomRight() * 3)
    assert live.inspect.sheet is None
    chip.setFocus()
    QTest.keyClick(chip, Qt.Key.Key_Return)
    assert live.inspect.sheet.isVisible()
    live.inspect.sheet.close()


def test_text_is_written_as_the_device_says_it(bench):
    bench.devices["arm"].describe = lambda: {"gel": "large-dot", "x_mm": -3.0}
    rows = dict(inspector_rows(bench.devices["arm"]))
    assert rows["gel"] == "large-dot"
    assert rows["x_mm"] == "\N{MINUS SIGN}3"


def test_reconnect_runs_beside_the_window_and_says_how_it_went(live, bench, qtbot):
    device = bench.devices["gripper"]
    device.close = lambda: None
    device.connect = lambda timeout_s, cancel: None
    live.inspect.open("gripper")
    live.inspect.sheet.reconnect.click()
    qtbot.waitUntil(lambda: not live.inspect._connecting, timeout=60_000)
    settle(live)
    assert "gripper is connected again" in live.window._message.text()


@pytest.mark.promise("C6", "W6")
def test_another_serial_number_is_a_card(live, bench, qtbot):
    device = bench.devices["tactile_left"]
    device.close = lambda: None

    def swapped(timeout_s, cancel):
        device.identity = Identity("Touchdown", "stand-in", "0002", "1")

    device.connect = swapped
    live.inspect.open("tactile_left")
    live.inspect.sheet.reconnect.click()
    qtbot.waitUntil(lambda: not live.inspect._connecting, timeout=60_000)
    settle(live)
    assert "0002 answers instead of 0001" in live.cards.card("OTHER-DEVICE").text.what


def test_nothing_is_reconnected_during_a_run(live, bench):
    bench.set_state(RunState.RUNNING)
    live.inspect.open("gripper")
    live.inspect.draw()
    assert not live.inspect.sheet.reconnect.isEnabled()
