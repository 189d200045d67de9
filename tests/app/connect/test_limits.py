"""The Connect panel and the limits: every step shown, nothing changed without a second word."""

import math

import pytest
from PySide6.QtWidgets import QApplication

from tests.app.conftest import settle
from tests.backend.devices.waiting import until
from tests.backend.rig.scripted import LINES, held, scripted
from touchdown.app.connect.limits import TITLES, limit_rows, limit_unit
from touchdown.app.connect.presenter import device_row
from touchdown.app.shell.bench_text import bench_caption
from touchdown.backend.config import Limits
from touchdown.backend.config.bench_description import BenchDescription
from touchdown.backend.core.faults import Fault, RefusedError
from touchdown.backend.devices import DeviceState, Identity
from touchdown.backend.rig.connection import BenchConnection, DeviceStatus
from touchdown.backend.runs.requests import SceneChoice

FAULT = Fault("LINK", "The camera is lost.", "It stands.", "Plug it in.", "tactile_left")
WHO = Identity("Maker", "Model", "7", "1")


@pytest.fixture
def devices():
    return scripted()[0]


@pytest.fixture
def lab(main, bench, devices):
    """The window on the stand-in bench, as if its devices were connected by hand."""
    bench.connection, bench.name = BenchConnection(devices), "Bench 2"
    bench.description, bench.simulated = BenchDescription(mode="hardware"), False
    bench.limits_source, bench.left = "lab.toml", []
    bench.usual = SceneChoice("barrel", ("long", "hex20"))
    bench.leave_scene = lambda: bench.left.append("scene")
    bench.home_gripper = lambda: bench.left.append("homed")
    main.attach(bench)
    yield main
    bench.connection.close()


def shown(main):
    main.panels.connect.draw(at_once=True)
    return main.panels.connect.sheet


def wait(bench):
    until(lambda: not bench.connection.busy)


@pytest.mark.promise("W15")
def test_the_forms_begin_with_what_is_on_the_bench_and_each_move_is_asked_for(lab):
    """As the lab file has it, a tower with both of its bodies."""
    run, target = lab.workspaces["stack"].page.run.form(), lab.workspaces["collect"].presenter
    assert (run.piece, run.under, run.bottom) == ("barrel", "long", "hex20")
    assert (run.mode, run.trials, run.strategy) == ("approve", 3, "paper")
    form = target._page.target.form()
    assert (form.piece, form.bottom) == ("barrel", "hex20")
    lab.panels.calibrate.open()
    request = lab.panels.calibrate.sheet.form.request("board")
    assert (request.piece, request.bottom) == ("barrel", "hex20")


@pytest.mark.parametrize(
    ("mode", "banner", "striped", "note"),
    [
        ("simulated", "SIMULATED BENCH", True, "simulated"),
        ("emulated", "EMULATED BENCH", True, "emulated"),
        ("hardware", "Bench 2", False, ""),
    ],
)
def test_each_kind_of_bench_has_its_own_words(bench, mode, banner, striped, note):
    bench.description, bench.name = BenchDescription(mode=mode), "Bench 2"
    words = bench_caption(bench)
    assert (words.banner, words.striped, words.note) == (banner, striped, note)
    assert ("SIMULATED" in words.title) is (mode == "simulated")
    assert ("EMULATED" in words.title) is (mode == "emulated")


def test_what_is_to_be_known_of_a_device_stands_in_its_row_though_it_is_ready():
    look = device_row(DeviceStatus("arm", "ready", 4, WHO, notice="It came late."), can=True)
    assert (look.text, look.bad) == ("Maker Model, 7. It came late.", True)


@pytest.mark.parametrize(
    ("line", "marks", "label"),
    [
        (DeviceStatus("arm", "closed", 0), "open open open open", "Connect"),
        (DeviceStatus("arm", "connecting", 2), "done done now open", "Connect"),
        (DeviceStatus("arm", "ready", 4, WHO), "done done done done", "Disconnect"),
        (DeviceStatus("arm", "failed", 1, None, FAULT), "done failed open open", "Retry"),
        (DeviceStatus("arm", "failed", 4, WHO, FAULT), "done done done failed", "Retry"),
    ],
)
def test_the_marks_of_a_row_say_how_far_it_came(line, marks, label):
    look = device_row(line, can=True)
    assert (" ".join(look.marks), look.label) == (marks, label)
    if line.fault is not None:
        assert look.text == "The camera is lost. Plug it in."


