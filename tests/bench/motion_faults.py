"""Faults of controller and contact, by stepped clock.

Peaks: one axis against a spring, built apart from the driver (``contact_loop``); the law of
compliance, the detector of swings and the limits are the shipped ones.
"""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from tests.backend.devices.emulated_arm import Rig
from tests.backend.devices.melfa.test_stream import FAR, LEAD_MM, SPEED_MM_S, doing, outage
from tests.backend.devices.streamed.contact_loop import Plant
from tests.backend.rig.inline import InlineBench
from tests.bench.registry import Figure, figure
from touchdown.backend.config.method import StackSettings
from touchdown.backend.core.events import EpisodeRecorded, Event, FaultRaised, PhaseEntered
from touchdown.backend.core.faults import FaultError, RefusedError, TouchdownError
from touchdown.backend.core.streams import Stream
from touchdown.backend.core.values import FINGERS, FloatArray, Pose
from touchdown.backend.devices.guarded_devices import GuardedArm
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.devices.melfa.realtime_protocol import (
    CYCLE_S,
    MxtCommand,
    decode_mxt_request,
)
from touchdown.backend.devices.protocols import RETREAT_MM, RETREAT_MM_S, DeviceState
from touchdown.backend.devices.streamed.compliance import (
    AT_REST,
    TRIP_N,
    AdmittanceLaw,
    LoopDelays,
    SwingDetector,
    admittance_law,
    deflect,
)
from touchdown.backend.devices.supervision import Supervision
from touchdown.backend.runs.requests import StackRequest

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


MISSES, EARLY = 10, 20
BACK_MM, ROSE_MM, SOON_MM, MAX_EARLY_CONTACT_N = 0.1, (1.6, 2.6), 0.01, 60.0
START_MM, WANTED_MM, EARLY_MM, GEL_N_MM, ROUND_US = 80.0, 62.0, (5.0, 12.0), 8.0, 10_500


@figure("faults")
def descents_into_nothing(misses: int = MISSES) -> list[Figure]:
    """A press that ends its travel without a contact, in a whole run over the rig."""
    method = StackSettings()
    nowhere = {"max_travel_mm": 0.01, "start_height_mm": 3.0}
    probe = method.probe.model_copy(update=nowhere)
    bench = InlineBench(method.model_copy(update={"probe": probe}))
    facts: list[Event] = []
    began_mm: list[float] = []

    def hear(fact: Event) -> None:
        if isinstance(fact, PhaseEntered) and fact.phase == "approach":
            facts.clear()
            began_mm.append(height_mm())
        facts.append(fact)

    def height_mm() -> float:
        scene = bench.session._scene
        assert scene is not None
        return float(scene.stage.arm.pose(1.0).z_mm)

    bench.session.events.subscribe(hear)
    off_mm, presses, seeds = list[float](), 0, itertools.count()
    try:
        while len(off_mm) < misses:
            with suppress(TouchdownError):
                bench.session.run(StackRequest("pot", ("short",), next(seeds)))
            bench.session.reset()
            if "NO-CONTACT" not in {f.fault.code for f in facts if isinstance(f, FaultRaised)}:
                continue  # this board stood high enough
            off_mm.append(abs(height_mm() - began_mm[-1]))
            presses += sum(isinstance(f, EpisodeRecorded) for f in facts)
            presses += sum(isinstance(f, PhaseEntered) and f.phase == "press" for f in facts)
    finally:
        bench.close()
    worst = max(off_mm)
    told = f"{misses} runs of {next(seeds)}; the others met a contact"
    return [
        Figure("no contact: back to the start within", worst, "mm", "<= 0.1", worst <= BACK_MM,
               told),
        Figure("no contact: presses or episodes", presses, "", "0", presses == 0),
    ]  # fmt: skip


@figure("faults")
def contacts_too_early(count: int = EARLY) -> list[Figure]:
    """A board 5 to 12 mm too high is met by a move: how far the arm draws back, and how hard."""
    rng = np.random.default_rng(9)
    rose_mm, peak_n, broken = list[float](), list[float](), list[str]()
    for _ in range(count):
        early_mm, speed_mm_s = rng.uniform(*EARLY_MM), rng.uniform(5.0, 20.0)
        rose, peak, codes = _early(WANTED_MM + early_mm, speed_mm_s)
        rose_mm.append(rose)
        peak_n.append(peak)
        if codes != ["FT-TRIP"]:
            broken.append(f"{early_mm:.1f} mm, {speed_mm_s:.0f} mm/s: {codes}")
    low, high = min(rose_mm), max(rose_mm)
    well = not broken and low >= ROSE_MM[0] and high <= ROSE_MM[1]
    told = f"{count} descents; {low:.2f} to {high:.2f} mm" + "".join(f"; {b}" for b in broken[:2])
    hardest = max(peak_n)
    return [
        Figure(
            "contact 5 to 12 mm early: drawn back by, least",
            low,
            "mm",
            "2 within the brake",
            well,
            told,
        ),
        Figure(
            "contact 5 to 12 mm early: largest force",
            hardest,
            "N",
            "<= 60",
            hardest <= MAX_EARLY_CONTACT_N,
        ),
    ]


