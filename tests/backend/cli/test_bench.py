"""Recovery without a window, and what is checked before a lab's devices are connected."""

from __future__ import annotations

import io
import json
from datetime import timedelta
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from tests.backend.bench.brisk import brisk_session, on
from tests.backend.rig.scripted import scripted
from tests.backend.runs.test_calibrated import NOW, WEIGHED, filled
from touchdown.backend.bench.laboratory import lab_session
from touchdown.backend.calibration.records import CalibrationStore, DeviceName
from touchdown.backend.cli.command_line import main
from touchdown.backend.cli.connection import held_piece_reported
from touchdown.backend.cli.output import VerbOutput, without_window
from touchdown.backend.cli.stack import narrate
from touchdown.backend.core import (
    Fault,
    FaultError,
    InputError,
    PhaseEntered,
    Progress,
    RefusedError,
)
from touchdown.backend.emulation.fault_plan import parse_fault
from touchdown.backend.rig.connection import BenchConnection
from touchdown.backend.runs.requests import ProbeRequest, SceneChoice


@pytest.fixture
def recovering(monkeypatch, lab, capsys):
    """A lab with scripted connections and simulated devices; ``run`` runs its verb."""
    session, (devices, log) = brisk_session(), scripted()
    session.connection = BenchConnection(devices)
    session.connection.when_ready = lambda: session.prepare(SceneChoice(estimates=False))
    monkeypatch.setattr("touchdown.backend.bench.lab_session", lambda *_, **__: session)

    def run(*words, typed=""):
        monkeypatch.setattr("sys.stdin", io.StringIO(typed))
        code = main(["bench", str(lab), *words])
        out, err = capsys.readouterr()
        return code, out, err

    return SimpleNamespace(session=session, devices=devices, log=log, run=run)


@pytest.mark.parametrize("action", ["status", "reset", "acknowledge", "lift", "open-jaws"])
def test_without_a_yes_nothing_is_connected(recovering, action):
    code, out, _ = recovering.run(f"--{action}", typed="\n")
    assert (code, recovering.log) == (1, [])
    assert out.endswith("Nothing was done.\n")
    assert recovering.run(f"--{action}", "--json")[0] == 2
    assert recovering.log == []


def test_status_names_the_state_and_moves_nothing(recovering):
    code, out, _ = recovering.run("--status", "--yes", "--json")
    told = json.loads(out)
    assert (code, told["holding"], told["powered"]) == (0, False, True)
    assert [device["state"] for device in told["devices"]] == ["ready"] * 5


def test_a_fault_at_connection_is_shown_with_its_command_and_reset_by_the_next(recovering, lab):
    arm, once = recovering.devices["arm"], []

    def refuse(timeout_s, cancel):
        if not once:
            once.append(1)
            raise FaultError(
                Fault("ALARM", "Error 2601.", "It stands.", "Then press Reset.", "arm")
            )
        type(arm).connect(arm, timeout_s, cancel)

    arm.connect = refuse
    code, out, _ = recovering.run("--status", "--yes")
    assert code == 1
    assert f"Then run 'touchdown bench {lab} --reset'." in out
    once.clear()
    devices = json.loads(recovering.run("--status", "--yes", "--json")[1])["devices"]
    assert any(f"Then run 'touchdown bench {lab} --reset'." in one["text"] for one in devices)
    once.clear()
    assert recovering.run("--reset", "--yes")[0] == 0


def test_the_arm_is_lifted_out_of_contact_and_the_jaws_open_after_a_second_yes(recovering):
    session = recovering.session
    session.connect()
    session.connection.when_ready = lambda: None
    on(session, PhaseEntered, lambda event: session.stop() if event.phase == "hold" else None)
    session.run(ProbeRequest())
    session.reset()
    session.advance()
    low_mm, close = session._stage.arm.pose(1.0).z_mm, session.close
    session.close = lambda: None
    assert session.hand.pressing_n > 2.0
    assert "lift first" in recovering.run("--status", "--yes")[1]
    code, out, _ = recovering.run("--lift", typed="y\n")
    assert code == 0
    assert f"The arm rose by 5.0 of 5 mm, to z = {low_mm + 5.0:.1f} mm." in out
    assert session._stage.arm.pose(1.0).z_mm == pytest.approx(low_mm + 5.0, abs=0.01)
    assert session.hand.pressing_n == 0.0
    code, out, _ = recovering.run("--open-jaws", typed="y\nn\n")
    assert (code, session.hand.holding) == (1, True)
    assert "Opening lets it go" in out
    code, out, _ = recovering.run("--open-jaws", typed="y\ny\n")
    assert (code, session.hand.holding) == (0, False)
    width_mm = session._stage.gripper.status().width_mm
    assert f"The jaws opened from {width_mm - 10.0:.1f} to {width_mm:.1f} mm." in out
    close()


