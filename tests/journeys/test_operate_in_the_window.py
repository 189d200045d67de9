"""An operator moves the bench by hand: the real window on the real bench, stepped by the test."""

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QPushButton
from shapely import MultiPoint, Point

from tests.journeys.operate_desk import desk, place, press, release, turn
from touchdown.backend.core.values import Pose
from touchdown.backend.runs.requests import RunState

__all__ = ["desk"]


def test_a_held_pad_moves_the_arm_and_the_pill_says_so(desk):
    main, session = desk
    pad, before = main.workspaces["operate"].page.jog.pads["+z"], place(session)
    QTest.mousePress(pad, Qt.MouseButton.LeftButton)
    turn(main, session, 0.5, held=True)
    assert main.bar.pill.state.word == "JOG"
    assert "+Z XYZ, 20 mm/s" in main.bar.pill.state.note
    QTest.mouseRelease(pad, Qt.MouseButton.LeftButton)
    at = place(session)
    turn(main, session, 0.2)
    assert np.array_equal(place(session), at)
    assert (at - before)[2] == pytest.approx(9.7, abs=0.3)
    assert main.bar.pill.state.word == "READY"


@pytest.mark.promise("R13", "W3", "H12")
def test_a_frozen_window_ends_the_motion_within_300_ms(desk):
    """The window's thread does nothing for 2 s: neither beats nor draws."""
    main, session = desk
    QTest.mousePress(main.workspaces["operate"].page.jog.pads["+x"], Qt.MouseButton.LeftButton)
    frozen_s = moved_s = session.clock_s()
    for _ in range(100):
        before = place(session)
        session.advance()
        if not np.array_equal(before, place(session)):
            moved_s = session.clock_s()
    assert 0.0 < moved_s - frozen_s <= 0.3
    turn(main, session, 0.2, held=True)
    assert not main.workspaces["operate"].page.jog.hold.held, "thawed: the lease is gone"
    assert main.cards.codes == ("JOG-LEASE",), "one end, one card"
    QTest.mouseRelease(main.workspaces["operate"].page.jog.pads["+x"], Qt.MouseButton.LeftButton)
    QTest.mousePress(main.workspaces["operate"].page.jog.pads["+x"], Qt.MouseButton.LeftButton)
    assert session.hand.jog.active
    assert main.cards.codes == (), "the next order that is carried out withdraws it"


@pytest.mark.promise("H11")
def test_stop_ends_a_jog_and_no_pad_works_until_reset(desk):
    main, session = desk
    page = main.workspaces["operate"].page
    QTest.mousePress(page.jog.pads["+x"], Qt.MouseButton.LeftButton)
    press(main, Qt.Key.Key_F12)
    assert not session.hand.jog.active
    at = place(session)
    turn(main, session, 0.2, held=True)
    assert np.array_equal(place(session), at)
    assert not page.jog.pads["+x"].isEnabled()
    assert "Reset" in page.jog.pads["+x"].toolTip()
    main.reset()
    turn(main, session, 0.1)
    assert page.jog.pads["+x"].isEnabled()
    QTest.mousePress(page.jog.pads["+x"], Qt.MouseButton.LeftButton)
    turn(main, session, 0.1, held=True)
    press(main, Qt.Key.Key_Space)
    assert session.interlock.latched, "Space stops what moves"


@pytest.mark.promise("W4")
def test_a_step_per_press_and_none_for_auto_repeat(desk):
    main, session = desk
    page = main.workspaces["operate"].page
    main.actions.action("operate.longer").trigger()
    assert page.jog.pace.step == 0.1
    before = place(session)
    QTest.mousePress(page.jog.pads["-y"], Qt.MouseButton.LeftButton)
    turn(main, session, 0.5)
    assert place(session) - before == pytest.approx([0, -0.1, 0], abs=1e-9)
    page.jog.keys.click()
    press(main, Qt.Key.Key_Up)
    for _ in range(20):
        press(main, Qt.Key.Key_Up, repeat=True)
    turn(main, session, 0.5)
    assert place(session) - before == pytest.approx([0, 0, 0], abs=1e-9)


@pytest.mark.parametrize(
    ("key", "axis", "sign"), [(Qt.Key.Key_Left, 0, -1), (Qt.Key.Key_PageUp, 2, 1)]
)
def test_a_key_of_the_window_system_moves_as_long_as_it_is_held(desk, key, axis, sign):
    """A platform sends ShortcutOverride before each press; ``sendEvent`` alone does not."""
    main, session = desk
    QTest.keyPress(main.window.windowHandle(), key)
    assert not session.hand.jog.active, "keys are not armed"
    QTest.keyRelease(main.window.windowHandle(), key)
    main.actions.action("operate.arm").trigger()
    assert main.workspaces["operate"].page.jog.property("armed") == "yes"
    before = place(session)
    QTest.keyPress(main.window.windowHandle(), key)
    turn(main, session, 0.3, held=True)
    assert session.hand.jog.active
    QTest.keyRelease(main.window.windowHandle(), key)
    assert not session.hand.jog.active
    assert sign * (place(session) - before)[axis] > 3.0
    QTest.keyPress(main.window.windowHandle(), key)
    assert session.hand.jog.active
    QTest.keyPress(main.window.windowHandle(), Qt.Key.Key_F12)
    assert session.interlock.latched


@pytest.mark.promise("H8")
def test_a_second_key_stops_both(desk):
    main, session = desk
    main.actions.action("operate.arm").trigger()
    press(main, Qt.Key.Key_Right)
    assert session.hand.jog.active
    press(main, Qt.Key.Key_Up)
    assert not session.hand.jog.active
    release(main, Qt.Key.Key_Right)
    assert not session.hand.jog.active


