"""Late replies, outages and errors of the controller in every state, by hand-wound clock."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import numpy as np

from tests.backend.devices.emulated_arm import Rig
from tests.backend.devices.melfa.test_stream import FAR, LEAD_MM, SPEED_MM_S, doing, outage
from tests.bench.registry import Figure, figure
from touchdown.backend.core.faults import FaultError, RefusedError
from touchdown.backend.core.values import FloatArray, Pose
from touchdown.backend.devices.melfa.realtime_protocol import (
    CYCLE_S,
    MxtCommand,
    decode_mxt_request,
)
from touchdown.backend.devices.protocols import DeviceState

MINUTE_S, DOUBLED, REORDERED = 60.0, 0.10, 0.05
LATE_S = 0.5
OUTAGES_S = {0.060: False, 0.100: False, 0.200: True}
"""How long; whether it is a fault. One of 100 ms is 28 cycles, the fault comes with the 29th."""
MOST_JUMP_MM, FAULT_CYCLES = 0.25, 29
ALARMS, EMERGENCIES = (2000, 2601, 4140, 6020, 4242), (50, 61, 70)
STATES = ("stand", "travel", "jog", "press", "draw back", "unload", "held", "force program off")
R3_PERIOD_S = 0.1
ANSWER_CYCLES = 3
"""From a question to the controller to its answer, and to what follows from that."""


def _rig() -> Rig:
    rig = Rig()
    rig.arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    return rig


def _told(rig: Rig, since: int = 0) -> FloatArray:
    """Where the commands since a packet put the hand: (n, 3) mm."""
    targets = [decode_mxt_request(data).target for _, data in rig.wires.packets[since:]]
    axes = [np.array(target.axes[:6]) for target in targets if target is not None]
    return np.array([rig.placing.pivot_mm(joints) for joints in axes]).reshape(-1, 3)


def _moves(rig: Rig, since: int) -> int:
    sent = [decode_mxt_request(data).command for _, data in rig.wires.packets[since:]]
    return sent.count(MxtCommand.MOVE)


def _echo_first(rig: Rig) -> bool:
    """Connect anew; whether the arm is told to be where it is until an order comes."""
    here_mm, since = rig.true_mm, len(rig.wires.packets)
    rig.arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    told = _told(rig, since)
    return rig.arm.state is DeviceState.READY and float(np.abs(told - here_mm).max()) < 0.01


@figure("faults")
def doubled_and_reordered_replies() -> list[Figure]:
    """10 % doubled and 5 % out of order for a minute of travelling."""
    rig, back = _rig(), 0
    link, ratio = rig.wires.link, 0.0
    link.duplicate = DOUBLED
    link.late = lambda: 2 * (link.rng.random() < REORDERED)
    goals, travels, end_s = (160.0, 60.0), 0, rig.wires.clock.now_s() + MINUTE_S
    while rig.wires.clock.now_s() < end_s and rig.arm.state is DeviceState.READY:
        del rig.wires.packets[:]
        motion = rig.arm.move_to(Pose(0.0, 0.0, goals[travels % 2]), SPEED_MM_S)
        while not motion.done:
            rig.rest(0.5)
        way = 1.0 if travels % 2 == 0 else -1.0
        steps = np.diff(_told(rig), axis=0)
        back += int((way * steps[:, 2] < -1e-4).sum())
        ratio = max(ratio, float(np.linalg.norm(steps, axis=1).max()) / LEAD_MM)
        travels += 1
    counts = rig.arm._core.replies.counts
    ok = back == 0 and ratio <= 1.05 and rig.arm.state is DeviceState.READY
    ok = ok and counts.repeated > 1000 and counts.old > 500
    told = f"{travels} travels, {counts.repeated} doubled, {counts.old} old; step {ratio:.3f} leads"
    return [Figure("doubled and reordered replies, steps back", back, "", "0, no fault", ok, told)]


@figure("faults")
def replies_half_a_second_late() -> list[Figure]:
    """All replies of 90 and of 500 ms come at once: while the arm travels, and into a new start."""
    broken = []
    for late_s, lost in ((0.09, False), (LATE_S, True)):
        rig = _rig()
        link = rig.wires.link
        rig.arm.move_to(FAR, SPEED_MM_S)
        rig.rest(0.5)
        since, until = len(rig.wires.packets), link._cycle + round(late_s / CYCLE_S)
        # Those that were held up come after five that were not.
        link.late = lambda link=link, until=until: (
            until + 5 - link._cycle if link._cycle <= until else 0
        )
        rig.rest(late_s + 0.5)
        steps = np.linalg.norm(np.diff(_told(rig, since - 1), axis=0), axis=1)
        faulty = rig.arm.state is DeviceState.FAULT
        rows = {
            "state": faulty is lost,
            "a step": float(steps.max(initial=0.0)) <= 1.05 * LEAD_MM,
            "not met": lost or rig.arm._core.replies.counts.old >= late_s / CYCLE_S - 2,
        }
        broken += [f"{what} after {1e3 * late_s:.0f} ms" for what, well in rows.items() if not well]
    rig = _rig()
    link = rig.wires.link
    rig.arm.move_to(FAR, SPEED_MM_S)
    rig.rest(0.5)
    link.late = lambda: 300
    rig.rest(LATE_S)
    link.late = lambda: 0
    rig.arm.close()
    # What waits in the network comes into the start of the next stream.
    rig.device.controller.reset_error()
    waiting = len(link._waiting)
    if not _echo_first(rig):
        broken.append("the first command of the next stream is not the echo")
    told = f"{waiting} old replies met the next start" + "".join(f"; {one}" for one in broken)
    name = "replies of half a second at once: old positions used"
    return [Figure(name, len(broken), "", "0", not broken and waiting >= FAULT_CYCLES - 1, told)]


@figure("faults")
def outages_of_the_stream() -> list[Figure]:
    """60, 100 and 200 ms without a reply, and without this computer, travelling and pressing."""
    broken, jump_mm, count = [], 0.0, 0
    for seconds, lost in OUTAGES_S.items():
        for own in (False, True):
            for state in ("travel", "press"):
                rig = _rig()
                doing(rig, state)
                rig.wires.advance(3500)
                since = len(rig.wires.packets)
                if own:
                    rig.wires.stalled = True
                    rig.rest(28 * CYCLE_S if not lost and seconds > 0.09 else seconds)
                    rig.wires.stalled = False
                else:
                    outage(rig, 28 * CYCLE_S if not lost and seconds > 0.09 else seconds)
                rig.rest(0.3)
                told = _told(rig, since - 1)
                steps = np.linalg.norm(np.diff(told, axis=0), axis=1)
                jump_mm = max(jump_mm, float(steps.max(initial=0.0)))
                faulty = rig.arm.state is DeviceState.FAULT
                held = rig.arm._core.holds == (0 if lost else 1)
                if faulty is not lost or not (held or lost):
                    who = "this computer" if own else "replies"
                    broken.append(f"{1e3 * seconds:.0f} ms without {who} while {state}")
                count += 1
    ok = not broken and jump_mm <= MOST_JUMP_MM
    told_all = f"{count} outages, not as documented: {len(broken)}"
    told_all += "".join(f"; {one}" for one in broken[:3])
    name = "outages of 60, 100 and 200 ms, largest step afterwards"
    target = "<= 0.25, held, held, a fault"
    return [Figure(name, jump_mm, "mm", target, ok, told_all)]


@figure("faults")
def computers_that_die() -> list[Figure]:
    """The driver ends in mid-stream, in contact too: when the controller stops, and where."""
    worst, moved_mm, limit = 0, 0.0, 0
    for state in ("travel", "jog", "press"):
        for phase in range(4):
            rig = _rig()
            doing(rig, state)
            rig.rest(0.01 * phase)
            limit = rig.settings.mxt.mxttout
            rig.wires.stalled = True
            rig.wires.advance(3500)
            cycles, here_mm = 0, rig.true_mm
            while rig.device.controller.error == 0 and cycles < 2 * limit:
                rig.wires.advance(3500)
                cycles += 1
            rig.rest(0.1)
            worst = max(worst, cycles)
            moved_mm = max(moved_mm, float(np.abs(rig.true_mm - here_mm).max()))
            if rig.device.controller.servo or rig.device.controller.error == 0:
                worst = 2 * limit
    told = f"12 times; at most {moved_mm:.2f} mm after the last command"
    name = "computer dies in mid-stream: stopped by the controller after"
    target = f"<= {limit}, the set number"
    return [Figure(name, worst, "cycles", target, worst <= limit and moved_mm < 1.0, told)]


def _bring(rig: Rig, state: str) -> None:
    """Bring the arm into one of ``STATES``."""
    if state in ("stand", "travel", "jog", "press"):
        doing(rig, state)
    elif state == "held":
        rig.arm.move_to(FAR, SPEED_MM_S)
        rig.rest(0.5)
        rig.wires.link.cut = True
        rig.rest(0.05)
        rig.wires.link.cut = False
    elif state == "force program off":
        rig.arm.move_to(FAR, SPEED_MM_S)
        rig.rest(0.2)
        rig.arm.halt()
        rig.rest(0.2)
    else:
        doing(rig, "press")
        if state == "draw back":
            rig.arm.retreat()
        else:
            rig.rest(1.0)
            rig.arm.unload(1.0, 2.0)
        rig.rest(0.05)


@figure("faults")
def errors_while_anything_goes_on() -> list[Figure]:
    """Each error of the list in each state: when it is told, what is sent afterwards, how to go on.

    Servo off and the right taken by the teaching box, too; that one bars the next start.
    """
    kinds: Sequence[tuple[str, Callable[[Rig], None]]] = [
        *(
            (str(n), lambda rig, n=n: rig.device.controller.raise_error(n))
            for n in (*ALARMS, *EMERGENCIES)
        ),
        ("servo off", lambda rig: rig.device.controller.switch_servo(False)),
    ]
    broken, slowest_s, count = [], 0.0, 0
    for name, happen in kinds:
        for state in STATES:
            rig = _rig()
            _bring(rig, state)
            took_s, found = _ended(rig, happen, name)
            slowest_s = max(slowest_s, took_s)
            broken += [f"{name} while {state}: {what}" for what in found]
            count += 1
    for state in STATES:
        broken += [f"right taken while {state}: {what}" for what in _right_taken(state)]
        count += 1
    limit_s = R3_PERIOD_S + ANSWER_CYCLES * CYCLE_S
    told = f"{count} pairs of event and state" + "".join(f"; {one}" for one in broken[:3])
    name = "errors of the controller in every state: told after, at most"
    ok = not broken and slowest_s <= limit_s + 1e-6
    target = f"<= {1e3 * limit_s:.1f}: one period of the questions and the answer"
    return [Figure(name, 1e3 * slowest_s, "ms", target, ok, told)]


def _ended(rig: Rig, happen: Callable[[Rig], None], name: str) -> tuple[float, list[str]]:
    happen(rig)
    begun_s = rig.wires.clock.now_s()
    followed = rig.device.stream.commands

    def known() -> bool:
        fault = rig.arm.fault
        return fault is not None and (name in fault.what or not name.isdigit())

    while not known() and rig.wires.clock.now_s() - begun_s < 0.5:
        rig.wires.advance(3500)
    took_s, since = rig.wires.clock.now_s() - begun_s, len(rig.wires.packets)
    rig.rest(0.4)
    fault = rig.arm.fault
    emergency = int(name) in EMERGENCIES if name.isdigit() else False
    rows = {
        "not told": known() and rig.arm.state is DeviceState.FAULT,
        "not as an emergency": not emergency or (fault is not None and fault.code == "HW-STOP"),
        "a command afterwards": _moves(rig, since) == 0,
        "a command was obeyed": rig.device.stream.commands == followed,
    }
    rig.arm.close()
    rig.rest(1.0)
    rows["connected by itself"] = rig.arm.state is DeviceState.CLOSED
    if name.isdigit():
        try:
            rig.arm.connect(1.0, threading.Event())
            rows["taken with its error"] = False
        except FaultError as error:
            rows["taken with its error"] = name in error.fault.what
    rows["a command before the reset"] = rig.device.stream.commands == followed
    rig.device.controller.emergency = False
    rig.device.controller.reset_error()
    rows["not the echo first"] = _echo_first(rig)
    return took_s, [what for what, well in rows.items() if not well]


def _right_taken(state: str) -> list[str]:
    rig = _rig()
    _bring(rig, state)
    rig.device.controller.right = "teaching box"
    rig.rest(0.4)
    rig.arm.close()
    followed = rig.device.stream.commands
    rows = {}
    try:
        rig.arm.connect(1.0, threading.Event())
        rows["connected without the right"] = False
    except (FaultError, RefusedError) as error:
        rows["not said"] = bool(str(error))
    rows["a command without the right"] = rig.device.stream.commands == followed
    rig.device.controller.right = None
    rows["not the echo first"] = _echo_first(rig)
    return [what for what, well in rows.items() if not well]
