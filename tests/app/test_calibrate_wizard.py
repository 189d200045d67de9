"""The calibration wizard: what holds, measure, the residual against its limit, accept or repeat."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import pytest

from tests.app.conftest import settle
from touchdown.backend.calibration.records import CalibrationStore, read_record
from touchdown.backend.calibration.result import CALIBRATION_KINDS, CALIBRATION_NAMES
from touchdown.backend.core.events import (
    CalibrationMeasured,
    HandOverAwaited,
    Progress,
    RunFinished,
    RunStarted,
)
from touchdown.backend.runs.requests import CalibrateRequest, RunState

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
    assert [c.text() for c in sheet.conditions] == 5 * ["Never calibrated on this bench"]
    assert sheet.title.text() == "Payload"
    assert sheet.steps[0].text().startswith("1  Empty the gripper")
    assert not sheet.form.isVisible()
    assert sheet.live.text().startswith("F ")
    assert not sheet.accept_it.isEnabled()


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
    assert (sheet.names[0].text(), sheet.values[0].text()) == (
        "Mass", "1.5020 \N{PLUS-MINUS SIGN} 0.0040 kg",
    )  # fmt: skip
    assert "limit 0.3 N" in sheet.bars.accessibleDescription()
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


def test_an_expired_calibration_is_red_and_named(wizard, bench) -> None:
    old = datetime(2020, 1, 1, tzinfo=UTC)
    bench.calibrations.accept(GOOD, {}, now=old)
    live = wizard
    live.panels.calibrate.open()
    sheet = shown(live)
    assert sheet.conditions[0].text().startswith("Expired")
    assert sheet.conditions[0].property("tone") == "bad"


def test_a_page_says_when_and_by_whom_it_was_measured_last(wizard, bench) -> None:
    assert shown(wizard).bars.empty == "Measure first."
    bench.calibrations.accept(GOOD, {}, "Ada", datetime(2020, 1, 1, 12, tzinfo=UTC))
    wizard.panels.calibrate.open()
    sheet = shown(wizard)
    assert sheet.bars.empty == "Last measured 2020-01-01 12:00 UTC by Ada: 0.02 N."
    assert "Ada" in sheet.bars.accessibleDescription()


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