def test_jaws_that_are_fully_open_already_are_no_failure(recovering, monkeypatch):
    monkeypatch.setattr("touchdown.backend.runs.manual_control.CLEAR_MM", 0.0)
    code, out, _ = recovering.run("--open-jaws", "--yes")
    assert code == 0
    assert "The jaws opened from" in out


def test_a_lift_that_ends_early_is_said_and_fails(recovering):
    session = recovering.session
    session.connect()
    session.connection.when_ready = lambda: None
    session.advance()
    begun_mm = session._stage.arm.pose(1.0).z_mm
    advance, close, session.close = session.advance, session.close, lambda: None

    def interrupted():
        advance()
        if session._stage.arm.pose(1.0).z_mm > begun_mm + 2.0:
            session._stage.arm.stop()

    session.advance = interrupted
    code, out, _ = recovering.run("--lift", "--yes")
    assert code == 1
    assert "The arm rose by 2.0 of 5 mm" in out
    close()


def test_a_lift_that_is_refused_on_its_way_says_why(recovering):
    session = recovering.session
    session.connect()
    session.connection.when_ready = lambda: None
    session.advance()
    advance, close, session.close = session.advance, session.close, lambda: None
    refused = RefusedError("FORCE-UNKNOWN", "The force is unknown.")

    def interrupted():
        advance()
        if session.hand.jog.active:
            session.hand.jog._permit.refuse = Mock(side_effect=refused)

    session.advance = interrupted
    code, out, _ = recovering.run("--lift", "--yes")
    assert code == 1
    assert "The motion was ended: The force is unknown." in out
    close()


@pytest.mark.parametrize("action", ["lift", "open-jaws"])
def test_what_the_window_refuses_is_refused(recovering, monkeypatch, action):
    recovering.devices["gripper"].fails_at = "identify"
    code, _, err = recovering.run(f"--{action}", "--yes")
    assert code == 1
    assert "gripper: identify" in err
    recovering.devices["gripper"].fails_at = ""
    monkeypatch.setattr("touchdown.backend.runs.manual_control.ManualControl.powered", False)
    code, _, err = recovering.run(f"--{action}", "--yes")
    assert (code, "SERVO-OFF" in err) == (1, True)


@pytest.fixture
def hardware(monkeypatch, lab):
    """The new lab file with scripted devices; returns what they were asked."""
    monkeypatch.setenv("TOUCHDOWN_DATA", str(lab.parent / "data"))
    devices, log = scripted()

    def opened(*args, **options):
        session = lab_session(*args, **options)
        session.connection.devices.update(devices)
        session.connection.prove = lambda name, cancel: None
        return session

    monkeypatch.setattr("touchdown.backend.bench.lab_session", opened)
    return SimpleNamespace(lab=lab, devices=devices, log=log)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["stack", "--mode", "auto"], "hardware"),
        (["stack", "--strategy", "pick-and-place"], "simulations only"),
        (["stack", "--bottom", "nope"], "no bottom piece 'nope'"),
        (["stack", "--runs", "FILE"], "cannot be stored"),
        (["collect", "--count", "0"], "'count'"),
        (["collect", "--within", "0.001", "--pattern", "grid", "--count", "900"], "Not enough"),
        (["calibrate", "board", "--bottom", "nope"], "no bottom piece 'nope'"),
        (["calibrate", "payload", "--accept", "--calibrations", "FILE"], "cannot be written"),
        (["check-day", "--calibrations", "FILE"], "cannot be written"),
    ],
)
def test_nothing_is_connected_for_a_run_that_cannot_begin(hardware, capsys, tmp_path, words, why):
    filled(tmp_path / "calibrations", {})
    (tmp_path / "file").write_text("")
    verb, *rest = [str(tmp_path / "file") if word == "FILE" else word for word in words]
    data_set = ["--dataset", str(tmp_path / "ds")] if verb == "collect" else []
    assert main([verb, "--bench", str(hardware.lab), "--home", *rest, *data_set]) in (1, 2)
    assert why in capsys.readouterr().err
    assert hardware.log == []


def test_the_arm_is_not_switched_on_for_calibrations_of_other_devices(hardware, capsys, tmp_path):
    filled(tmp_path / "calibrations", {})
    store = CalibrationStore(tmp_path / "calibrations", "hardware")
    name = DeviceName(maker="Maker", model="Model", serial="another")
    store.accept(
        WEIGHED.to_event(0.0, "payload"), {"force_torque": name}, now=NOW + timedelta(seconds=2)
    )
    assert main(["stack", "--bench", str(hardware.lab), "--home"]) == 1
    assert "CALIBRATION" in capsys.readouterr().err
    assert "connect gripper" in hardware.log
    assert "connect arm" not in hardware.log


