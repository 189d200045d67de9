"""The emulated controller: what it grants and refuses, jog, moves, stream, errors; by its bytes."""

import math
import re

import numpy as np
import pytest

from tests.backend.devices.codecs.vectors import data
from tests.backend.devices.melfa.emulated_arm import settings
from touchdown.backend.devices.melfa.emulated_controller import (
    READY_RAD,
    SPEEDS_RAD_S,
    frame_of,
    solve,
)
from touchdown.backend.devices.melfa.emulator import EmulatedMelfa
from touchdown.backend.devices.melfa.r3_protocol import RunFlags, StopFlags, read_axes, read_state
from touchdown.backend.devices.melfa.r3_protocol import decode_reply as decode_answer
from touchdown.backend.devices.melfa.realtime_protocol import (
    CYCLE_S,
    AxisValues,
    BlockKind,
    MelfaPose,
    MxtCommand,
    MxtRequest,
    decode_mxt_reply,
    encode_mxt_request,
)


class Client:
    """One client of an emulated controller; ``now_s`` is its clock."""

    def __init__(self, device=None, **more):
        self.device = device or EmulatedMelfa(settings(**more))
        self.session, self.now_s = self.device.session(), 0.0

    def ask(self, text, end=b"\r"):
        out = self.session.receive(self.now_s, text.encode() + end)
        assert out.endswith(end)
        return out.removesuffix(end).decode()

    def wait(self, seconds):
        self.now_s += seconds
        self.device.controller.advance(self.now_s)

    def state(self):
        return read_state(decode_answer(self.ask("1;1;STATE").encode()).answer)

    def ready(self):
        assert self.ask("1;1;CNTLON") == "QoK"
        assert self.ask("1;1;SRVON") == "QoK"
        self.wait(0.35)
        return self

    def streaming(self):
        assert self.ready().ask("1;1;RUNTDMXT;1") == "QoK"
        return self

    @property
    def joints(self):
        return self.device.controller.joints.command_rad

    def send(self, request):
        self.wait(CYCLE_S)
        answer = self.device.stream.receive(self.now_s, encode_mxt_request(request))
        return None if answer is None else decode_mxt_reply(answer)

    def command(self, joints, monitors=(2, 8, 5, 11)):
        target = AxisValues(BlockKind.JOINT, (*joints.tolist(), 0.0, 0.0))
        return self.send(MxtRequest(MxtCommand.MOVE, target, monitors))


# -- commands -------------------------------------------------------------------------------------


@pytest.mark.parametrize("end", [b"\r", b"\n", b"\r\n"])
def test_a_reply_ends_as_the_request_did(end):
    assert Client().ask("1;1;STOP", end) == "QoK"


def test_a_request_without_an_end_is_taken_after_a_gap():
    client = Client()
    assert client.session.receive(0.0, b"1;1;OVRD") == b""
    assert client.session.due(0.04) == b""
    assert client.session.due(0.06) == b"QoK100"


def test_published_requests_are_understood():
    client = Client()
    assert client.ask(data("r3-open").decode().strip()).startswith("QoK3F;3F;7,0;")
    assert client.ask(data("r3-cntlon").decode().strip()) == "QoK"
    assert client.ask(data("r3-ovrd-set").decode().strip()) == "QoK50"
    assert client.ask(data("r3-calib").decode().strip()) == data("r3-calib-reply").decode().strip()
    assert (
        client.ask(data("r3-stpsig").decode().strip()) == data("r3-stpsig-reply").decode().strip()
    )


def test_without_the_right_nothing_moves_and_it_is_given_back_when_the_client_goes():
    first = Client()
    second = Client(first.device)
    assert first.ask("1;1;SRVON") == data("r3-not-enabled").decode().strip()
    first.ask("1;1;CNTLON")
    assert second.ask("1;1;CNTLON") == "QeR6020"
    assert second.ask("1;1;STOP") == "QoK"
    first.session.closed(1.0)
    assert second.ask("1;1;CNTLON") == "QoK"


@pytest.mark.parametrize(
    ("before", "request_", "error"),
    [
        ([], "1;1;RUNNOPE;1", "4140"),
        (["1;1;RUNTDMXT;1"], "1;1;PRGLOAD=TDMXT", "5640"),
        (["1;1;RUNTDMXT;1"], "1;1;JOG01;00;01;00;00", "5640"),
        (["1;1;RUNTDMXT;1", "1;1;STOP"], "1;1;RUNTDMXT;1", "5120"),
        (["1;1;SRVOFF"], "1;1;EXECMOV (0,0,0,0,0,0)(7,0)", "2000"),
        (["1;1;STOPON"], "1;1;RUNTDMXT;1", "5610"),
        ([], "1;1;XYZZY", "9903"),
        ([], "1;1;EXECMOV (9000,0,0,180,0,180)(7,0)", "2602"),
    ],
)
def test_refusals_have_their_numbers(before, request_, error):
    client = Client().ready()
    for text in before:
        assert client.ask(text) == "QoK"
    assert client.ask(request_) == f"QeR{error}"


