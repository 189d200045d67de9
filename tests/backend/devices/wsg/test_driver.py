"""What the WSG driver decides, on a hand-wound clock against the emulated gripper: no wire."""

import pytest

from tests.backend.devices.wsg.stepped import PART_MM, Bench
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.wsg.protocol import WsgCommand, WsgRequest


def code_of(motion):
    with pytest.raises(FaultError) as raised:
        motion.result()
    return raised.value.fault.code


@pytest.mark.parametrize(("convention", "sum_n"), [("device", 20.0), ("finger", 10.0)])
def test_force_is_per_finger_and_the_wire_carries_what_the_gripper_takes(convention, sum_n):
    bench = Bench(force_convention=convention)
    status = bench.held()
    assert WsgRequest(WsgCommand.SET_FORCE_LIMIT, (sum_n,)) in bench.sent
    assert (status.width_mm, status.force_n, status.holding) == (PART_MM, 10.0, True)


def test_the_force_is_set_before_the_jaws_close_and_read_after():
    bench = Bench()
    bench.sent.clear()
    bench.held()
    assert [request.command for request in bench.sent] == [
        WsgCommand.SET_FORCE_LIMIT,
        WsgCommand.GRASP,
        WsgCommand.GRASP_STATE,
        WsgCommand.WIDTH,
        WsgCommand.FORCE,
    ]


def test_a_force_beyond_the_gripper_is_sent_as_its_limit_and_told():
    bench = Bench()
    assert bench.order(bench.core.grip, 200.0).sent == {"force_n": 25.0}


def test_without_a_piece_the_grip_fails():
    bench = Bench(part_mm=None)
    assert code_of(bench.end(bench.order(bench.core.grip, 10.0))) == "WSG-NO-PART"
    assert not bench.core.status.holding


def test_before_homing_a_motion_is_refused_by_name():
    bench = Bench(homed=False)
    assert code_of(bench.end(bench.order(bench.core.grip, 10.0))) == "WSG-NOT-HOMED"


def test_a_held_piece_is_released_and_empty_jaws_are_positioned():
    bench = Bench()
    bench.held()
    opening = bench.end(bench.order(bench.core.open_to, 44.0, 5.0))
    opening.result()
    assert opening.sent == {"width_mm": 44.0, "speed_mm_s": 5.0}
    assert WsgCommand.RELEASE in [request.command for request in bench.sent]
    bench.end(bench.order(bench.core.open_to, 60.0, 100.0)).result()
    assert bench.sent[-4].command == WsgCommand.PREPOSITION
    assert bench.core.status.width_mm == pytest.approx(60.0)


@pytest.mark.promise("G1")
def test_a_lost_piece_is_seen_within_the_period_of_the_state():
    bench = Bench()
    bench.held()
    bench.faults.inject(bench.now_s, "part_lost")
    bench.advance(0.03)
    assert not bench.core.status.holding
    assert bench.core.lost_parts == 1
    assert bench.core.fault is None


def test_stop_ends_a_motion_and_is_not_sent_to_jaws_that_hold():
    bench = Bench()
    motion = bench.order(bench.core.grip, 10.0)
    bench.advance(0.1)
    bench.send(bench.core.stop())
    assert bench.sent[-1].command == WsgCommand.STOP
    assert code_of(motion) == "STOPPED"
    bench.advance(0.1)
    bench.held()
    bench.sent.clear()
    bench.send(bench.core.stop())
    assert bench.sent == []
    assert bench.core.status.holding


def test_a_newer_command_stops_the_older_one_first():
    bench = Bench(part_mm=None)
    first = bench.order(bench.core.open_to, 10.0, 20.0)
    bench.advance(0.2)
    bench.sent.clear()
    second = bench.order(bench.core.open_to, 50.0, 50.0)
    assert code_of(first) == "REPLACED"
    assert [request.command for request in bench.sent[:2]] == [
        WsgCommand.STOP,
        WsgCommand.PREPOSITION,
    ]
    bench.end(second).result()
    assert bench.core.status.width_mm == pytest.approx(50.0)


@pytest.mark.promise("G2")
@pytest.mark.parametrize(
    ("kind", "code"), [("fast_stop", "WSG-FAST-STOP"), ("power", "WSG-DEVICE")]
)
def test_nothing_is_commanded_until_a_fault_is_acknowledged(kind, code):
    bench = Bench()
    motion = bench.order(bench.core.grip, 10.0)
    bench.faults.inject(bench.now_s, kind, 0.1)
    bench.advance(0.2)
    assert code_of(motion) in (code, "WSG-ABORTED")
    assert bench.core.fault.code == code
    bench.sent.clear()
    with pytest.raises(FaultError):
        bench.core.grip(bench.now_s, 10.0)
    assert bench.sent == []
    bench.send(bench.core.acknowledge())
    assert bench.core.fault is None
    bench.held()


def test_a_motion_that_never_ends_is_stopped_at_its_deadline():
    bench = Bench(part_mm=None)
    motion = bench.order(bench.core.open_to, 10.0, 50.0)
    bench.gripper.jaws.motion = None
    bench.advance(5.0)
    assert code_of(motion) == "WSG-TIMEOUT"
    assert WsgRequest(WsgCommand.STOP) in bench.sent


def test_silence_is_a_lost_link():
    bench = Bench()
    bench.held()
    bench.deaf = True
    bench.advance(2.9)
    assert bench.core.fault is None
    bench.advance(0.3)
    assert bench.core.fault.code == "WSG-LINK"