@pytest.mark.parametrize(
    ("text", "at_lab", "elsewhere"),
    [
        (
            "Look, press Reset, then connect it again.",
            "Look, run 'B --reset'.",
            "Look, start again.",
        ),
        (
            "Mend it, then press Reset.",
            "Mend it, then run 'B --reset'.",
            "Mend it, then start again.",
        ),
        ("Look at the device chips.", "Run 'B --status'.", "Look at the devices."),
        ("It stands. Press Reset first.", "It stands. Run 'B --reset' first.", None),
        ("Then acknowledge it.", "Then run 'B --acknowledge'.", "Then acknowledge it."),
        ("Lift before you start (jog +Z).", "Lift before you start ('B --lift').", None),
        ("Nothing of the window.", "Nothing of the window.", "Nothing of the window."),
    ],
)
def test_steps_in_the_window_become_commands(text, at_lab, elsewhere):
    assert without_window(text, "my lab.toml") == at_lab.replace(
        "B ", "touchdown bench 'my lab.toml' "
    )
    assert elsewhere is None or without_window(text) == elsewhere


@pytest.mark.parametrize("error", [None, KeyboardInterrupt()])
def test_a_piece_that_is_held_after_a_run_is_said_with_how_to_take_it(error):
    stream = io.StringIO()
    screen = VerbOutput(stream=stream, lab="lab.toml")
    session = SimpleNamespace(hand=SimpleNamespace(holding=True))
    try:
        with held_piece_reported(session, screen):
            if error is not None:
                raise error
    except KeyboardInterrupt:
        pass
    assert "touchdown bench lab.toml --open-jaws" in stream.getvalue()


def test_all_devices_lost_at_once_are_named():
    faults = ("force_torque:stop@3.0", "tactile_left:stop@3.0", "tactile_right:stop@3.0")
    with brisk_session(faults=faults) as session:
        session.prepare(SceneChoice(estimates=False))
        while session.clock_s() < 2.0:
            session.advance()
        result = session.run(ProbeRequest())
    assert result.ending == "failed"
    assert {fault.device for fault in result.faults} == {
        "force_torque", "tactile_left", "tactile_right"
    }  # fmt: skip
    assert "Also" not in result.reason, "the fault of the run names them"


def test_faults_of_the_emulated_bench_are_texts_or_a_plan(monkeypatch, tmp_path, capsys):
    plans, session = [], brisk_session()

    class Emulated:
        def __init__(self, choice, *, plan, **_):
            plans.append(plan)
            self.session = session

        def __enter__(self):
            return self

        def __exit__(self, *_):
            session.close()

        def measure_real_time(self):
            return ""

    monkeypatch.setattr("touchdown.backend.bench.EmulatedBench", Emulated)
    (tmp_path / "plan.toml").write_text('[[fault]]\nat_s = 90.0\ndevice = "arm"\nkind = "alarm"\n')
    words = ["stack", "--emulated", "--strategy", "pick-and-place", "--runs", str(tmp_path / "r")]
    faults = ["--inject", "gripper:fast_stop@80+2", "--faults", str(tmp_path / "plan.toml")]
    assert main([*words, *faults, "--json"]) in (0, 1)
    assert json.loads(capsys.readouterr().out)["bench"] == "emulated bench"
    assert [(f.device, f.kind, f.at_s, f.for_s) for f in plans[0].fault] == [
        ("arm", "alarm", 90.0, None), ("gripper", "fast_stop", 80.0, 2.0)
    ]  # fmt: skip
    assert main(["stack", "--faults", str(tmp_path / "plan.toml")]) == 2
    assert "--faults" in capsys.readouterr().err


def test_a_fault_of_the_emulated_bench_is_written_as_text():
    slow = parse_fault("force_torque:slow=300@3")
    assert (slow.device, slow.kind, slow.at_s, slow.for_s, slow.hz) == (
        "force_torque", "slow", 3.0, None, 300.0
    )  # fmt: skip
    for text in ("arm:freeze@1", "arm:alarm", "force_torque:slow@3", "door:open@1"):
        with pytest.raises(InputError):
            parse_fault(text)


def test_the_steps_of_an_opening_are_told_now_and_then(capsys) -> None:
    for step in range(1, 12):
        narrate(Progress(float(step), step, 38, "opening the jaws"), VerbOutput())
    assert capsys.readouterr().out.splitlines() == [
        "    5.00 s  opening the jaws, step 5 of 38",
        "   10.00 s  opening the jaws, step 10 of 38",
    ]