def test_the_servo_takes_its_time_and_the_state_tells():
    client = Client()
    client.ask("1;1;CNTLON")
    client.ask("1;1;SRVON")
    assert RunFlags.SERVO_ON not in client.state().run
    client.wait(0.35)
    assert client.state().run == RunFlags.SERVO_ON | RunFlags.OPERATION_ENABLED | RunFlags.REPEAT
    client.ask("1;1;RUNTDMXT;1")
    assert RunFlags.RUNNING in client.state().run


def test_an_emergency_stop_is_reset_only_when_it_is_released():
    client = Client().ready()
    client.device.controller.raise_error(61)
    state = client.state()
    assert (state.error, StopFlags.EMERGENCY in state.stop) == (61, True)
    assert client.ask("1;1;ERROR") == "Qok61;1"
    assert client.ask("1;1;SRVON") == "Qer5600"
    assert client.ask("1;1;RSTALRM") == "Qer61"
    client.device.controller.release_emergency_stop()
    assert client.ask("1;1;RSTALRM") == "QoK"
    assert client.state().error == 0
    assert RunFlags.SERVO_ON not in client.state().run


@pytest.mark.promise("R13")
def test_a_jog_ends_140_ms_after_the_last_command():
    client = Client().ready()
    text = "00;00;00;01;00"
    assert client.ask(f"1;1;JOG{text}") == "QoK"
    client.wait(0.1)
    assert client.ask(f"1;1;JOG{text}") == "QoK"
    client.wait(0.5)
    turned = client.joints[0] - READY_RAD[0]
    assert turned == pytest.approx(0.1 * SPEEDS_RAD_S[0] * 0.24, rel=0.03)
    assert client.joints[1:] == pytest.approx(READY_RAD[1:])


def test_a_straight_jog_keeps_the_hand_and_follows_the_override():
    client = Client().ready()
    client.ask("1;1;OVRD=10")
    before = frame_of(client.joints)
    client.ask("1;1;JOG01;00;04;00;00")
    client.wait(0.3)
    after = frame_of(client.joints)
    assert after[:3, 3] - before[:3, 3] == pytest.approx([0.0, 0.0, -25.0 * 0.14], abs=0.1)
    assert after[:3, :3] == pytest.approx(before[:3, :3], abs=1e-6)


@pytest.mark.parametrize("move", ["MOV", "MVS"])
def test_a_move_ends_at_the_printed_place(move):
    client = Client().ready()
    reading = read_axes(client.ask("1;1;PPOSF").removeprefix("QoK"))
    x, y, z, *angles = reading.values
    degrees = ",".join(f"{math.degrees(angle):+.2f}" for angle in angles)
    told = f"({x:+.2f},{y + 20:+.2f},{z + 10:+.2f},{degrees})(7,0)"
    assert client.ask(f"1;9;EXEC{move} {told}") == "QoK"
    client.wait(0.05)
    assert RunFlags.RUNNING in client.state().run
    client.wait(3.0)
    after = read_axes(client.ask("1;1;PPOSF").removeprefix("QoK")).values
    assert after[:3] == pytest.approx((x, y + 20, z + 10), abs=0.02)
    assert RunFlags.RUNNING not in client.state().run


# -- stream ---------------------------------------------------------------------------------------


def test_published_packets_are_answered_while_the_program_runs():
    client = Client()
    first = data("mxt-null-first")
    assert client.device.stream.receive(0.0, first) is None
    client.streaming()
    assert client.device.stream.receive(client.now_s, data("mxt-bad-short")) is None
    reply = decode_mxt_reply(client.device.stream.receive(client.now_s, first))
    assert (reply.monitors, reply.counter) == ((2, 5, 8, 11), 1)
    assert reply.blocks[0].axes[:6] == pytest.approx(READY_RAD, abs=1e-6)
    assert client.device.stream.receive(client.now_s, data("mxt-end")) is None
    assert RunFlags.RUNNING not in client.state().run
    assert client.device.stream.receive(client.now_s, first) is None


def test_a_client_of_the_stream_alone_is_served_from_the_start():
    device = EmulatedMelfa(settings(), streaming=True)
    assert decode_mxt_reply(device.stream.receive(0.0, data("mxt-null-first"))).counter == 1
    client = Client(device)
    assert client.command(READY_RAD + 1e-4).blocks[0].axes[0] == pytest.approx(1e-4)


