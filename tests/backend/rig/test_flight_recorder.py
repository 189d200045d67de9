"""The flight recorder against a disk that is full and a death while it writes."""

import json
import math
import signal
import subprocess
import sys
import threading
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from tests.backend.devices.test_interlock import GOOD
from tests.backend.rig.hosted import reason
from touchdown.backend.core import FaultError, FaultRaised, RunFinished, RunStarted
from touchdown.backend.devices.protocols import DeviceState, GripStatus, RobotMode
from touchdown.backend.rig import process
from touchdown.backend.rig.flight_recorder import RESERVED_BYTES, FlightRecorder, ReservedFile
from touchdown.backend.rig.link import GONE
from touchdown.backend.rig.memory import STOPS, drop, make

ROOT = Path(__file__).resolve().parents[3]
RUN = RunStarted(0.0, "run", "pot", "short", "touch", 7, 1, False, "{}")
SAMPLES = 5000  # of a wrist sensor of 1 kHz in the recorded time

RECORDING = """
import os, signal, sys
from pathlib import Path
from touchdown.backend.core.events import FaultRaised
from touchdown.backend.rig.link import GONE
from tests.backend.rig.test_flight_recorder import RUN, recorder

folder, moment = Path(sys.argv[1]), sys.argv[2]
made = recorder(folder)
made.note(RUN)

def full():
    # What else is on this disk takes all that is left.
    with (folder / "other").open("wb", buffering=0) as file:
        while file.write(bytes(4096)) == 4096:
            pass

def die(*args, **kinds):
    os.kill(os.getpid(), signal.SIGKILL)

if moment == "full":
    try:
        full()
    except OSError as error:
        assert os.strerror(error.errno) == "No space left on device", error
elif moment != "never":
    setattr(os, moment, die)
made.note(FaultRaised(6.0, GONE))
for name in sorted(p.name for p in folder.iterdir()):
    print(name, (folder / name).stat().st_size)
print((folder / "flight-1.jsonl").read_text().splitlines()[0])
"""


def recorder(folder):
    """A recorder of a rig that has felt the wrist for five seconds."""
    memory, path = make()
    drop(path)
    t_s = np.linspace(1.0, 6.0, SAMPLES)
    memory.wrench.put(t_s, np.sin(t_s[:, None] * np.arange(1, 7)))
    return FlightRecorder(lambda: memory, lambda: folder)


def child(folder, moment):
    return [sys.executable, "-c", RECORDING, str(folder), moment]


linux = pytest.mark.skipif(sys.platform != "linux", reason="the room is a file without a name")


def reserves(folder):
    """True if this file system keeps room for files without a name."""
    reserve = ReservedFile()
    able = reserve.take(folder, 4096)
    reserve.give_back()
    return able


