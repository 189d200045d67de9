"""The WSG in its text protocol: what goes over the wire, and what its lines mean to the driver."""

import pytest

from tests.backend.devices.wsg.stepped import PART_MM, Bench
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.wsg.protocol import WsgCommand, WsgStatus


def text(**settings):
    return Bench(protocol="gcl", **settings)


def code_of(motion):
    with pytest.raises(FaultError) as raised:
        motion.result()
    return raised.value.fault.code


def last(bench, call):
    return [line for line in b"".join(bench.said).splitlines() if line.startswith(call)][-1]


@pytest.mark.parametrize(("convention", "line"), [("device", b"20"), ("finger", b"10")])
def test_the_force_travels_with_the_grip(convention, line):
    bench = text(force_convention=convention)
    status = bench.held()
    assert last(bench, b"GRIP(") == b"GRIP(%b.0,0.0,50.0)" % line
    assert (status.width_mm, status.force_n, status.holding) == (PART_MM, 10.0, True)


@pytest.mark.parametrize(("counts", "line"), [("width", b"4.0"), ("finger", b"2.0")])
def test_a_release_opens_by_the_distance_that_the_gripper_takes(counts, line):
    bench = text(gcl_release=counts)
    bench.held()
    bench.end(bench.order(bench.core.open_to, PART_MM + 4.0, 5.0)).result()
    assert last(bench, b"RELEASE") == b"RELEASE(%b,5.0)" % line
    assert bench.core.status.width_mm == pytest.approx(PART_MM + 4.0)


def test_what_the_gripper_refuses_has_the_words_of_the_binary_protocol():
    bench = text(homed=False)
    assert code_of(bench.end(bench.order(bench.core.grip, 10.0))) == "WSG-NOT-HOMED"
    empty = text(part_mm=None)
    assert code_of(empty.end(empty.order(empty.core.grip, 10.0))) == "WSG-NO-PART"


@pytest.mark.parametrize("code", [status for status in WsgStatus if status not in (0, 11, 19, 26)])
def test_every_error_code_ends_the_motion_with_a_fault(code):
    bench = text()
    motion = bench.order(bench.core.grip, 10.0)
    bench.hear(b"ERR GRIP %d\r\n" % code)
    assert code_of(motion).startswith("WSG-")


def test_lines_may_come_torn_merged_and_with_a_carriage_return():
    bench = text()
    bench.language.take(b"GRIPST")
    bench.hear(b"ATE=4\r\nPOS=12.5\nFORCE=20")
    bench.hear(b".0\n")
    assert (bench.core.status.width_mm, bench.core.status.force_n) == (12.5, 10.0)
    assert bench.core.status.holding


def test_a_motion_without_its_end_is_stopped_at_its_deadline():
    bench = text(part_mm=None)
    motion = bench.order(bench.core.open_to, 10.0, 50.0)
    bench.damage = lambda data: b"" if data.startswith(b"FIN") else data
    bench.advance(4.0)
    assert code_of(motion) == "WSG-TIMEOUT"
    assert last(bench, b"STOP") == b"STOP()"


@pytest.mark.parametrize(("autosend", "within_s"), [(True, 0.06), (False, 0.25)])
def test_a_lost_piece_is_seen_by_what_is_sent_or_else_by_asking(autosend, within_s):
    bench = text()
    bench.held()
    if not autosend:
        bench.mouth._auto.clear()
    bench.faults.inject(bench.now_s, "part_lost")
    bench.advance(within_s)
    assert not bench.core.status.holding
    assert bench.core.lost_parts == 1


@pytest.mark.promise("G2")
@pytest.mark.parametrize(
    ("kind", "code"), [("fast_stop", "WSG-FAST-STOP"), ("power", "WSG-DEVICE")]
)
def test_nothing_is_commanded_until_a_fault_is_acknowledged(kind, code):
    bench = text()
    bench.faults.inject(bench.now_s, kind, 0.1)
    bench.advance(0.4)
    assert bench.core.fault.code == code
    with pytest.raises(FaultError):
        bench.core.grip(bench.now_s, 10.0)
    bench.send(bench.core.acknowledge())
    bench.advance(0.5)
    assert bench.core.fault is None
    bench.held()


def test_a_stop_ends_the_motion_and_leaves_a_grip_alone():
    bench = text()
    motion = bench.order(bench.core.grip, 10.0)
    bench.advance(0.05)
    bench.send(bench.core.stop())
    assert bench.sent[-1].command == WsgCommand.STOP
    assert code_of(motion) == "STOPPED"
    bench.advance(0.3)
    bench.held()
    bench.advance(0.3)
    assert bench.core.stop() == []


def test_silence_is_a_lost_link():
    bench = text()
    bench.deaf = True
    bench.advance(3.2)
    assert bench.core.fault.code == "WSG-LINK"