@pytest.mark.promise("W1")
def test_real_devices_take_the_words_of_the_simulation_away(lab):
    assert lab.window.windowTitle() == "Touchdown (Bench 2)"
    assert lab.window._banner._word == "Bench 2"
    settle(lab)
    assert lab.bar.pill.state.word == "NO DEVICES"
    assert "simulated" not in lab.bar.pill.state.note
    assert lab.bar.override.value() == 10


def test_without_devices_neither_grip_nor_markers_are_shown(lab, bench):
    operate, page = lab.workspaces["operate"], lab.workspaces["operate"].page
    lab.window.show()
    lab.go("operate")
    bench.turn(0.2)
    settle(lab)
    operate.live._headers_s = float("-inf")
    settle(lab)
    assert page.captions["left"].detail.text().startswith("61/63")
    bench.devices["tactile_left"].state = DeviceState.CLOSED
    operate.live._headers_s = float("-inf")
    page.gripper.show_status(24.0, 10.0, holding=True, moving=False)
    operate.hand._drawn_s = float("-inf")
    settle(lab)
    assert page.gripper.figures.text() == "No data"
    assert page.captions["left"].detail.text() == ""


def test_the_panel_is_there_at_once_and_connects_all(lab, bench, devices):
    assert lab.panels.connect.sheet.isVisible()
    devices["gripper"].hold = held()
    lab.panels.connect.sheet.connect_all.click()
    until(lambda: bench.connection.lines()[3].state == "connecting")
    sheet = shown(lab)
    assert [sheet.row(i)[0] for i in range(5)] == [*["ready"] * 3, "connecting", "waiting"]
    assert not sheet.connect_all.isEnabled()
    assert "3 of 5 connected. Nothing moves" in sheet.text.text()
    settle(lab)
    assert lab.bar.pill.state.word == "CONNECTING"
    devices["gripper"].hold.set()
    wait(bench)
    assert shown(lab).text.text() == "All devices are ready."


def test_one_that_failed_says_what_to_do_and_is_tried_alone(lab, bench, devices):
    devices["tactile_left"].fails_at = "identify"
    lab.panels.connect.sheet.connect_all.click()
    wait(bench)
    sheet = shown(lab)
    state, text, button, _ = sheet.row(1)
    assert (state, text) == ("failed", "tactile_left: identify. Look at it.")
    assert button.text() == "Retry"
    settle(lab)
    assert lab.bar.pill.state.word == "NOT READY"
    devices["tactile_left"].fails_at = ""
    button.click()
    wait(bench)
    assert shown(lab).row(1)[0] == "ready"


def test_a_long_reason_is_not_cut_off(lab, bench, devices):
    where = "/dev/serial/by-id/usb-FTDI_USB-RS422_Cable_FT4VA1B2-if00-port0"
    devices["force_torque"].fails_at = "reach"
    devices["force_torque"].name = f"could not open port {where}: No such file: {where}; " * 2
    lab.panels.connect.sheet.connect_all.click()
    wait(bench)
    sheet = shown(lab)
    settle(lab)
    text = sheet._rows[0].text
    assert where in text.text()
    assert text.height() >= text.heightForWidth(text.width())


def test_disconnecting_one_leaves_the_scene_first(lab, bench, devices):
    lab.panels.connect.sheet.connect_all.click()
    wait(bench)
    shown(lab).row(0)[2].click()
    wait(bench)
    assert bench.left == ["scene"]
    assert devices["force_torque"].state is DeviceState.CLOSED
    bench.leave_scene = lambda: (_ for _ in ()).throw(RefusedError("BUSY", "A run is going on."))
    shown(lab).row(1)[2].click()
    assert devices["tactile_left"].state is DeviceState.READY
    assert "BUSY" in lab.cards.codes


