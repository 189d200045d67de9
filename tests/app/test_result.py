"""The calibration wizard: what holds, measure, the residual against its limit, accept or repeat."""

from __future__ import annotations

import ast
import importlib
import json
import re
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path

import pytest
from PySide6.QtCore import QRect, QSize, Qt
from PySide6.QtGui import QAccessible
from PySide6.QtWidgets import QApplication, QLabel, QPushButton

from tests.app.conftest import settle
from tests.backend.bench.brisk import brisk_method
from tests.backend.runs.oracle_bench import OracleSession, request
from tests.journeys.operate_desk import SteppedSession
from tests.prompt_window import PACES
from tests.screen_check import view_failures
from touchdown import resources
from touchdown.app.__main__ import parser
from touchdown.app.start import open_bench
from touchdown.backend.calibration.records import CalibrationStore, read_record
from touchdown.backend.calibration.result import CALIBRATION_KINDS, CALIBRATION_NAMES
from touchdown.backend.config.method import PolicySettings
from touchdown.backend.core.events import (
    CalibrationMeasured,
    HandOverAwaited,
    Progress,
    RunFinished,
    RunStarted,
)
from touchdown.backend.core.faults import InputError
from touchdown.backend.devices.protocols import Health, SafetyMode
from touchdown.backend.runs.requests import CalibrateRequest, RunState
from touchdown.widgets.base.freshness import BUDGET_S
from touchdown.widgets.forms import PoseReadout
from touchdown.widgets.shell import state

GOOD = CalibrationMeasured(
    0.0, "payload",
    names=("mass_kg", "com_x_mm", "com_y_mm"), values=(1.502, -0.3, 0.1),
    sigmas=(0.004, 0.15, 0.15), units=("kg", "mm", "mm"),
    residuals=(0.01, 0.02, 0.015, 0.01, 0.02, 0.012), residual=0.02, limit=0.3, unit="N",
    note="The hand stayed level.", obstacle="",
)  # fmt: skip


@pytest.fixture
def wizard(live, bench, tmp_path):
    """The wizard open on a bench with an empty folder of calibrations."""
    bench.calibrations = CalibrationStore(tmp_path / "calibrations", "simulated")
    live.actions.action("calibrate").trigger()
    live.wizard = live.panels.calibrate.sheet
    return live


def shown(live):
    settle(live)
    live.panels.calibrate.draw(at_once=True)
    return live.wizard


def told(live, bench, fact, ending="finished", reason=""):
    """Announce a whole calibration run."""
    what = fact.what if fact is not None else "payload"
    bench.set_state(RunState.RUNNING)
    bench.events.publish(
        RunStarted(0.0, "r", "pot", "square15", what, 0, 1, True, "{}", "calibrate")
    )
    bench.events.publish(Progress(0.0, 2, 6, "pose 3 of 6"))
    middle = shown(live)
    assert (middle.progress.value(), middle.progress.format()) == (2, "pose 3 of 6")
    assert middle.cancel.isEnabled()
    assert not middle.measure.isEnabled()
    if fact is not None:
        bench.events.publish(fact)
    bench.events.publish(RunFinished(0.0, "r", ending, reason))
    bench.set_state(RunState.IDLE)
    return shown(live)


def test_it_opens_with_what_holds_and_what_to_do(wizard) -> None:
    sheet = shown(wizard)
    assert [c.text() for c in sheet.conditions] == [
        *5 * ["Never calibrated on this bench"], "Never checked on this bench",
    ]  # fmt: skip
    assert sheet.title.text() == "Calibrate: Payload"
    assert sheet.steps[0].text().startswith("1  Empty the gripper")
    assert not sheet.form.isVisible()
    assert sheet.live.text().startswith("F ")
    assert not sheet.accept_it.isEnabled()


