"""States of the pill, and fault cards with texts of their sources, for ``make screens``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

from tests.screen_panels import Hand
from touchdown.backend.bench.emulated_child import NOT_SET, STILL
from touchdown.backend.calibration import CalibrationStore
from touchdown.backend.core import (
    Fault,
    FaultRaised,
    Noticed,
    PhaseEntered,
    RunFinished,
    RunStarted,
    TrialStarted,
)
from touchdown.backend.devices.force_torque.reader import driver_fault
from touchdown.backend.devices.melfa.command_channel import RESETS
from touchdown.backend.devices.melfa.faults import controller_fault, oversize_fault
from touchdown.backend.devices.protocols import ArmStatus, SafetyMode
from touchdown.backend.devices.sensor_faults import DegradedDevice
from touchdown.backend.runs import Engine, RunState
from touchdown.backend.runs.calibrations import drift_notice, other_gel_fault
from touchdown.backend.runs.engine import bench_fault
from touchdown.backend.runs.plan import CancelledError, PausePoint, Plan, Wait
from touchdown.backend.runs.probe import turned_fault
from touchdown.backend.sensing.zeroing import WrenchDrift

if TYPE_CHECKING:
    from tests.screens import Stage


def of_the_pill(stage: Stage) -> Iterator[str]:
    """Servo off, jog, probe, contact, recovery, slow sensor; on Operate."""
    bench = stage.bench
    stage.main.go("operate")
    hand = bench.hand = Hand(bench)
    hand.powered = False
    stage.live(0.0)
    yield "state-servo-off"
    hand.powered = hand.jog.active = hand.active = True
    order = SimpleNamespace(axis="x", speed=20.0, frame="XYZ")
    hand.jog.state = SimpleNamespace(order=order, speed=20.0, slow="")
    stage.live(0.0)
    yield "state-jog"
    hand.jog.active = hand.active = False
    hand.jog.state = SimpleNamespace(order=None, speed=0.0, slow="")
    bench.events.publish(RunStarted(bench.clock_s(), "probe", "pot", "short", "probe", 0, 1, True,
                                 "{}", activity="probe"))  # fmt: skip
    bench.set_state(RunState.RUNNING, probe=1, phase="press")
    bench.events.publish(PhaseEntered(bench.clock_s(), "press", 1))
    stage.live(1.0)
    yield "state-probing"
    bench.events.publish(RunFinished(bench.clock_s(), "probe", "finished", ""))
    bench.set_state(RunState.IDLE, probe=0, phase="")
    stage.live(1.0)
    yield "state-in-contact"
    bench.interlock.recovering = True
    stage.live(1.0)
    yield "state-recovery"
    bench.interlock.recovering, bench.hand = False, Hand(bench)
    bench.still_s = 4.0
    stage.live(0.0)
    yield "state-still"
    bench.still_s = 0.0
    stage.live(0.0)
    yield from _of_the_wrist(stage)


def _of_the_wrist(stage: Stage) -> Iterator[str]:
    """Slow, then drifting wrist sensor, with its chip."""
    bench = stage.bench
    wrist = bench.devices["force_torque"]
    wrist.rate_hz, usual_hz = 300.0, wrist.rate_hz
    bench.degraded = (DegradedDevice("force_torque", "slow", bench.clock_s() - 12.0),)
    _look_at_once(stage)
    yield "state-degraded"
    wrist.rate_hz, bench.degraded = usual_hz, ()
    bench.drift = drift = WrenchDrift(0.52, 11.0, named=True)
    bench.events.publish(Noticed(bench.clock_s(), drift_notice(drift)))
    _look_at_once(stage)
    yield "state-drift"
    bench.drift = None
    stage.main.cards.clear(("FT-DRIFT",))
    _look_at_once(stage)


def _look_at_once(stage: Stage) -> None:
    """Draw chips and headers now instead of at their next period."""
    stage.main._chips._drawn_s = stage.main.workspaces["operate"].live._headers_s = float("-inf")
    stage.live(0.0)


def of_a_run(stage: Stage) -> Iterator[str]:
    """Preparing, pausing, paused, cancelling: the real engine with the buttons of Stack."""
    bench, main = stage.bench, stage.main
    stand_in = bench.engine, bench.status
    engine = Engine(bench.events, bench.interlock, bench.clock_s)
    bench.engine, bench.status = engine, engine.status
    main.go("stack")
    lifted = [False]
    engine.begin(_run(bench.clock_s, lambda: lifted[0]))
    stage.live(0.0)
    yield "state-preparing"
    engine.tick()
    stage.live(1.0)
    main.actions.action("stack.pause").trigger()
    stage.live(1.0)
    yield "state-pausing"
    lifted[0] = True
    engine.tick()
    stage.live(0.0)
    yield "state-paused"
    lifted[0] = False
    main.actions.action("stack.pause").trigger()
    engine.tick()
    stage.live(1.0)
    main.workspaces["stack"].page.run.cancel.click()
    stage.live(1.0)
    yield "state-cancelling"
    lifted[0] = True
    while engine.busy:
        engine.tick()
    stage.live(0.0)
    bench.engine, bench.status = stand_in


def _run(now_s: Callable[[], float], lifted: Callable[[], bool]) -> Plan[object]:
    """Run that presses until it is lifted, also after a cancel."""
    yield RunStarted(now_s(), "run", "pot", "short", "paper", 7, 3, True, "{}")
    yield TrialStarted(now_s(), 1, 7, (7.2, 3.1))
    try:
        for probe in (1, 2):
            yield PhaseEntered(now_s(), "press", probe)
            yield Wait(lifted, 60.0, "the lift")
            yield PausePoint()
    except CancelledError:
        yield Wait(lifted, 60.0, "the lift")
        yield RunFinished(now_s(), "run", "cancelled", "cancelled by the operator")
    return None


EMERGENCY = 61


def _alarm() -> Fault:
    told = controller_fault(EMERGENCY, "Emergency stop (external)")
    return replace(told, next_step=f"{told.next_step} {RESETS}")


def _cards() -> Mapping[str, Sequence[Fault]]:
    swapped = "It is the gel of the right finger: put the two back."
    step = CalibrationStore(Path(), "hardware", where=None).step("camera")
    gel = other_gel_fault("left", (8.2, 3.0), swapped, step)
    return {
        "faults-of-the-grasp": (turned_fault(0.074), gel.fault),
        "faults-of-drivers": (driver_fault(KeyError("payload")), oversize_fault(11)),
        "faults-of-the-bench": (bench_fault("It waits without end"), NOT_SET),
        "faults-of-a-process": (STILL,),
    }


def of_faults(stage: Stage) -> Iterator[str]:
    """Pairs of cards, and a stop by the emergency stop of the controller."""
    for name, faults in _cards().items():
        for fault in faults:
            _raise(stage, fault)
        yield name
        stage.main.reset()
    bench = stage.bench
    arm = bench.devices["arm"]
    status, simulated = arm.status, bench.simulated
    told: ArmStatus = replace(arm.status(), safety_mode=SafetyMode.HW_STOP)
    arm.status, bench.simulated = lambda: told, False
    _raise(stage, _alarm())
    stage.main._chips._drawn_s = float("-inf")
    stage.live(0.0)
    yield "fault-hardware-stop"
    arm.status, bench.simulated = status, simulated
    stage.main.reset()
    stage.main._chips._drawn_s = float("-inf")
    stage.live(0.0)


def _raise(stage: Stage, fault: Fault) -> None:
    stage.bench.interlock.raise_fault(fault)
    stage.bench.events.publish(FaultRaised(stage.bench.clock_s(), fault))