def _early(board_mm: float, speed_mm_s: float) -> tuple[float, float, list[str]]:
    """Move down on a board; return how far the arm rose again, the peak and what was told."""
    rig = Rig((0.0, 0.0, START_MM))
    rig.contact = lambda mm: np.array([0.0, 0.0, GEL_N_MM * max(board_mm - mm[2], 0.0)])
    interlock, now_s = Interlock(), rig.wires.clock.now_s
    arm = GuardedArm(rig.arm, interlock, now_s, lambda: 0.0)
    watch = Supervision(interlock, rig.wrench, {finger: Stream(finger, 4) for finger in FINGERS})
    arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    # No cameras here: within the grace after a scene began nobody asks for their pictures.
    watch.begin(now_s() + 100.0)
    interlock.renew_lease(now_s())
    motion = arm.move_to(Pose(0.0, 0.0, WANTED_MM), speed_mm_s)
    lowest_mm, end_s = math.inf, now_s() + 30.0
    while not motion.done and now_s() < end_s:
        rig.wires.advance(ROUND_US)
        watch.check(now_s())
        lowest_mm = min(lowest_mm, float(rig.true_mm[2]))
    rig.rest(1.0)
    peak_n = float(rig.wrench.since(0).values[:, 2].max())
    return float(rig.true_mm[2]) - lowest_mm, peak_n, [f.code for f in interlock.faults]


GAINS = (30.0, 30.0, 15.0)
SOFT_N, STIFF_N = 30.0, 100.0
"""Stiffness that the damping is made for, N/mm: the usual one, and that of a stiff contact."""
TRIPPED = math.inf
"""The published law swings there until the trip at 40 N."""
PEAKS: dict[tuple[float, float, float], dict[float, float]] = {
    (0.0035, SOFT_N, 2.0): {1: 2.4, 3: 4.8, 10: 10.4, 30: 17.3, 100: TRIPPED},
    (0.0035, STIFF_N, 2.0): {1: 2.4, 3: 5.0, 10: 11.5, 30: 20.2, 100: 27.9},
    (0.0071, SOFT_N, 2.0): {1: 2.4, 3: 4.9, 10: 11.0, 30: 18.4, 100: TRIPPED},
    (0.0071, STIFF_N, 2.0): {1: 2.5, 3: 5.2, 10: 12.5, 30: 22.7, 100: 32.0},
    (0.010, SOFT_N, 2.0): {1: 2.5, 3: 5.0, 10: 11.4, 30: 19.3, 100: TRIPPED},
    (0.010, STIFF_N, 2.0): {1: 2.5, 3: 5.3, 10: 13.1, 30: 24.6, 100: 34.9},
    (0.030, SOFT_N, 1.0): {1: 2.6, 3: 5.3, 10: 11.9, 30: 20.7, 100: TRIPPED},
    (0.030, STIFF_N, 1.0): {1: 2.6, 3: 5.6, 10: 13.9, 30: 27.0, 100: 38.8},
    (0.030, SOFT_N, 2.0): {1: 2.8, 3: 5.9, 10: 14.0, 30: 25.5, 100: TRIPPED},
}
"""Published peaks in N by cycle (s), design stiffness, speed (mm/s), and stiffness met (N/mm)."""
WITHIN, MAX_PEAK_N, SWING_MOST_N = 0.10, 60.0, 40.0
STIFFER, CYCLES_S, DELAYS = (2.0, 3.0, 4.0, 5.0), (0.0035, 0.0071, 0.010), 12.0
SEEDS = range(3)


@dataclass
class _Press:
    peak_n: float = 0.0
    tripped: bool = False
    swung_s: float = math.inf
    """After the first touch; infinite where nothing was found to swing."""