def test_identify_shows_progress_verdict_and_keeps_what_is_accepted(wizard, tmp_path, monkeypatch):
    monkeypatch.setenv("TOUCHDOWN_DATA", str(tmp_path))
    wizard.wizard.identify.click()
    sheet = wizard.panels.calibrate.identify
    assert sheet.isVisible()
    assert not sheet.accept_it.isEnabled()
    assert sheet.about.isVisible()
    sheet.show_line("fit, round 1: 523 of 1,104 ... about 1.5 min left")
    assert sheet.progress.isVisible()
    assert sheet.progress.value() == 523
    assert sheet.progress.text().startswith("fit, round 1: 47 % ... about 1.5 min left")
    sheet.show_end(2, "")
    assert not sheet.progress.isVisible()
    assert sheet.verdict.text().startswith("Cancelled")
    sheet.show_line(json.dumps({"error": {"what": "3 presses.", "where": "x", "fix": "Record."}}))
    sheet.show_end(2, "")
    assert sheet.verdict.text() == "3 presses. Record."
    found = {"accepted": True, "reason": "Accepted: 30 %.",
             "use": {"mu_grip": "yes", "wrist.white_n": "no, too uncertain",
                     "wrist.rate_hz": "yes"},
             "names": {"mu_grip": "Friction of the finger pads",
                       "wrist.white_n": "Noise of the wrist force",
                       "wrist.rate_hz": "Rate of the wrist sensor"},
             "report": str(tmp_path / "bench.html"),
             "verdicts": ["1 Sensors at rest. Identified.", "2 Arm and grasp. Identified."],
             "estimates": {"mu_grip": [0.7, 0.01, "1"], "wrist.white_n": [0.1, 0.1, "N"],
                           "wrist.rate_hz": [24351.2, 163.0, "Hz"]},
    }  # fmt: skip
    sheet.show_end(0, json.dumps(found))
    assert sheet.verdict.text() == "Accepted: 30 %."
    assert sheet.note.text() == "1 Sensors at rest. Identified.\n2 Arm and grasp. Identified."
    assert sheet.note.isVisible()
    assert not sheet.about.isVisible()
    assert sheet.table.texts() == [
        ["Friction of the finger pads", "0.7", "0.01", "yes"],
        ["Noise of the wrist force", "0.1 N", "0.1", "no, too uncertain"],
        ["Rate of the wrist sensor", "24350 Hz", "160", "yes"],
    ]
    assert sheet.table.item(1, 0).toolTip() == "wrist.white_n"
    sheet._draft = tmp_path / "draft.toml"
    sheet._draft.write_text("preset = 'mixed'\n")
    sheet.accept_it.click()
    (kept,) = (tmp_path / "benches").iterdir()
    assert kept.read_text() == "preset = 'mixed'\n"
    assert str(kept) in sheet.note.text()
    assert not sheet.accept_it.isEnabled()


def test_a_refused_identification_can_not_be_accepted(wizard):
    wizard.wizard.identify.click()
    sheet = wizard.panels.calibrate.identify
    found = {"accepted": False, "reason": "Refused.", "use": {}, "report": "/x.html",
             "estimates": {}}  # fmt: skip
    sheet.show_end(1, json.dumps(found))
    assert not sheet.accept_it.isEnabled()
    assert sheet.verdict.property("tone") == "bad"


def test_measuring_asks_the_bench_for_what_is_chosen(wizard, bench) -> None:
    sheet = shown(wizard)
    sheet.choices[CALIBRATION_NAMES.index("board")].click()
    assert sheet.form.isVisible()
    sheet.form.x_mm.setValue(1.5)
    sheet.form.bottom.setCurrentText("rect12x28")
    sheet.measure.click()
    assert bench.started == [CalibrateRequest("board", bottom="rect12x28", origin_mm=(1.5, 0.0))]
    # Nothing else can be chosen meanwhile.
    assert not any(choice.isEnabled() for choice in shown(wizard).choices)
    sheet.cancel.click()
    assert bench.engine.orders == ["cancel"]