def test_command_filter_and_feedback_follow_each_at_their_pace():
    client = Client().streaming()
    client.send(MxtRequest(MxtCommand.NONE, monitors=(2, 8, 5, 11)))
    for k in range(1, 40):
        reply = client.command(READY_RAD + 1e-4 * k * np.ones(6))
    command, feedback, filtered, current = (block.axes[0] for block in reply.blocks)
    rate = 1e-4 / CYCLE_S
    # Both follow the command of the cycle before with 10 ms.
    assert command - filtered == pytest.approx(rate * 0.010, rel=0.25)
    assert command - feedback == pytest.approx(rate * 0.010, rel=0.25)
    assert current > 0
    assert reply.counter == 40


def test_places_are_told_as_poses_too():
    client = Client().streaming()
    reply = client.send(MxtRequest(MxtCommand.NONE, monitors=(1, 0, 0, 0)))
    pose = reply.blocks[0]
    assert isinstance(pose, MelfaPose)
    assert pose.axes[:3] == pytest.approx(frame_of(READY_RAD)[:3, 3], abs=1e-3)


@pytest.mark.promise("G8")
@pytest.mark.parametrize(
    ("step_rad", "error"), [(np.array([0.0095, 0, 0, 0, 0, 0]), 9901), (np.full(6, 9.0), 2602)]
)
def test_a_step_too_large_or_a_joint_too_far_ends_it_with_an_error(step_rad, error):
    client = Client().streaming()
    assert client.command(READY_RAD) is not None
    assert client.command(READY_RAD + step_rad) is None
    assert client.device.controller.error == error
    assert not client.device.controller.servo
    assert client.joints == pytest.approx(READY_RAD)
    # 0.0095 rad in 3.5 ms, of a joint that may do 2.16421 rad/s.
    share = 0.0095 / 0.0035 / 2.16421 if error == 9901 else 0.0
    assert client.device.stream.largest_share == pytest.approx(share, rel=1e-4, abs=1e-3)
    # Once the alarm is reset it goes on as before, and the largest step is remembered.
    assert [client.ask(f"1;1;{order}") for order in ("RSTALRM", "SLOTINIT")] == ["QoK", "QoK"]
    client.streaming()
    assert client.command(READY_RAD) is not None
    assert client.device.stream.largest_share >= 0.99 * share


def test_a_client_of_another_maker_runs_the_stream_by_its_own_name():
    client = Client().ready()
    assert client.ask("1;1;RUNANY;1") == "QeR4140"
    assert client.ask("1;1;PRGLOAD=MXT") == client.ask("1;1;RUNMXT;1") == "QoK"
    assert client.command(READY_RAD) is not None


@pytest.mark.promise("R12")
def test_silence_is_counted_and_ends_it_after_the_set_number_of_cycles():
    client = Client(mxt={"mxttout": 10}).streaming()
    client.command(READY_RAD)
    client.wait(5 * CYCLE_S)
    assert client.command(READY_RAD).timeouts == 5
    client.wait(11 * CYCLE_S)
    assert client.device.controller.error == 9902


def test_without_a_limit_it_waits_for_ever():
    client = Client(mxt={"mxttout": -1}).streaming()
    client.command(READY_RAD)
    client.wait(5.0)
    assert client.command(READY_RAD).timeouts == 0
    assert client.device.controller.error == 0


def test_what_a_first_day_asks_is_answered():
    client = Client()
    client.device.controller.felt = lambda: np.array([0.12, -0.34, 9.87, 0.01, 0.02, 0.0])
    assert client.ask("1;1;PARNETPORT").startswith("QoKNETPORT;10000,10001,")
    told = client.ask("1;1;VALP_FsCurD")
    assert told == "QoKP_FsCurD=(+0.12,-0.34,+9.87,+0.01,+0.02,+0.00)(0,0)"