def _pressed(
    law: AdmittanceLaw,
    loop: LoopDelays,
    stiff_n_mm: float,
    speed_mm_s: float,
    *,
    watched: bool,
    seed: int,
) -> _Press:
    """Press 1.5 mm beyond the detection for 4 s; draw back at the trip, freeze at a swing."""
    rng, plant, found = np.random.default_rng(seed), Plant(loop, 0.5), _Press()
    detector = SwingDetector(loop.delay_s)
    reference, goal, give, high, over = 0.5, -math.inf, AT_REST, 0, 0
    command, touched_s, up_mm = reference, math.inf, math.inf
    for k in range(round(4.0 / loop.cycle_s)):
        now_s = k * loop.cycle_s
        true_n = stiff_n_mm * max(-plant.place_mm, 0.0)
        if true_n > 0.0:
            touched_s = min(touched_s, now_s)
        found.peak_n = max(found.peak_n, true_n)
        felt = true_n + rng.normal(0.0, 0.1)
        high = high + 1 if felt > 1.0 else 0
        over = over + 1 if felt > TRIP_N else 0
        if goal == -math.inf and high >= 3:
            goal = reference - 1.5
        if over >= 2 and not found.tripped:
            found.tripped, up_mm = True, reference + RETREAT_MM
        if found.tripped:
            reference = min(reference + RETREAT_MM_S * loop.cycle_s, up_mm)
        elif found.swung_s == math.inf:
            reference = max(reference - speed_mm_s * loop.cycle_s, goal)
        if goal > -math.inf:
            give = deflect(law, give, np.array([0.0, 0.0, felt]))
            if watched and found.swung_s == math.inf and detector.feed(now_s, felt):
                found.swung_s = now_s - touched_s
                law = replace(law, damping=2.0 * law.damping, mass=2.0 * law.mass)
        command = reference + float(give.d_mm[2])
        plant.step(command)
    return found


@figure("faults")
def peaks_of_presses() -> list[Figure]:
    """Springs of 1 to 100 N/mm at each cycle: peaks beside the published, and the strongest."""
    off, strongest, swinging, where = 0.0, 0.0, 0.0, ""
    for (cycle_s, design, speed), row in PEAKS.items():
        loop = LoopDelays(cycle_s)
        law = admittance_law(loop, GAINS, design)
        for stiff, published in row.items():
            runs = [_pressed(law, loop, stiff, speed, watched=False, seed=s) for s in SEEDS]
            peak = float(np.median([run.peak_n for run in runs]))
            strongest = max(strongest, *(run.peak_n for run in runs))
            if published == TRIPPED:
                swinging = max(swinging, peak)
            elif abs(peak - published) > 0.15 and abs(peak / published - 1.0) > off:
                off = abs(peak / published - 1.0)
                where = f"{1e3 * cycle_s:.1f} ms, made for {design:.0f}, met {stiff} N/mm"
    ok = off <= WITHIN and strongest <= MAX_PEAK_N
    told = f"strongest {strongest:.1f} N (limit 60); farthest at {where}; "
    told += f"{swinging:.1f} N where the published one trips"
    return [Figure("peaks of presses beside the published", 100 * off, "%", "<= 10", ok, told)]


@figure("faults")
def contacts_that_swing() -> list[Figure]:
    """Contacts 2 to 5 times as stiff as the damping is made for: when the swing is found."""
    slowest, strongest, silent, alarms = 0.0, 0.0, 0, 0
    for cycle_s in CYCLES_S:
        loop = LoopDelays(cycle_s)
        law = admittance_law(loop, GAINS, SOFT_N)
        for times in STIFFER:
            for seed in SEEDS:
                found = _pressed(law, loop, times * SOFT_N, 1.0, watched=True, seed=seed)
                strongest = max(strongest, found.peak_n)
                # Twice the design is stable still: its transient may be found, or die away.
                if found.swung_s < math.inf:
                    slowest = max(slowest, found.swung_s / loop.delay_s)
                else:
                    silent += times > STIFFER[0]
        for stiff in (1.0, 3.0, 8.0, 10.0, 30.0):
            for speed in (1.0, 2.0):
                found = _pressed(law, loop, stiff, speed, watched=True, seed=1)
                alarms += found.swung_s < math.inf
    ok = slowest <= DELAYS and strongest < SWING_MOST_N and silent == 0 and alarms == 0
    told = f"strongest {strongest:.1f} N (limit 40); {silent} not found, {alarms} false alarms"
    name = "contacts 2 to 5 times too stiff: swing found after the touch"
    return [Figure(name, slowest, "loop delays", "<= 12", ok, told)]