def test_a_good_result_is_shown_with_its_residual_and_kept_once_accepted(wizard, bench) -> None:
    sheet = told(wizard, bench, GOOD)
    assert sheet.figure.text() == "Residual 0.02 N, within the limit of 0.3 N."
    assert sheet.figure.property("tone") == "good"
    assert sheet.table.texts()[0][:2] == ["Mass", "1.5020 \N{PLUS-MINUS SIGN} 0.0040 kg"]
    assert "limit 0.300" in sheet.plot.accessibleDescription()
    assert sheet.measure.text() == "Repeat"
    assert list(bench.calibrations.folder.glob("*")) == []
    sheet.accept_it.click()
    (path,) = bench.calibrations.folder.glob("*.json")
    record = read_record(path)
    assert record.file.values["mass_kg"].value == 1.502
    assert set(record.file.devices) == {"force_torque", "gripper"}
    assert sheet.conditions[0].text() == "0.02 of 0.3 N, holds 89 days"
    assert f"Accepted: {path.name}" in sheet.note.text()
    assert not sheet.accept_it.isEnabled()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"residual": 0.4}, "beyond the limit"),
        ({"obstacle": "Turn ft.rotation."}, "Turn ft.rotation."),
    ],
)
def test_a_bad_result_can_only_be_repeated(wizard, bench, change, said) -> None:
    sheet = told(wizard, bench, replace(GOOD, **change))
    assert said in f"{sheet.figure.text()} {sheet.note.text()}"
    assert "bad" in (sheet.figure.property("tone"), sheet.note.property("tone"))
    assert not sheet.accept_it.isEnabled()
    assert sheet.measure.isEnabled()


def test_a_run_that_ended_early_says_why(wizard, bench) -> None:
    sheet = told(wizard, bench, None, "failed", "A piece is held: put it away. [HOLDING]")
    assert "A piece is held" in sheet.note.text()
    assert not sheet.accept_it.isEnabled()


def test_it_cannot_measure_after_a_stop(wizard, bench) -> None:
    bench.stop()
    sheet = shown(wizard)
    assert not sheet.measure.isEnabled()
    assert sheet.measure.toolTip() == "Press Reset first"


def test_the_hand_over_is_confirmed_in_the_wizard(wizard, bench) -> None:
    bench.set_state(RunState.RUNNING)
    bench.events.publish(
        RunStarted(0.0, "r", "pot", "square15", "board", 0, 1, True, "{}", "calibrate")
    )
    bench.events.publish(HandOverAwaited(0.0, "pot", True))
    sheet = shown(wizard)
    assert sheet.question.isVisible()
    sheet.question.yes.click()
    assert bench.answers == [True]
    bench.events.publish(HandOverAwaited(0.0, "pot", False))
    assert shown(wizard).question.isVisible()
    sheet.question.no.click()
    assert bench.engine.orders == ["cancel"]
    assert bench.answers == [True]


def test_accepted_cameras_say_from_when_on_they_are_read_so(wizard, bench) -> None:
    names = CALIBRATION_KINDS["camera"].values
    found = replace(GOOD, what="camera", names=("exchanged", "left_mirror", "right_mirror", *names),
                    values=(0.0, 0.0, 0.0, 0.06, 0.06, 0.06, 0.06), sigmas=7 * (0.0,),
                    units=7 * ("",))  # fmt: skip
    shown(wizard).choices[CALIBRATION_NAMES.index("camera")].click()
    sheet = told(wizard, bench, found)
    sheet.accept_it.click()
    assert "until the bench is started again" in sheet.note.text()


def test_an_expired_calibration_is_red_with_its_date_and_person(wizard, bench, far_east) -> None:
    assert shown(wizard).plot.empty == "Measure first."
    bench.calibrations.accept(GOOD, {}, "Ada", datetime(2020, 1, 1, 12, tzinfo=UTC))
    wizard.panels.calibrate.open()
    sheet = shown(wizard)
    assert sheet.plot.empty == "Last measured 2020-01-01 17:45 by Ada: 0.02 N."
    assert "Ada" in sheet.plot.accessibleDescription()
    assert sheet.conditions[0].text().startswith("Expired")
    assert sheet.conditions[0].property("tone") == "bad"


