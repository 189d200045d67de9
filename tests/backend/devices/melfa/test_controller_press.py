"""Presses by the controller's own force program: the contract of an arm, and what it refuses."""

import threading
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

from tests.backend.devices import contract_bench, test_arm_contract
from tests.backend.devices.contract_bench import PRESS, DevicesUnderTest
from tests.backend.devices.emulated_arm import Rig, on_bench
from touchdown.backend.core.faults import FaultError, RefusedError
from touchdown.backend.core.values import Pose
from touchdown.backend.devices.melfa.emulated_controller import WRITTEN
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.simulation.devices.bench import SimulatedBench

CASES = [
    pytest.param(clause, more, id=name.removeprefix("test_"))
    for name, clause, more in (
        (name, clause, {"after_s": 2.5} if "every_phase" in name else {})
        for name, clause in vars(test_arm_contract).items()
        if name.startswith("test_") and "press" in name
    )
]
"""Moves are those of the stream: they are asked elsewhere."""


@pytest.fixture
def made():
    bench = SimulatedBench(contract_bench._scene(contract_bench.FEW_HZ))
    return bench, *on_bench(bench, stiffness_mode="controller")


@pytest.fixture
def bench(made):
    simulated, arm, wires = made
    return DevicesUnderTest(
        arm,
        simulated.gripper,
        simulated.force_torque,
        simulated.tactile,
        simulated.clock.now_s,
        wires.advance,
        still_s=0.2,
        still_mm=0.02,
    )


@pytest.fixture
def controller(made):
    return made[2].device.controller


@pytest.mark.parametrize(("clause", "more"), CASES)
def test_it_keeps_the_contract_of_an_arm(bench, clause, more):
    clause(bench, **more)


def test_the_clauses_of_a_press_are_asked():
    assert len(CASES) >= 3


def test_without_a_verdict_the_program_lifts_and_the_next_move_opens_the_stream(bench, controller):
    bench.lifted_and_gripped()
    bench.finish(bench.arm.press(PRESS))
    assert controller.program == "probe"
    assert 4.0 < bench.arm.press_n < 11.0
    pressed = bench.arm.pose(0.3)
    bench.rest(3.5)
    assert controller.program == ""
    lifted = bench.arm.pose(0.3)
    assert lifted.z_mm > pressed.z_mm + 1.0
    with pytest.raises(FaultError, match="no press to unload"):
        bench.arm.unload(1.0, 2.0)
    bench.finish(bench.arm.move_to(Pose(lifted.x_mm, lifted.y_mm, lifted.z_mm + 2.0), 20.0))
    assert controller.program == "stream"
    assert bench.arm.pose(0.1).z_mm == pytest.approx(lifted.z_mm + 2.0, abs=0.1)
    assert bench.arm.state is DeviceState.READY


def test_the_place_is_fresh_enough_as_long_as_the_program_holds_the_arm(bench, controller):
    bench.lifted_and_gripped()
    bench.finish(bench.arm.press(PRESS))
    unload, oldest_s = None, 0.0
    for step in range(100):
        bench.rest(0.02)
        oldest_s = max(oldest_s, bench.now_s() - bench.arm.poses.since(0).t_s[-1])
        assert bench.arm.pose(0.2).z_mm > 0.0
        if step == 50:
            unload = bench.arm.unload(1.0, 2.0)
    assert controller.program == "probe"
    bench.finish(unload)
    # The claim is not empty: it is told more rarely than a stream tells it.
    assert oldest_s > 0.2


def test_more_than_a_probe_may_reach_is_refused_before_anything_moves(bench, controller):
    bench.lifted_and_gripped()
    with pytest.raises(RefusedError, match="PROBE-FORCE"):
        bench.arm.press(replace(PRESS, depth_mm=2.5))
    assert controller.program == "stream"


