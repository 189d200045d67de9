"""Presses by the controller's own force program: the contract of an arm, and what it refuses."""

from dataclasses import replace
from importlib.resources import files

import pytest

from backend.core.faults import FaultError, RefusedError
from backend.core.flow import Pose
from backend.devices.protocols import DeviceState
from backend.devices.sim.bench import SimulatedBench
from backend.emulators.melfa_probe import WRITTEN
from tests.backend.devices import contract_bench, test_arm_contract
from tests.backend.devices.contract_bench import PRESS, DevicesUnderTest
from tests.backend.devices.emulated_arm import on_bench

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
    text = (files("resources") / "melfa" / "TDPROBE.prg").read_text(encoding="ascii")
    code = "\n".join(line for line in text.splitlines() if not line.startswith("'"))
    assert {name for name in WRITTEN if name in code} == set(WRITTEN)
    assert code.index("Fsc On") < code.index("Mvs PD") < code.index("Fsc Off") < code.index("End")