def test_the_daily_check_shows_its_history_and_what_to_do(wizard, bench) -> None:
    wizard.actions.action("check-day").trigger()
    assert shown(wizard).plot.empty == "Measure first."
    names = ("left_markers", "wrist_noise_n")
    for noise_n, age in ((0.1, timedelta(days=1)), (0.3, timedelta())):
        found = replace(
            GOOD, what="day", names=names, values=(63.0, noise_n), sigmas=(0.0, 0.0),
            units=("", "N"), residuals=(),
        )  # fmt: skip
        sheet = told(wizard, bench, bench.day_checks.judge(found, datetime.now(UTC) - age))
        # Today's result takes the place of the steps.
        assert any(step.isVisible() for step in sheet.steps) == bool(age)
    assert sheet.title.text() == "Calibrate: Daily check"
    assert sheet.figure.text().endswith(": out of limits.")
    assert sheet.note.text() == (
        "Noise at rest, wrist sensor: 0.3, above 0.2 N. Check its cable and earth, and what shakes "
        "the table.\n"
        "Then press Measure to check again: it first puts the held piece back in its jig."
    )
    cross = "\N{MULTIPLICATION X}"
    assert sheet.table.texts() == [
        [f"{cross} Noise at rest, wrist sensor", "0.3 N", "0 to 0.2"],
        ["Number of markers, left finger", "63", "60 to 63"],
    ]
    assert sheet.conditions[5].text().startswith("Out of limits on")
    assert not sheet.accept_it.isEnabled()
    assert {line.name: len(line.points) for line in sheet.plot.lines if line.points} == {
        "limit": 2, "markers": 2, "wrist noise": 2,
    }  # fmt: skip


def test_only_the_cameras_ask_for_the_pitch_of_the_dots(wizard) -> None:
    sheet = shown(wizard)
    for what in ("board", "tool", "camera"):
        sheet.choices[CALIBRATION_NAMES.index(what)].click()
        assert sheet.form.bottom.isVisible()
        assert sheet.form.pitch_mm.isVisible() == (what == "camera")


def test_other_runs_leave_the_wizard_alone(wizard, bench) -> None:
    bench.tell_start()
    bench.events.publish(Progress(0.0, 1, 2, "half"))
    assert shown(wizard).progress.value() == 0
    bench.tell_finish()


def pass_s(live, bench, seconds):
    """Let time pass by the bench's own clock, and show it."""
    for _ in range(round(seconds / 0.1)):
        bench.turn(0.1)
        settle(live, 4)


def states(live):
    return {name: chip.value.state for name, chip in live.bar.chips.items()}


@pytest.mark.promise("W6")
def test_a_device_that_drops_out_changes_only_its_own_chip(live, bench):
    live._chips._now_s = bench.clock_s
    live._chips._drawn_s = float("-inf")
    pass_s(live, bench, 0.6)
    assert set(states(live)) == set(bench.devices)
    assert set(states(live).values()) == {"ready"}
    for lost, (name, device) in enumerate(bench.devices.items(), start=5):
        bench.silent.add(name)
        device.received, device.lost = 20, lost
        pass_s(live, bench, 0.8)
        assert {n for n, state in states(live).items() if state != "ready"} == {name}
        assert states(live)[name] == "stale"
        shown = {n: chip.value.lost for n, chip in live.bar.chips.items()}
        assert shown == {n: lost if n == name else 0 for n in shown}
        assert f"{lost} " in live.bar.chips[name].toolTip()
        bench.silent.clear()
        device.received, device.lost = 5000, 0
        pass_s(live, bench, 0.6)
        assert set(states(live).values()) == {"ready"}, "it comes back by itself"


def test_a_device_without_a_sample_has_no_age_yet(live, bench, monkeypatch):
    silent = Health(0.0, float("inf"), 0, 0)
    monkeypatch.setattr(type(bench.devices["arm"]), "health", silent)
    # On a busy computer the chip would become stale meanwhile.
    now_s = live._chips._now_s()
    monkeypatch.setattr(live._chips, "_now_s", lambda: now_s)
    live._chips._drawn_s = float("-inf")
    settle(live)
    assert "no data yet" in live.bar.chips["arm"].value.detail