@pytest.mark.promise("D2")
def test_a_full_disk_still_takes_the_last_seconds(tmp_path):
    small = 'mount -t tmpfs -o size=6m none "$0" && exec "$@"'
    inside = ["unshare", "-Urm", "sh", "-c", small, str(tmp_path), *child(tmp_path, "full")]
    try:
        allowed = subprocess.run(["unshare", "-Urm", "true"], check=False, capture_output=True)
    except FileNotFoundError:
        pytest.skip("only Linux has disks of one process")
    if allowed.returncode != 0:
        pytest.skip("this system gives users no disks of their own")
    done = subprocess.run(inside, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (name, size), _, head = (line.split(maxsplit=1) for line in done.stdout.splitlines())
    assert name == "flight-1.jsonl"
    assert 100 * SAMPLES < int(size) < RESERVED_BYTES
    assert json.loads(" ".join(head))["fault"]["code"] == "CONTROL-LOST"


@linux
def test_killed_before_it_has_a_name_it_leaves_nothing_torn_and_no_room_taken(tmp_path):
    done = subprocess.run(child(tmp_path, "link"), cwd=ROOT, check=False)
    assert done.returncode == -signal.SIGKILL
    assert list(tmp_path.iterdir()) == []


@linux
def test_the_room_is_given_back_with_the_run(tmp_path):
    if not reserves(tmp_path):
        pytest.skip("this file system knows no files without a name")
    made = recorder(tmp_path)

    def kept():
        held = [path for path in Path("/proc/self/fd").iterdir() if path.exists()]
        ours = [path for path in held if str(tmp_path) in str(path.readlink())]
        return [path.stat().st_blocks * 512 for path in ours]

    made.note(RUN)
    assert kept() == [RESERVED_BYTES]
    made.note(FaultRaised(6.0, GONE))
    # For the next one there is room again.
    assert kept() == [RESERVED_BYTES]
    made.note(RunFinished(7.0, "run", "failed", "lost"))
    assert kept() == []
    assert [path.name for path in tmp_path.iterdir()] == ["flight-1.jsonl"]


def moved_mm(rig, seconds):
    """How far the command goes in so long."""
    before = rig.arm.describe()["z_mm"]
    rig.rounds(seconds)
    return abs(rig.arm.describe()["z_mm"] - before)


def test_an_order_moves_and_its_end_is_told_after_its_beginning(rig):
    target = (0.0, 0.0, 61.0, 0.0, 0.0, 0.0)
    motion = rig.order("arm.move_to", target=target, speed_mm_s=20.0, turn_rad_s=0.1)
    rig.rounds(1.0, until=lambda: rig.told("ended"))
    assert rig.fault_of(motion) is None
    kinds = [m["kind"] for m in rig.said if m.get("motion") == motion]
    assert kinds == ["reply", "ended"]
    t_s, values, _ = rig.memory.poses.since(0)
    assert values[-1, 2] == pytest.approx(61.0, abs=0.05)
    assert t_s[-1] == pytest.approx(rig.clock.now_s(), abs=0.01)
    rig.rounds(0.1)
    state = rig.memory.seen()
    assert state["arm"]["status"][0] == RobotMode.READY.value
    assert state["gripper"]["grip"] == [30.0, 10.0, True]


def test_a_backend_that_falls_silent_leaves_an_arm_that_stands(rig):
    motion = rig.lift()
    assert moved_mm(rig, 0.1) > 0.5
    rig.beats = False
    rig.rounds(0.26)
    assert rig.fault_of(motion).code == "BACKEND-SILENT"
    assert [m["fault"]["code"] for m in rig.told("fault")] == ["BACKEND-SILENT"]
    rig.rounds(0.1)
    assert moved_mm(rig, 0.1) == 0.0
    # The stream itself goes on: the arm was held, not switched off.
    assert rig.arm.status().robot_mode is RobotMode.READY
    rig.beats = True
    rig.rounds(0.02)
    assert reason(rig.lift) == "FAULT"
    rig.host.take({"kind": "reset", "stops": 0, "faults": 1})
    rig.lift()
    assert moved_mm(rig, 0.1) > 0.5


@pytest.mark.promise("R13")
def test_a_lease_that_is_not_renewed_ends_the_motion_and_nothing_else(rig):
    motion = rig.lift()
    rig.rounds(0.05)
    rig.neglect(1.9)
    rig.rounds(0.12)
    assert rig.fault_of(motion).code == "LEASE-LAPSED"
    assert rig.told("fault") == []
    rig.rounds(0.1)
    assert moved_mm(rig, 0.1) == 0.0
    assert reason(rig.lift) == "NO-LEASE"
    rig.renew()
    rig.lift()


def test_stop_ends_the_stream_in_the_same_round(rig):
    rig.lift()
    rig.rounds(0.05)
    sent = len(rig.arms.wires.packets)
    rig.stop(1)
    rig.rounds(0.02)
    assert rig.log == ["stop gripper"]
    ends = [packet for _, packet in rig.arms.wires.packets[sent:]]
    assert len(set(ends)) == 1
    assert rig.arm.describe()["stream"] == "idle"
    assert reason(rig.lift) == "STOPPED"


@pytest.mark.promise("R14")
def test_stop_that_comes_while_an_order_is_begun_is_not_forgotten(rig):
    begin = rig.arm.move_to

    def interrupted(*given):
        rig.stop(1)
        return begin(*given)

    rig.arm.move_to = interrupted
    rig.rounds(0.05)
    motion = rig.lift()
    assert moved_mm(rig, 0.5) < 0.01
    assert rig.fault_of(motion).code == "STOPPED"
    assert rig.arm.describe()["stream"] == "idle"
    assert reason(rig.lift) == "STOPPED"


def test_without_a_backend_the_rig_stops_the_arm_and_wants_to_leave(rig):
    rig.lift()
    rig.rounds(0.05)
    rig.host.leave()
    assert rig.rounds(0.004)
    assert "stop gripper" in rig.log
    assert rig.arm.describe()["stream"] in ("ending", "idle")


@pytest.mark.promise("P9")
def test_who_notices_that_the_backend_is_gone_stops_the_arm_at_once_and_waits_for_no_round(rig):
    rig.lift()
    rig.rounds(0.05)
    before = rig.arms.wires.stops
    rig.host.abandon()
    assert rig.arms.wires.stops == before + 1
    assert rig.log == ["stop gripper"]
    assert rig.arm.describe()["stream"] == "ending"
    assert rig.rounds(0.004)


def test_a_retreat_draws_back_and_goes_on_although_nobody_holds_a_lease_any_more(rig):
    rig.lift()
    rig.rounds(0.3)
    before = rig.arm.describe()["z_mm"]
    rig.neglect(10.0)
    rig.host.take({"kind": "retreat"})
    rig.rounds(0.5)
    assert rig.arm.describe()["z_mm"] == pytest.approx(before + 2.0, abs=0.01)
    assert (rig.arm.describe()["stream"], rig.told("fault")) == ("open", [])
    assert reason(rig.lift) == "NO-LEASE"


@pytest.mark.promise("G8")
def test_the_rig_refuses_what_is_past_the_limits_whoever_asks(rig):
    def move(z_mm, speed_mm_s=20.0):
        target = (0.0, 0.0, z_mm, 0.0, 0.0, 0.0)
        return rig.order("arm.move_to", target=target, speed_mm_s=speed_mm_s, turn_rad_s=0.1)

    assert reason(lambda: move(-1.0)) == "HEIGHT"
    assert reason(lambda: move(math.nan)) == "HEIGHT"
    assert reason(lambda: move(80.0, 51.0)) == "SPEED"
    assert reason(lambda: move(80.0, math.nan)) == "SPEED"
    jog = {"velocity_mm_s": (0.0, 0.0, 60.0), "for_s": 0.1, "turn_rad_s": (0.0, 0.0, 0.0)}
    assert reason(lambda: rig.order("arm.jog", **jog)) == "SPEED"
    press = {
        "depth_mm": 3.0, "ramp_s": 1.5, "hold_s": 2.0, "approach_mm_s": 2.0, "threshold_n": 1.0,
        "max_travel_mm": 3.0, "stiffness_n_mm": (30.0, 30.0, 15.0),
    }  # fmt: skip
    assert reason(lambda: rig.order("arm.press", **press)) == "PRESS-FORCE"
    dragged = {**press, "depth_mm": 0.8, "drag_mm": 1.1}
    assert reason(lambda: rig.order("arm.press", **dragged)) == "PRESS-FORCE"
    with pytest.raises(ValueError, match="no order"):
        rig.order("arm.fly")
    assert rig.arm.status().robot_mode is RobotMode.READY


def test_nothing_moves_while_the_wrist_is_silent(rig):
    rig.arms.wires.also = rig.clock.advance
    rig.rounds(0.32)
    assert reason(rig.lift) == "FT-STALE"


def test_a_held_piece_is_let_go_by_a_right_only(rig):
    rig.rounds(0.3)
    plain = {"width_mm": 50.0, "speed_mm_s": 10.0}
    assert reason(lambda: rig.order("gripper.open_to", **plain)) == "HOLDING"
    hand = {"right": "ByHand", "evidence": {"confirmed": True}, **plain}
    rig.order("gripper.open_held", **hand)
    assert rig.log == ["open to 50.0"]
    rig.lift()
    rig.rounds(0.1)
    assert reason(lambda: rig.order("gripper.open_held", **hand)) == "RIG-ARM-MOVING"
    jig = {"from_jig_mm": 0.0, "moved_mm": 0.0, "force_n": 0.0, "holding": True}
    back = {"right": "JigEvidence", "evidence": jig, **plain}
    rig.order("arm.halt")
    rig.rounds(0.3)
    rig.gripper.grip_status = GripStatus(30.4, 10.0, holding=True)
    assert reason(lambda: rig.order("gripper.open_held", **back)) == "RIG-WIDTH"
    rig.wrist.state = DeviceState.FAULT
    assert reason(lambda: rig.order("gripper.open_held", **back)) == "RIG-DEVICES"
    assert rig.log == ["open to 50.0"]


def stage(rig):
    """Bring the rig to a first step: the press force is that of an unloaded piece."""
    rig.arms.contact = lambda pivot: np.array([0.0, 0.0, 8.0 * max(59.5 - pivot[2], 0.0)])
    rig.rounds(0.3)
    rig.order(
        "arm.press", depth_mm=0.5, ramp_s=0.2, hold_s=0.4, approach_mm_s=2.0, threshold_n=1.0,
        max_travel_mm=3.0, stiffness_n_mm=(30.0, 30.0, 15.0),
    )  # fmt: skip
    rig.rounds(2.0, until=lambda: rig.told("ended"))
    rig.order("arm.unload", force_n=1.0, speed_mm_s=2.0)
    rig.rounds(2.0, until=lambda: len(rig.told("ended")) == 2)
    rig.rounds(0.4)
    return {"evidence": asdict(GOOD), "width_mm": 30.1, "speed_mm_s": 5.0, "force_n": 8.0}


def test_the_rig_opens_in_stages_by_its_own_measurements(rig):
    first = stage(rig)
    later = {**first, "evidence": None, "width_mm": 30.2}
    assert reason(lambda: rig.order("gripper.open_step", **later)) == "NOT-STAGED"
    bad = {**first, "evidence": asdict(replace(GOOD, approved=False))}
    assert reason(lambda: rig.order("gripper.open_step", **bad)) == "NOT-APPROVED"
    rig.order("gripper.open_step", **first)
    assert rig.log == ["open to 30.1"]
    assert reason(lambda: rig.order("gripper.open_step", **later)) == "STAGE-EARLY"
    assert reason(rig.lift) == "JAWS-LOOSE"
    rig.rounds(1.0)
    rig.order("gripper.open_step", **later)
    assert rig.log == ["open to 30.1", "open to 30.2"]
    rig.arms.wires.also = rig.clock.advance
    rig.rounds(1.02)
    wider = {**later, "width_mm": 30.3}
    assert reason(lambda: rig.order("gripper.open_step", **wider)) == "RIG-WRENCH-OLD"


@pytest.mark.parametrize("by", ["memory", "message", "gripper", "silence"])
def test_a_stop_of_the_rig_closes_loosened_jaws(rig, by):
    rig.order("gripper.open_step", **stage(rig))
    if by == "memory":
        rig.memory.beat(STOPS)
    elif by == "silence":
        rig.host.abandon()
    else:
        kind = {"message": {"kind": "stop", "stops": 1}, "gripper": {"kind": "stop gripper"}}
        rig.host.take(kind[by])
    rig.rounds(0.02)
    rig.host.take({"kind": "stop gripper"})
    assert rig.log[1:] == ["grip 8.0"]


@pytest.mark.parametrize("by", ["grip", "stop"])
def test_closing_jaws_are_not_interrupted_by_a_stop_or_by_the_end_of_the_process(rig, by):
    rig.order("gripper.open_step", **stage(rig))
    if by == "grip":
        rig.order("gripper.grip", force_n=8.0)
    rig.host.take({"kind": "stop", "stops": 1})
    ended = threading.Event()
    rig.gripper.stop = ended.set
    closing = rig.host.orders.closing
    threading.Timer(0.2, closing.end).start()
    begun_s = time.monotonic()
    process._end(rig.host)
    assert time.monotonic() - begun_s >= 0.2
    assert (rig.log[1:2], ended.is_set()) == (["grip 8.0"], False)


def test_an_opening_by_hand_ends_the_stages_of_the_rig(rig):
    rig.order("gripper.open_step", **stage(rig))
    hand = {"right": "ByHand", "evidence": {"confirmed": True}}
    rig.order("gripper.open_held", **hand, width_mm=50.0, speed_mm_s=10.0)
    rig.lift()


@pytest.mark.parametrize("by", ["beats", "lease"])
def test_loosened_jaws_close_while_the_backend_is_silent(rig, by):
    rig.order("gripper.open_step", **stage(rig))
    if by == "beats":
        rig.beats = False
        rig.rounds(0.3)
        (told,) = rig.told("fault")
        assert told["fault"]["code"] == "BACKEND-SILENT"
    else:
        rig.neglect(0.25)
        rig.rounds(1.7)
        assert rig.log == ["open to 30.1"]
        rig.rounds(0.2)
    assert rig.log == ["open to 30.1", "grip 8.0"]


def test_the_width_of_a_grip_is_the_one_at_which_the_jaws_stand(rig):
    """A gripper tells that it holds before it tells its last width."""
    jig = {"from_jig_mm": 0.0, "moved_mm": 0.0, "force_n": 0.0, "holding": True}
    back = {"right": "JigEvidence", "evidence": jig, "width_mm": 50.0, "speed_mm_s": 10.0}
    rig.gripper.grip_status = GripStatus(50.0, 0.0, holding=False)
    rig.rounds(0.02)
    rig.gripper.grip_status = GripStatus(32.4, 10.0, holding=True)
    rig.rounds(0.05)
    rig.gripper.grip_status = GripStatus(30.0, 10.0, holding=True)
    rig.rounds(0.1)
    assert reason(lambda: rig.order("gripper.open_held", **back)) == "RIG-WIDTH"
    rig.rounds(0.3)
    rig.order("gripper.open_held", **back)
    assert rig.log == ["open to 50.0"]


def test_a_press_tells_its_contact_and_what_it_still_feels(rig):
    rig.arms.contact = lambda pivot: np.array([0.0, 0.0, 8.0 * max(59.5 - pivot[2], 0.0)])
    rig.rounds(0.3)
    press = rig.order(
        "arm.press", depth_mm=0.5, ramp_s=0.2, hold_s=0.4, approach_mm_s=2.0, threshold_n=1.0,
        max_travel_mm=3.0, stiffness_n_mm=(30.0, 30.0, 15.0),
    )  # fmt: skip
    rig.rounds(2.0, until=lambda: rig.told("ended"))
    assert rig.fault_of(press) is None
    (felt,) = rig.told("felt")
    assert 0.0 < felt["onset_s"] < felt["detected_s"]
    measured = rig.host.measured()
    assert measured.press_n == pytest.approx(8.0 * (59.5 - rig.arms.true_mm[2]), abs=0.3)
    assert (measured.holding, measured.devices_ready) == (True, True)


def test_the_last_seconds_are_written_beside_the_journal(rig, tmp_path):
    recorder = FlightRecorder(lambda: rig.memory, lambda: tmp_path)
    rig.lift()
    rig.rounds(0.2)
    rig.stop(1)
    rig.rounds(0.02)
    now_s = rig.clock.now_s()
    recorder.note(FaultRaised(now_s, GONE))
    head, *rest = map(json.loads, (tmp_path / "flight-1.jsonl").read_text().splitlines())
    assert head["fault"]["code"] == "CONTROL-LOST"
    assert [line["t_s"] for line in rest] == sorted(line["t_s"] for line in rest)
    rounds = [
        dict(zip(head["round"], line["round"], strict=True)) for line in rest if "round" in line
    ]
    assert rounds[-1]["command_z_mm"] > rounds[0]["command_z_mm"] + 1.0
    assert sum("wrench" in line for line in rest) > 150
    notes = [line["note"] for line in rest if "note" in line]
    assert any("arm.move_to" in note for note in notes)
    assert notes[-2:] == ["stop", "motion 1 ended: STOPPED"]


@pytest.mark.promise("P6")
def test_an_error_of_this_program_is_told_and_ends_no_thread(rig):
    with pytest.raises(FaultError) as caught:
        rig.order("arm.servo")
    assert caught.value.fault.code == "RIG-ERROR"
    rig.order("arm.servo", on=True)
