"""Fault cards with texts of their sources, and a hardware stop, for ``make screens``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from touchdown.backend.bench.emulated_child import NOT_SET, STILL
from touchdown.backend.core import Fault, FaultRaised
from touchdown.backend.devices.force_torque.reader import driver_fault
from touchdown.backend.devices.melfa.command_channel import RESETS
from touchdown.backend.devices.melfa.faults import controller_fault, oversize_fault
from touchdown.backend.devices.protocols import ArmStatus, SafetyMode
from touchdown.backend.runs.calibrations import other_gel_fault
from touchdown.backend.runs.engine import bench_fault
from touchdown.backend.runs.probe import turned_fault

if TYPE_CHECKING:
    from tests.screens import Stage

EMERGENCY = 61


def _alarm() -> Fault:
    told = controller_fault(EMERGENCY, "Emergency stop (external)")
    return replace(told, next_step=f"{told.next_step} {RESETS}")


def _cards() -> Mapping[str, Sequence[Fault]]:
    swapped = "It is the gel of the right finger: put the two back."
    gel = other_gel_fault(
        "left", (8.2, 3.0), swapped, "touchdown calibrate camera --bench lab.toml"
    )
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