@pytest.mark.parametrize(
    ("simulated", "safety", "told"),
    [
        (True, SafetyMode.NORMAL, "none"),
        (False, SafetyMode.NORMAL, "unknown"),
        (False, SafetyMode.HW_STOP, "active"),
    ],
)
def test_a_hardware_emergency_stop_is_told_as_far_as_it_is_known(
    live, bench, monkeypatch, simulated, safety, told
):
    arm = bench.devices["arm"]
    status = replace(arm.status(), safety_mode=safety)
    monkeypatch.setattr(arm, "status", lambda: status)
    monkeypatch.setattr(bench, "simulated", simulated)
    live._chips._drawn_s = float("-inf")
    settle(live)
    assert live.bar._estop.text() == told


@pytest.mark.promise("W9")
@pytest.mark.parametrize("scale", [0.8, 1.0, 2.0])
def test_no_text_is_cut_off_on_any_page_at_any_scale(live, scale):
    live.window.resize(1280, 720)
    live.look.show("dark", scale)
    cut = []
    for name, workspace in live.workspaces.items():
        live.go(name)
        QApplication.processEvents()
        for kind in (QLabel, QPushButton):
            cut += [
                (name, widget.text())
                for widget in workspace.page.findChildren(kind)
                if widget.isVisible() and widget.text()
                and not (isinstance(widget, QLabel) and widget.wordWrap())
                and widget.sizePolicy().horizontalPolicy() is not widget.sizePolicy().Policy.Ignored
                and widget.width() < widget.minimumSizeHint().width() - 1
            ]  # fmt: skip
    rail = list(live.window.rail.values())
    for upper, lower in pairwise(rail):
        assert upper.geometry().bottom() < lower.geometry().top()
        assert upper.height() >= upper.sizeHint().height()
    stop = live.bar.stop
    corner = stop.mapTo(live.window, stop.rect().bottomRight())
    assert QRect(live.window.rect()).contains(corner)
    live.look.show("dark", 1.0)
    assert cut == []


@pytest.mark.parametrize("page", ["operate", "stack", "review"])
def test_small_screens_cut_off_no_number_and_reach_every_control(live, page):
    """A part of ``make screens CHECK=1``."""
    live.go(page)
    settle(live)
    sizes = (1280, 720), (819, 614), (512, 384)
    assert [view_failures(live.window, QSize(*size)) for size in sizes] == [[], [], []]


def test_a_long_message_of_the_foot_is_shown_whole(live):
    live.window.resize(1280, 720)
    live.say("Every word of this sentence can be read. " * 6)
    settle(live)
    message = live.window._message
    assert message.height() >= message.heightForWidth(message.width()) > 30
    assert view_failures(live.window, QSize(1280, 720)) == []


def test_cards_scroll_in_a_low_window_and_the_message_has_a_line_of_its_own(live, bench):
    live.go("stack")
    bench.tell_start()
    bench.tell_probe(1, (7.2, 3.1), -2.1)
    bench.tell_fault()
    live.stop()
    live.cards.card("STOPPED").more.click()
    settle(live)
    assert view_failures(live.window, QSize(512, 384)) == []
    message, banner = live.window._message, live.window._banner
    assert message.text() != ""
    assert message.geometry().bottom() < banner.y()
    live.window.resize(1280, 720)
    settle(live)
    assert abs(message.geometry().center().y() - banner.geometry().center().y()) <= 1
    live.reset()
    settle(live)
    assert live.window._scrolls["stack"].verticalScrollBar().maximum() == 0


@pytest.mark.parametrize("name", ["operate", "collect", "train", "stack", "review"])
def test_every_page_fits_the_smallest_usual_window(live, name) -> None:
    live.window.resize(1280, 720)
    live.window.show()
    live.go(name)
    settle(live)
    assert live.window._scrolls[name].horizontalScrollBar().maximum() == 0


