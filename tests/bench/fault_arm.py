"""STOP in every state of the arm, over real sockets, and between any two of its requests."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping

import numpy as np

from tests.backend.devices.emulated_arm import Rig
from tests.backend.devices.melfa.stop_meets import interrupted, still
from tests.backend.devices.melfa.trials import PRESS
from tests.bench.arm_states import STATES, TROUBLED, Bench, State, pressed_in
from tests.bench.registry import Figure, figure
from touchdown.backend.core.values import Pose
from touchdown.backend.devices.protocols import DeviceState

STOPS, TROUBLES, WIRE_MS = 20, 26, 20.0
MODES = ("software", "controller")
AIR_S = 0.3


@figure("faults")
def stops_in_every_state(stops: int = STOPS) -> list[Figure]:
    """From STOP to the emulated controller, in each state; what went on all the same."""
    return _stopped("STOP in every state", STATES, stops)


@figure("faults")
def stops_beside_a_troubled_channel(stops: int = TROUBLES) -> list[Figure]:
    """The same while the command channel is silent, 2 s late, split or too long, in motion."""
    return _stopped("STOP beside a troubled command channel", TROUBLED, stops)


def _stopped(name: str, states: Mapping[str, State], stops: int) -> list[Figure]:
    took_ms: dict[str, list[float]] = {}
    broken: list[str] = []
    for mode in MODES:
        of_mode = {name: state for name, state in states.items() if state.mode == mode}
        if not of_mode:
            continue
        bench = Bench(mode)
        try:
            for state_name, state in of_mode.items():
                ended = [pressed_in(bench, state_name, state) for _ in range(stops)]
                reached = [1e3 * took_s for took_s, _ in ended if not math.isnan(took_s)]
                took_ms |= {state_name: reached} if reached else {}
                broken += [what for _, wrong in ended for what in wrong]
        finally:
            bench.close()
    wired = [ms for one, all_ms in took_ms.items() if states[one].wired for ms in all_ms]
    p50, p99, worst = np.percentile(wired, (50, 99, 100), method="lower")
    slow = sorted(took_ms, key=lambda one: -max(took_ms[one]))[:3]
    told = f"{len(wired)} stops in {len(took_ms)} states; median {p50:.1f}, worst {worst:.0f} ms; "
    told += ", ".join(f"{one} {max(took_ms[one]):.0f}" for one in slow)
    wrong = "; ".join(sorted(set(broken))[:3])
    return [
        Figure(f"{name}: to the wire, p99", float(p99), "ms", "<= 20", bool(p99 <= WIRE_MS), told),
        Figure(f"{name}: went on, or no latch", len(broken), "", "0", not broken, wrong),
    ]


def _connected(rig: Rig) -> None:
    rig.arm.connect(1.0, threading.Event())
    rig.rest(AIR_S)


def _stood(rig: Rig) -> None:
    _connected(rig)
    rig.arm.stop()
    rig.rest(AIR_S)


def _unpowered(rig: Rig) -> None:
    _connected(rig)
    rig.arm.servo(False)


ORDERS: Mapping[str, tuple[Callable[[Rig], None], Callable[[Rig], object], str]] = {
    "connecting": (lambda rig: None, _connected, "software"),
    "press of the controller": (_connected, lambda rig: rig.arm.press(PRESS), "controller"),
    "move after a stop": (
        _stood, lambda rig: rig.arm.move_to(Pose(0.0, 0.0, 120.0), 20.0), "software"
    ),
    "servo on": (_unpowered, lambda rig: rig.arm.servo(True), "software"),
    "servo off": (_connected, lambda rig: rig.arm.servo(False), "software"),
    "closing": (_connected, lambda rig: rig.arm.close(), "software"),
}  # fmt: skip


@figure("faults")
def stops_between_requests() -> list[Figure]:
    """STOP after each request of each order, by a hand-wound clock: what moved all the same."""
    broken, counts = [], []
    for name, (prepare, order, mode) in ORDERS.items():
        count = 0
        while True:
            rig = Rig(stiffness_mode=mode)
            rig.noise_n = 0.05
            prepare(rig)
            if interrupted(rig, lambda: order(rig), count) is None:  # noqa: B023 - called at once
                break
            idle = rig.arm.state is DeviceState.CLOSED or rig.arm._core.program is None
            if not (still(rig) and idle and rig.device.controller.program != "probe"):
                broken.append(f"{name}, request {count + 1}")
            count += 1
        counts.append(f"{name} {count}")
    told = ", ".join(counts) + "".join(f"; {one}" for one in broken[:3])
    text = "STOP between two requests: the arm moved all the same"
    return [Figure(text, len(broken), "", "0", not broken, told)]