def test_a_program_that_is_not_in_the_controller_is_said(bench, controller):
    bench.lifted_and_gripped()
    controller.missing_programs.add("TDPROBE")
    with pytest.raises(FaultError, match="4140"):
        bench.arm.press(PRESS)
    # Nothing is lost: with the stream the arm moves on.
    bench.rest(0.1)
    here = bench.arm.pose(0.3)
    bench.finish(bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 2.0), 20.0))


def test_an_emergency_stop_in_contact_ends_the_press(bench, controller):
    bench.lifted_and_gripped()
    motion = bench.arm.press(PRESS)
    while motion.onset_s is None:
        bench.advance(10_000)
    controller.press_emergency_stop()
    bench.rest(1.0)
    assert motion.done
    assert bench.arm.fault.code == "HW-STOP"


def test_the_program_that_ships_reads_what_is_written():
    text = (files("touchdown.resources") / "melfa" / "TDPROBE.prg").read_text(encoding="ascii")
    code = "\n".join(line for line in text.splitlines() if not line.startswith("'"))
    assert {name for name in WRITTEN if name in code} == set(WRITTEN)
    assert code.index("Fsc On") < code.index("Mvs PD") < code.index("Fsc Off") < code.index("End")


class Program:
    """The driver beside a force program that presses on a spring, without a bench."""

    def __init__(self) -> None:
        self.rig = rig = Rig(stiffness_mode="controller")
        self.numbers = True
        spring_n_mm, touch_mm = 8.0, 58.0

        def felt(pivot_mm):
            press_n = spring_n_mm * max(touch_mm - pivot_mm[2], 0.0)
            return np.array([0.0, 0.0, press_n if self.numbers else np.nan])

        rig.contact = felt
        rig.device.controller.felt = lambda: np.array(
            [0.0, 0.0, spring_n_mm * max(touch_mm - rig.true_mm[2], 0.0), 0.0, 0.0, 0.0]
        )
        rig.arm.connect(1.0, threading.Event())
        rig.rest(0.6)
        self.motion = rig.arm.press(PRESS)
        self.touch_mm = touch_mm

    def until_touched(self) -> None:
        while self.motion.onset_s is None:
            self.rig.rest(0.01)
        self.rig.rest(0.3)


@pytest.mark.promise("R15")
@pytest.mark.parametrize("touched", [False, True])
def test_a_wrist_without_numbers_ends_a_force_program_wherever_it_is(touched):
    program = Program()
    rig = program.rig
    if touched:
        program.until_touched()
    else:
        rig.rest(0.3)
    low_mm = rig.true_mm[2]
    program.numbers = False
    rig.rest(0.6)
    assert program.motion.done
    with pytest.raises(FaultError, match="FT-STALE"):
        program.motion.result()
    if touched:
        # It lifts by itself once it is told to.
        assert rig.true_mm[2] > program.touch_mm + 1.0
    else:
        # Nothing but its own sensor would end its descent: it is stopped, still in the air.
        assert program.touch_mm < rig.true_mm[2] < low_mm
        assert low_mm - rig.true_mm[2] < 0.6
    stands_mm = rig.true_mm[2]
    rig.rest(1.0)
    assert rig.true_mm[2] == pytest.approx(stands_mm, abs=0.3)
    assert rig.arm.state is DeviceState.READY


@pytest.mark.promise("R15")
def test_a_cable_pulled_out_of_a_force_program_is_a_fault_and_the_program_lifts_by_itself():
    program = Program()
    rig = program.rig
    rig.rest(0.3)
    rig.wires.unplugged = rig.wires.link.cut = True
    rig.rest(2.0)
    assert program.motion.done
    assert (rig.arm.state, rig.arm.fault.code) == (DeviceState.FAULT, "ARM-LINK")
    sent = len(rig.wires.packets)
    rig.rest(PRESS.hold_s + 4.0)
    # The computer commands nothing; the controller has come to the end of its own program.
    assert len(rig.wires.packets) == sent
    assert rig.true_mm[2] == pytest.approx(program.touch_mm + 2.0, abs=0.3)
    with pytest.raises(FaultError, match="ARM-LINK"):
        rig.arm.jog((0.0, 0.0, 5.0), 0.5)