def test_the_largest_pose_is_shown_in_full_in_the_smallest_usual_window(live):
    live.window.resize(1280, 720)
    live.go("operate")
    jog = live.workspaces["operate"].page.jog
    jog.show_turning("")
    settle(live)
    jog.show_look(PoseReadout("X \N{MINUS SIGN}140.0   Y \N{MINUS SIGN}140.0   Z 333.3 mm"))
    assert jog._pose.shown() == jog._pose.text()


@pytest.mark.promise("W9")
def test_at_200_percent_every_control_can_be_reached(live):
    """What does not fit is scrolled to when it gets the focus."""
    live.window.resize(1280, 720)
    live.look.show("dark", 2.0)
    live.go("stack")
    QApplication.processEvents()
    scroll = live.window._scrolls["stack"]
    assert scroll.horizontalScrollBar().maximum() > 0
    for control in (
        live.workspaces["stack"].page.run.start,
        live.workspaces["stack"].page.run._mode,
    ):
        scroll.ensureWidgetVisible(control)
        seen = control.mapTo(scroll.viewport(), control.rect().center())
        assert scroll.viewport().rect().contains(seen)
    live.look.show("dark", 1.0)


def test_a_page_begins_without_a_chosen_control(live):
    live.go("stack")
    live.workspaces["stack"].page.run._seed.setFocus()
    live.go("operate")
    focus = QApplication.focusWidget()
    assert focus is None or not live.workspaces["operate"].page.isAncestorOf(focus)


@pytest.mark.promise("W12")
def test_a_change_of_state_is_announced(live, bench, monkeypatch):
    said = []
    monkeypatch.setattr(QAccessible, "isActive", staticmethod(lambda: True))
    monkeypatch.setattr(
        state.QAccessible, "updateAccessibility",
        staticmethod(lambda event: said.append(event.message())),
    )  # fmt: skip
    bench.set_state(RunState.RUNNING)
    settle(live)
    live.stop()
    settle(live)
    assert said == ["RUNNING", "STOPPED"]


@pytest.mark.promise("W8")
def test_reset_of_the_layout_puts_the_page_back(live):
    live.go("operate")
    page = live.workspaces["operate"].page
    page.looks.setCurrentIndex(2)
    page.span.setCurrentIndex(1)
    live.window.resize(1300, 730)
    live.actions.action("layout").trigger()
    assert page.looks.currentIndex() == page.span.currentIndex() == 0
    # Its usual size, or what the screen has room for.
    room = live.window.screen().availableSize()
    usual = QSize(1600, 940).boundedTo(room).expandedTo(live.window.minimumSize())
    assert live.window.size() == usual


@pytest.mark.promise("D9")
def test_every_label_shows_text_and_no_markup(live, bench):
    for page in ("operate", "collect", "train", "stack", "review"):
        live.go(page)
        settle(live)
    labels = live.window.findChildren(QLabel)
    assert len(labels) > 100
    # A picture has no text; any other label would guess.
    marked = [one for one in labels if one.textFormat() != Qt.TextFormat.PlainText]
    assert [one.text() for one in marked if one.text()] == []


APP = Path(__file__).resolve().parents[2] / "app"