def test_a_public_client_finishes_its_start_up_and_moves_in_its_own_coordinates():
    """The requests of an R3 client of another maker, in its order."""
    client = Client()
    for text in ("OPEN=NARCUSER", "CNTLON", "EXECSPD M_NSPD", "EXECJOVRD M_NJOVRD"):
        assert client.ask(f"1;1;{text}").startswith("QoK")
    assert client.ask("1;1;OVRD") == "QoK100"
    assert client.ask("1;1;OVRD=20.00") == "QoK20"
    assert client.ask("1;1;VALM_SVO") == "QoKM_SVO=+0"
    assert client.ask("1;1;SRVON") == "QoK"
    client.wait(0.35)
    assert client.ask("1;1;VALM_SVO") == "QoKM_SVO=+1"
    x, y, z, *angles = read_axes(client.ask("1;1;PPOSF").removeprefix("QoK")).values
    assert client.ask("1;1;EXECBASE P_NBASE") == "QoK"
    assert client.ask("1;1;EXECDEF POS P1") == "QoK"
    assert client.ask("1;1;EXECDEF POS P1") == "QeR4350"
    assert client.ask("1;1;EXECBASE (-600.00,140.00,-38.63,,,)") == "QoK"
    assert client.ask("1;1;EXECTOOL (0,0,25,0,0,0)") == "QoK"
    assert client.ask("1;1;PNRMEXTL") == "QoKMEXTL;0.00, 0.00, 25.00, 0.00, 0.00, 0.00;6"
    shown = read_axes(client.ask("1;1;PPOSF").removeprefix("QoK")).values
    # The hand points down: the tool is 25 mm below the flange.
    assert shown[:3] == pytest.approx((x - 600.0, y + 140.0, z - 38.63 - 25.0), abs=0.02)
    degrees = ",".join(f"{math.degrees(angle):.2f}" for angle in angles)
    goal = f"({shown[0] + 10:.2f},{shown[1]:.2f},{shown[2]:.2f},{degrees})"
    assert client.ask("1;1;EXECSPD 50.00") == "QoK"
    assert client.ask(f"1;1;EXECMVS {goal} (7,0)") == "QoK"
    client.wait(0.5)
    # 50 mm/s at an override of 20 %.
    told = client.ask("1;1;VALM_RSPD")
    assert float(told.removeprefix("QoKM_RSPD=")) == pytest.approx(10.0, rel=0.05)
    client.wait(1.0)
    after = read_axes(client.ask("1;1;PPOSF").removeprefix("QoK")).values
    assert after[:3] == pytest.approx((shown[0] + 10.0, *shown[1:3]), abs=0.03)
    assert client.ask("1;1;VALM_RSPD") == "QoKM_RSPD=+0"


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("VALM_JOVRD", "QoKM_JOVRD=+10"),
        ("VALM_TOOL", "QoKM_TOOL=+0"),
        ("VALP_TOOL", "QoKP_TOOL=(+0.00,+0.00,+0.00,+0.00,+0.00,+0.00)(7,0)"),
        ("IN0", "QoK0000"),
        ("PNRMXTTOUT", "QoKMXTTOUT;57;1"),
        ("PNRNOTHING", "QeR9903"),
        ("PRGLOAD=TDMXT.MB6", "QoK"),
        ("RUNTDMXT.MB6;1", "QoK"),
        ("RUNNOPE.MB6;1", "QeR4140"),
        ("OVRD=0.00", "QeR9903"),
        ("OVRD=101", "QeR9903"),
        ("EXECJOVRD 0", "QeR9903"),
        ("EXECSPD 99999", "QeR9903"),
        ("EXECM_TOOL=17", "QeR9903"),
        ("TOOLSET=17", "QeR9903"),
        ("EXECP9=(0,0,0,0,0,0)(7,0)", "QeR4340"),
        ("EXECMOV P9", "QeR4340"),
        ("EXECMOV (1,2)(7,0)", "QeR2802"),
        ("EXECRSTPWR", "QeR9903"),
        ("VALM_NONE", "QeR4340"),
    ],
)
def test_requests_of_other_clients_are_answered(request_, answer):
    assert Client().ready().ask(f"1;1;{request_}") == answer


def test_the_feedback_position_is_a_variable_in_degrees():
    client = Client().ready()
    x, y, z, *angles = read_axes(client.ask("1;1;PPOSF").removeprefix("QoK")).values
    told = re.fullmatch(r"QoKP_Fbc=\((.+)\)\(7,0\)", client.ask("1;1;VALP_Fbc"))[1].split(",")
    degrees = map(math.degrees, angles)
    assert list(map(float, told)) == pytest.approx([x, y, z, *degrees], abs=0.01)


@pytest.mark.parametrize(("step_rad", "error"), [(0.0095, "9901"), (9.0, "2602")])
def test_every_alarm_that_it_raises_has_a_text(step_rad, error):
    client = Client().streaming()
    client.command(READY_RAD)
    client.command(READY_RAD + step_rad)
    assert client.ask("1;1;ERROR") == f"Qok{error};2"
    told = client.ask(f"1;1;ERRORMES{error}")
    assert told.startswith("Qok")
    assert "limit" in told
    for number in (2000, 2802, 4340, 4350, 5120, 5600, 5610, 5640, 6020, 9902, 9903):
        assert client.ask(f"1;1;ERRORMES{number}") != "QokNo text"


@pytest.mark.parametrize("half_turn", [(1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
def test_a_hand_turned_by_half_a_turn_is_not_taken_for_reached(half_turn):
    wanted = frame_of(READY_RAD)
    wanted[:3, :3] = wanted[:3, :3] @ np.diag(half_turn)
    found = solve(wanted, READY_RAD)
    assert found is None or frame_of(found) == pytest.approx(wanted, abs=1e-5)
