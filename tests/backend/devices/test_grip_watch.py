"""A piece that is lost is told from one that is let go, on a hand-wound clock."""

from dataclasses import replace

import pytest

from touchdown.backend.devices.protocols import DeviceState, GripStatus
from touchdown.backend.devices.supervision import STANDS_S, GripMonitor

CYCLE_S = 0.02
HELD = GripStatus(width_mm=20.0, force_n=10.0, holding=True)
LOST = GripStatus(width_mm=20.0, force_n=0.0, holding=False)


class Jaws:
    """A gripper that says what it is told to say."""

    def __init__(self):
        self.state, self.told = DeviceState.READY, HELD
        self.grips, self.letting_go = 1, False

    def status(self):
        return self.told


class Watched:
    def __init__(self):
        self.jaws, self.now_s, self.faults = Jaws(), 0.0, []
        self.watch = GripMonitor(self.jaws)

    def run(self, seconds, told=None):
        self.jaws.told = told or self.jaws.told
        for _ in range(round(seconds / CYCLE_S)):
            self.now_s += CYCLE_S
            fault = self.watch.check(self.now_s)
            if fault is not None:
                self.faults.append((self.now_s, fault))


@pytest.fixture
def held():
    made = Watched()
    made.run(1.0)
    assert made.faults == []
    return made


@pytest.mark.promise("G1")
@pytest.mark.parametrize("told", [LOST, replace(HELD, width_mm=19.6), replace(HELD, width_mm=20.4)])
def test_a_lost_piece_is_one_fault_within_200_ms(held, told):
    lost_s = held.now_s
    held.run(1.0, told)
    ((found_s, fault),) = held.faults
    assert found_s - lost_s <= 0.2
    assert (fault.code, fault.device) == ("PIECE-LOST", "gripper")


@pytest.mark.promise("G1")
@pytest.mark.parametrize("width_mm", [float("nan"), float("inf"), -40.0, 6.5e4])
@pytest.mark.parametrize("then", [LOST, replace(HELD, width_mm=19.6)])
def test_what_is_no_width_loses_no_piece_and_hides_no_loss(held, width_mm, then):
    held.run(CYCLE_S, replace(HELD, width_mm=width_mm))
    held.run(0.1, GripStatus(width_mm, float("nan"), holding=False))
    assert held.faults == []
    assert held.watch.seen_s == pytest.approx(1.0)
    held.run(0.1, then)
    assert [fault.code for _, fault in held.faults] == ["PIECE-LOST"]


def test_a_grip_that_weakens_is_losing_its_piece(held):
    held.run(0.08, replace(HELD, force_n=4.9))
    held.run(0.5, replace(HELD, force_n=5.1))
    assert held.faults == []
    weak_s = held.now_s
    held.run(0.04, replace(HELD, force_n=4.0))
    held.run(0.04, replace(HELD, force_n=float("nan")))
    held.run(0.5, replace(HELD, force_n=4.0))
    ((found_s, fault),) = held.faults
    assert 0.1 <= found_s - weak_s <= 0.2
    assert fault.code == "PIECE-LOST"
    assert "10.0 to 4.0 N" in fault.what


def test_a_force_that_is_no_number_changes_nothing(held):
    held.run(0.5, replace(HELD, force_n=float("nan")))
    assert held.faults == []
    assert held.watch.seen_s == held.now_s


def test_what_trembles_below_the_limit_is_held(held):
    for width_mm in (20.25, 19.75) * 20:
        held.run(CYCLE_S, replace(HELD, width_mm=width_mm))
    assert held.faults == []


@pytest.mark.promise("G1")
def test_jaws_that_are_opened_let_go(held):
    held.jaws.letting_go = True
    for width_mm in (20.0, 20.5, 22.0):
        held.run(0.1, replace(HELD, width_mm=width_mm))
    held.run(0.5, replace(LOST, width_mm=26.0))
    assert held.faults == []
    held.jaws.letting_go, held.jaws.grips = False, 2
    held.run(0.5, replace(LOST, width_mm=22.0))
    held.run(1.0, HELD)
    assert held.faults == []
    held.run(0.1, LOST)
    assert len(held.faults) == 1


def test_a_firmer_grip_may_close_further(held):
    held.jaws.grips = 2
    held.run(0.5 * STANDS_S, replace(HELD, width_mm=19.5))
    held.run(1.0, replace(HELD, width_mm=19.0))
    assert held.faults == []


def test_of_a_gripper_that_is_lost_itself_nothing_is_said(held):
    held.jaws.state = DeviceState.FAULT
    held.run(0.5, LOST)
    held.jaws.state = DeviceState.READY
    held.run(0.5, LOST)
    assert held.faults == []