def compared(tree):
    """Names that a difference to an earlier ``now_s`` is compared with."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare) and isinstance(node.left, ast.BinOp):
            names = {n.id for n in ast.walk(node.left) if isinstance(n, ast.Name)}
            if isinstance(node.left.op, ast.Sub) and "now_s" in names:
                yield from (right.id for right in node.comparators if isinstance(right, ast.Name))


NO_PACE = {("touchdown.app.calibrate.presenter", "STANDINGS_S"),
           ("touchdown.app.collect.origin", "WINDOW_S"),
           ("touchdown.app.label.editing", "PAUSE_S"),
           ("touchdown.app.shell.live", "CALM_AFTER_S")}  # fmt: skip
"""Compared likewise, but nothing is drawn by it at once."""


def test_every_pace_of_the_window_is_known():
    found = set()
    for path in APP.rglob("*.py"):
        text = path.read_text("utf-8")
        if "now_s -" in text:
            module = ".".join(("touchdown", *path.relative_to(APP.parent).with_suffix("").parts))
            found |= {(module, name) for name in compared(ast.parse(text))}
    assert found == NO_PACE | set(PACES.items())


def test_everything_is_due_at_every_turn(main):
    assert main.pump._budget_s == float("inf")
    assert [getattr(importlib.import_module(module), name) for module, name in PACES.items()] == [
        0.0
    ] * len(PACES)


@pytest.mark.usual_pace
def test_a_test_of_the_pace_has_the_one_of_its_users(main):
    assert main.pump._budget_s == BUDGET_S
    assert all(getattr(importlib.import_module(m), name) > 0.0 for m, name in PACES.items())


ROOT = Path(__file__).resolve().parents[2]
LEAVING = re.compile(r"(?<!sys)(?<!parser)\.(quit|exit)\(")
LIMIT_S = 60.0
ASKED = """
import sys, threading
from PySide6.QtCore import QMetaObject, Qt
from PySide6.QtWidgets import QApplication, QWidget
from touchdown.app.shell.cards import exit_after_timeout

app = QApplication([])
window = QWidget()
window.show()

def ask():
    QMetaObject.invokeMethod(app, "quit", Qt.ConnectionType.QueuedConnection)

workers = [threading.Thread(target=ask) for _ in range(8)]
for worker in workers:
    worker.start()
status = app.exec()
for worker in workers:
    worker.join()
# Only now: a thread that hangs must not keep what has ended.
threading.Thread(target=threading.Event().wait).start()
exit_after_timeout(0.1)
sys.exit(2 + status)
"""


@pytest.mark.promise("P5")
def test_no_part_that_runs_on_workers_ends_the_program() -> None:
    found = {
        str(path.relative_to(ROOT))
        for folder in ("backend", "widgets", "app")
        for path in (ROOT / folder).rglob("*.py")
        if LEAVING.search(path.read_text())
    }
    # The window alone, on its own thread.
    assert found == {"app/application.py"}


@pytest.mark.promise("P5")
def test_asked_for_through_the_queue_the_end_comes_whoever_asks_and_whatever_hangs() -> None:
    command = [sys.executable, "-c", ASKED]
    done = subprocess.run(command, cwd=ROOT, timeout=LIMIT_S, check=False)
    assert done.returncode == 1, "ended by force, after the event loop had ended by itself"


STEPS_A_DRAW = 25
TWO_PROBES = brisk_method().model_copy(update={"policy": PolicySettings(max_probes=2)})


@pytest.mark.promise("W17")
def test_the_run_of_a_window_tells_the_same_facts_as_one_without(main, qtbot):
    alone = OracleSession(method=TWO_PROBES)
    alone.session.run(request(trials=1))
    seen = OracleSession(method=TWO_PROBES)
    seen.session.prepare(request(seed=99).scene())
    main.attach(SteppedSession(seen.session))
    main.window.show()
    seen.session.start(request(trials=1))
    for step in range(20_000):
        seen.session.engine.tick()
        seen.session.advance()
        if step % STEPS_A_DRAW == 0:
            main.pump.tick()
        if seen.of(RunFinished):
            break
    settle(main, 60)
    assert seen.record() == alone.record()
    story = main.workspaces["stack"].presenter.story
    assert len(story.trials[-1].probes) == len(alone.oracles[-1].asked)


LAB = Path(resources.__path__[0]) / "benches" / "lab.toml"


def test_faults_on_demand_are_for_the_simulated_bench():
    args = parser().parse_args(["--inject", "arm:stall@3", "--inject", "gripper:stall@4"])
    assert args.inject == ["arm:stall@3", "gripper:stall@4"]
    with pytest.raises(InputError, match="Only the simulated bench"):
        open_bench(LAB, tuple(args.inject))


def test_a_fault_that_does_not_exist_is_named_before_the_bench_is_built():
    with pytest.raises(InputError, match="cup"):
        open_bench(None, ("cup:stop@3",))