def test_the_key_opens_connects_and_cancels(lab, bench, devices):
    sheet = lab.panels.connect.sheet
    sheet.close()
    lab.actions.action("connect").trigger()
    assert sheet.isVisible()
    assert not bench.connection.busy
    devices["arm"].hold = held()
    lab.actions.action("connect").trigger()
    until(lambda: bench.connection.lines()[4].state == "connecting")
    lab.actions.action("connect").trigger()
    wait(bench)
    assert bench.connection.missing() == ("arm",)


def test_after_stop_nothing_is_connected_before_reset(lab, bench):
    lab.stop()
    lab.panels.connect.sheet.connect_all.click()
    assert not bench.connection.busy
    assert lab.cards.card("STOPPED").text.reset, "the refusal does not take the place of STOP"
    assert "press Reset" in lab.cards.card("NOT-RESET").text.what
    assert len(bench.connection.missing()) == len(LINES)


def test_every_limit_is_shown_with_its_unit():
    assert {row.name for row in limit_rows(Limits())} == {*Limits.model_fields}
    assert [limit_unit(n) for n in ("trip_nm", "trip_n", "jog_mm_s", "turn_rad_s", "tilt_rad")] == [
        "N\N{MIDDLE DOT}m", "N", "mm/s", "\N{DEGREE SIGN}/s", "\N{DEGREE SIGN}",
    ]  # fmt: skip
    assert len(TITLES) == len(limit_rows(Limits()))


def limits_sheet(main):
    main.actions.action("limits").trigger()
    return main.panels.limits.sheet


def test_limits_are_locked_and_change_on_the_second_word_only(lab, bench):
    sheet = limits_sheet(lab)
    assert sheet.source.text() == "From lab.toml."
    boxes = sheet.boxes.values()
    assert all(box.isReadOnly() and box.isEnabled() for box in boxes), "locked, yet legible"
    assert not sheet.take.isEnabled()
    sheet.edit.click()
    sheet.boxes["probe_n"].setValue(20.0)
    sheet.take.click()
    assert "Nominal press of a probe 30 \N{RIGHTWARDS ARROW} 20 N" in sheet.question.text.text()
    assert bench.interlock.limits == Limits()
    sheet.question.no.click()
    assert bench.interlock.limits == Limits()
    sheet.take.click()
    sheet.question.yes.click()
    assert bench.interlock.limits == Limits(probe_n=20.0)
    assert "changed at" in sheet.source.text()
    assert not sheet.take.isEnabled()


def test_limits_that_contradict_each_other_are_not_even_offered(lab, bench):
    sheet = limits_sheet(lab)
    sheet.edit.click()
    sheet.boxes["probe_n"].setValue(50.0)
    sheet.take.click()
    assert (
        sheet.said.text()
        == "'Nominal press of a probe' is above 'Stops motion, force (two samples)'."
    )
    assert not sheet.question.isVisible()


def test_what_turns_is_read_and_written_in_degrees(lab, bench):
    sheet = limits_sheet(lab)
    assert sheet.boxes["tilt_rad"].text() == "15.0\N{DEGREE SIGN}"
    assert sheet.boxes["turn_rad_s"].text() == "15.0\N{DEGREE SIGN}/s"
    sheet.edit.click()
    sheet.boxes["tilt_rad"].setValue(91.0)
    sheet.take.click()
    assert sheet.said.text() == "Lean of the hand: must be at most 90\N{DEGREE SIGN}."
    sheet.boxes["tilt_rad"].setValue(10.0)
    sheet.take.click()
    assert "Lean of the hand 15 \N{RIGHTWARDS ARROW} 10\N{DEGREE SIGN}?" in (
        sheet.question.text.text()
    )
    sheet.question.yes.click()
    # The speed of turning, whose digits no box shows, is not touched by it.
    assert bench.interlock.limits == Limits(tilt_rad=math.radians(10.0))


def test_limits_stay_while_something_moves(lab, bench):
    bench.interlock.renew_lease(bench.clock_s())
    sheet = limits_sheet(lab)
    sheet.edit.click()
    sheet.boxes["probe_n"].setValue(20.0)
    sheet.take.click()
    sheet.question.yes.click()
    assert bench.interlock.limits == Limits()
    assert "MOVING" in lab.cards.codes
    QApplication.processEvents()