@pytest.mark.parametrize("way", ["idle", "text field", "page", "stop", "button"])
def test_arming_ends(desk, way):
    main, session = desk
    page, keys = main.workspaces["operate"].page, main.workspaces["operate"].keys
    main.actions.action("operate.arm").trigger()
    assert keys.armed
    assert keys._idle.interval() == 30_000
    if way == "idle":
        keys._idle.timeout.emit()
    elif way == "text field":
        page.jog.speed.setFocus()
    elif way == "page":
        main.go("stack")
    elif way == "stop":
        main.stop()
        turn(main, session, 0.1)
    else:
        page.jog.keys.click()
    assert not keys.armed
    assert page.jog.property("armed") == "no"


def test_grip_probe_once_and_open_with_a_question(desk):
    main, session = desk
    page = main.workspaces["operate"].page
    page.gripper.grip.click()
    turn(main, session, 1.5)
    assert "holding a piece" in page.gripper.figures.text()
    down = Pose(0.0, 0.0, 33.0)
    motion = session._stage.arm.move_to(down, 50.0)
    while not motion.done:
        turn(main, session, 0.1)
    main.actions.action("operate.probe").trigger()
    seen = set()
    for _ in range(300):
        turn(main, session, 0.1)
        seen.add(page.probe.strip.at)
        if session.status().state is RunState.IDLE and page.probe.strip.at == 6:
            break
    assert {1, 2, 3, 5, 6} <= seen, "each phase that lasts was shown"
    assert page.probe.result.text().startswith("Contact on")
    assert "largest Fz" in page.probe.result.text()
    assert main.workspaces["stack"].presenter.story.head is None, "a probe is no stacking run"
    patch, shown = main.workspaces["operate"].probe.patch, page.belief.scene
    where = np.array(patch.offset_mm)
    cells = shown.belief.cell_centres_mm()[shown.belief.covered]
    found = shown.belief.probability[shown.belief.covered]
    order, points = np.lexsort(cells.T), patch.patch.points_mm + where
    assert cells[order] == pytest.approx(points[np.lexsort(points.T)])
    felt = np.clip(patch.patch.probability[np.lexsort(points.T)], 0.02, 0.98)
    assert found[order] == pytest.approx(felt)
    hull = MultiPoint(points[patch.patch.probability > 0.9]).convex_hull
    assert shown.stability.margin_mm == pytest.approx(
        hull.exterior.distance(Point(where)), abs=1e-6
    )
    assert page.belief_panel.detail.text().startswith("margin ")
    bench = page.side.scene
    assert (bench.piece.x_mm, bench.piece.y_mm) == pytest.approx(where, abs=0.3)
    page.gripper.open.click()
    assert session.devices["gripper"].status().holding
    answers = [
        b for b in main.cards.findChildren(type(page.gripper.open)) if "let it go" in b.text()
    ]
    answers[0].click()
    turn(main, session, 3.0)
    assert not session.devices["gripper"].status().holding


@pytest.mark.promise("W4")
def test_a_refused_step_names_axis_and_way_left(desk):
    main, session = desk
    jog = session.hand.jog
    motion = session._stage.arm.move_to(Pose(0.0, 0.0, 397.0), 50.0)
    while not motion.done:
        session.advance()
    page = main.workspaces["operate"].page
    for _ in range(4):
        main.actions.action("operate.longer").trigger()
    assert page.jog.pace.step == 5.0
    QTest.mousePress(page.jog.pads["+z"], Qt.MouseButton.LeftButton)
    assert not jog.active
    assert "+Z (XYZ): 3.0 mm left" in main.cards.card("LIMIT").text.what


def test_the_bench_is_set_anew_with_another_piece(desk):
    main, session = desk
    page = main.workspaces["operate"].page
    page.gripper.grip.click()
    turn(main, session, 1.0)
    page.scene.piece.setCurrentIndex(page.scene.piece.findData("barrel"))
    page.scene.bottom.setCurrentIndex(page.scene.bottom.findData("circle25"))
    main.actions.action("operate.scene").trigger()
    turn(main, session, 0.3)
    assert session._stage.piece.name == "barrel"
    assert not session.devices["gripper"].status().holding
    assert "barrel above circle25" in main.window._message.text()
    QTest.mousePress(page.jog.pads["+z"], Qt.MouseButton.LeftButton)
    assert session.hand.jog.active, "the new scene has its own hand"
    QTest.mouseRelease(page.jog.pads["+z"], Qt.MouseButton.LeftButton)


def test_closing_asks_while_a_piece_is_held(desk):
    main, session = desk
    main.workspaces["operate"].page.gripper.grip.click()
    turn(main, session, 1.0)
    main.window.close()
    assert main.window.isVisible()
    answers = {b.text(): b for b in main.cards.findChildren(QPushButton)}
    assert "Keep running" not in answers, "nothing runs"
    answers["Close, keep the grip"].click()
    assert not main.window.isVisible()
    assert session.devices["gripper"].status().holding, "closing never opens the gripper"


def test_another_length_of_the_traces_shows_what_the_stream_still_holds(desk):
    main, session = desk
    turn(main, session, 2.0)
    page = main.workspaces["operate"].page
    page.span.setCurrentIndex(2)
    age_s, low, _ = page.force.buckets.ordered()
    assert age_s[0] == pytest.approx(-60.0, abs=0.2)
    shown_s = np.isfinite(low[:, 2]).sum() * 60.0 / len(age_s)
    assert shown_s == pytest.approx(session.clock_s(), abs=0.4)
    page.pause.click()
    before = page.force.buckets.last.copy()
    turn(main, session, 0.3)
    assert np.array_equal(page.force.buckets.last, before)
    page.pause.click()
    turn(main, session, 0.1)
    assert not np.array_equal(page.force.buckets.last, before)
