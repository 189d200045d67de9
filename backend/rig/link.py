"""Backend end of the real-time process: start, orders, heartbeat, loss.

Every 5 ms one thread sends a heartbeat, forwards the lease and copies the shared rings into the
session's streams. A process that is silent for 250 ms, or whose pipe has closed, is lost: every
motion ends with CONTROL LOST. Only a new connection starts a new process.
"""

from __future__ import annotations

import itertools
import logging
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from touchdown.backend import core
from touchdown.backend.config import HardwareSettings, Limits
from touchdown.backend.devices import CommandedMotion, Interlock
from touchdown.backend.rig.memory import (
    BACKEND_BEAT,
    RIG_BEAT,
    STATE,
    STOPS,
    SharedMemory,
    drop,
    make,
)
from touchdown.backend.rig.messages import Channel, Message, read_error, read_fault
from touchdown.backend.rig.safety import control_lost

BEAT_S = 0.005
# Real-time priority of the heartbeat thread, if permitted; below that of the rig.
PRIORITY = 40
LATE_S = 0.01  # largest age of a sample on arrival: one cycle of the rig and one of this thread
RIG_SILENT_S = 0.25
START_S = 20.0
ORDER_S = 60.0  # longer than any command takes; the death of the rig ends them all at once
END_S = 6.0
# A lost process has nothing to end in order, and may never answer.
LOST_END_S = 1.5
SETTLE_S = 1.0  # a newly connected arm reports its position within a few cycles


class RigMotion(CommandedMotion):
    """A motion in the rig; a press also has its time of contact, on the bench clock."""

    detected_s: float | None = None
    onset_s: float | None = None


class _PendingAnswer:
    """Answer that a caller waits for."""

    def __init__(self) -> None:
        self.came = threading.Event()
        self.message: Message = {}
        self.motion: RigMotion | None = None


class RigLink:
    """Client of the rig process; ``samples`` and ``poses`` receive its measurements."""

    def __init__(
        self,
        settings: HardwareSettings,
        now_s: Callable[[], float],
        samples: core.SampleStream,
        poses: core.SampleStream,
        interlock: Interlock,
    ) -> None:
        self._settings, self._now_s, self._interlock = settings, now_s, interlock
        self.samples, self.poses = samples, poses
        self._lock, self._counting = threading.RLock(), threading.Lock()
        self._copying = threading.Lock()
        self._forget()
        self._child: subprocess.Popen[bytes] | None = None
        self._channel: Channel | None = None
        # Shared with the rig; readable after its death until the next start.
        self.memory: SharedMemory | None = None
        self._thread: threading.Thread | None = None
        self._numbers = itertools.count(1)
        self._answers: dict[int, _PendingAnswer] = {}
        self._motions: dict[int, RigMotion] = {}
        self._limits: Limits | None = None
        # Fault that ended the rig; None while it runs or is not needed.
        self.lost: core.Fault | None = None

    def _forget(self) -> None:
        """Start with the counts and states of a new rig."""
        self._ending, self._greeting = threading.Event(), _PendingAnswer()
        self._stops = self._stops_reset = self._faults = self._faults_reset = 0
        self._cursors = [0, 0]
        self._rows: Mapping[str, Any] = {}
        self._seen = 0

    # -- start and end ----------------------------------------------------------------------------

    @property
    def running(self) -> bool:
        """True while a rig process runs and answers."""
        return self._child is not None and self.lost is None

    @property
    def hello(self) -> Message:
        """Greeting of the rig; empty before the start."""
        return self._greeting.message

    def start(self) -> None:
        """Start the process if there is none; raises ``FaultError``, or the refusal of the rig."""
        with self._lock:
            if self.running:
                return
            self.close()
            memory, path = make()
            try:
                self._begin(memory, path)
            except BaseException:
                self.close()
                raise
            finally:
                drop(path)

    def _begin(self, memory: SharedMemory, path: Path) -> None:
        self._forget()
        self.memory, self._limits = memory, self._interlock.limits
        memory.beat(BACKEND_BEAT)
        self._child = child = subprocess.Popen(
            [sys.executable, "-m", "touchdown.backend.rig.process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            # Linux shares processor time between sessions: a busy backend takes none of the rig's.
            start_new_session=True,
        )
        assert child.stdin is not None
        assert child.stdout is not None
        # Ignore late messages of an earlier rig.
        ended = self._ending
        self._channel = Channel(
            child.stdout, child.stdin, self._take, lambda: self._lose(ended, GONE)
        )
        self._channel.start()
        self._channel.say(
            {
                "kind": "begin",
                # Send only the tables that the rig knows: it refuses unknown ones.
                "settings": self._settings.model_dump(
                    mode="json", include=set(HardwareSettings.model_fields)
                ),
                "limits": self._limits.model_dump(),
                "begun_s": time.monotonic() - self._now_s(),
                "memory": str(path),
            }
        )
        if not self._greeting.came.wait(START_S):
            raise core.FaultError(NO_START)
        if self.hello.get("kind") == "refused":
            raise read_error(self.hello["error"])
        if self.lost is not None:
            raise core.FaultError(self.lost)
        self._thread = threading.Thread(
            target=self._run_cycles, args=(memory, ended), name="rig link", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End the process: all motion stops, the gripper keeps its grip. May be called twice."""
        with self._lock:
            self._ending.set()
            if self._thread is not None:
                self._thread.join()
                self._thread = None
            if self._channel is not None:
                self._channel.close()
            child, self._child = self._child, None
            if child is not None:
                try:
                    child.wait(END_S if self.lost is None else LOST_END_S)
                except subprocess.TimeoutExpired:
                    child.kill()
                    child.wait()
            if self._channel is not None:
                self._channel.join(END_S)
                self._channel = None
            if child is not None and child.stdout is not None:
                child.stdout.close()
            self._give_up(GONE)
            self._rows, self.lost = {}, None

    # -- commands ---------------------------------------------------------------------------------

    def order(self, name: str, **arguments: Any) -> Message:
        """Send a command and return the answer; raises the error of the rig."""
        return self._ask(name, arguments).message

    def move(self, name: str, **arguments: Any) -> RigMotion:
        """Send a command that starts or continues a motion, and return the motion."""
        answer = self._ask(name, arguments)
        assert answer.motion is not None
        return answer.motion

    def stop(self) -> None:
        """STOP, by shared memory and by message; does not wait."""
        memory, channel = self.memory, self._channel
        if memory is None or channel is None or self._child is None:
            return
        with self._counting:
            self._stops += 1
            memory.beat(STOPS)
            channel.say({"kind": "stop", "stops": self._stops})

    def say(self, kind: str) -> None:
        """Send a message without answer; does not wait.

        "retreat" of the arm from its contact, "stop gripper", or "cancel" of connecting.
        """
        if self._channel is not None:
            self._channel.say({"kind": kind})

    def settle(self) -> None:
        """Discard the positions received so far and wait for the next one."""
        memory = self.memory
        if memory is None:
            return
        with self._copying:
            self._cursors[1] = memory.poses.count
            self.poses.clear()
            before = self.poses.count
        for _ in range(round(SETTLE_S / BEAT_S)):
            if self.poses.count > before or self._ending.wait(BEAT_S):
                return

    def row(self, device: str) -> Mapping[str, Any]:
        """Return the state of a device, empty while there is no rig."""
        memory = self.memory
        if memory is not None and self._child is not None and memory.count(STATE) != self._seen:
            seen = memory.count(STATE)
            rows = memory.seen()
            if rows is not None:
                self._rows, self._seen = rows, seen
        found = self._rows.get(device, {})
        assert isinstance(found, Mapping)
        return found

    def _ask(self, name: str, arguments: dict[str, Any]) -> _PendingAnswer:
        channel, lost = self._channel, self.lost
        if lost is not None:
            raise core.FaultError(lost)
        if channel is None or self._child is None:
            raise core.FaultError(NOT_STARTED)
        number, answer = next(self._numbers), _PendingAnswer()
        self._answers[number] = answer
        self._forward_reset(channel)
        order = {"kind": "order", "id": number, "order": name, "args": arguments}
        taken = channel.say({**order, "lease_until_s": self._interlock.lease_until_s})
        if not taken or not self.running:
            # The rig may have been lost meanwhile; nothing else would end this command.
            self._answers.pop(number, None)
            raise core.FaultError(GONE)
        with core.blocking_section("waits for the devices", 2.0 * ORDER_S):
            if not answer.came.wait(ORDER_S):
                raise core.FaultError(NO_ANSWER)
        if "error" in answer.message:
            raise read_error(answer.message["error"])
        return answer

    # -- messages of the rig, on the listening thread ----------------------------------------------

    def _take(self, message: Message) -> None:
        match message["kind"]:
            case "hello" | "refused":
                self._greeting.message = message
                self._greeting.came.set()
            case "log":
                logging.getLogger("touchdown.rig").log(message["level"], message["text"])
            case "reply":
                self._take_reply(message)
            case "felt" | "ended":
                self._take_motion(message)
            case "fault":
                fault = read_fault(message["fault"])
                assert fault is not None
                self._interlock.raise_fault(fault)
                # Not earlier: the operator cannot reset a fault before it is reported.
                self._faults = message["number"]

    def _take_reply(self, message: Message) -> None:
        answer = self._answers.pop(message["id"], None)
        if answer is None:
            return
        answer.message = message
        if (number := message["motion"]) is not None:
            answer.motion = self._motions.setdefault(number, RigMotion(message["sent"]))
        answer.came.set()

    def _take_motion(self, message: Message) -> None:
        motion = self._motions.get(message["motion"])
        if motion is None:
            return
        motion.detected_s, motion.onset_s = message["detected_s"], message["onset_s"]
        if message["kind"] == "ended":
            del self._motions[message["motion"]]
            motion.end(read_fault(message["fault"]))

    # -- heartbeat thread -------------------------------------------------------------------------

    def _run_cycles(self, memory: SharedMemory, ended: threading.Event) -> None:
        if not core.set_realtime_priority(min(PRIORITY, self._settings.melfa.realtime_priority)):
            core.request_short_slices()
        beats, beat_s = memory.count(RIG_BEAT), time.monotonic()
        while not ended.wait(BEAT_S):
            memory.permit(self._interlock.lease_until_s)
            memory.beat(BACKEND_BEAT)
            self._copy(memory)
            channel = self._channel
            if channel is not None:
                self._forward_reset(channel)
                if (limits := self._interlock.limits) is not self._limits:
                    self._limits = limits
                    channel.say({"kind": "limits", "limits": limits.model_dump()})
            now_s = time.monotonic()
            if memory.count(RIG_BEAT) != beats:
                beats, beat_s = memory.count(RIG_BEAT), now_s
            elif now_s - beat_s > RIG_SILENT_S:
                self._lose(ended, SILENT)
                return

    def _copy(self, memory: SharedMemory) -> None:
        pairs = ((memory.wrench, self.samples), (memory.poses, self.poses))
        with self._copying:
            for k, (ring, stream) in enumerate(pairs):
                t_s, values, self._cursors[k] = ring.since(self._cursors[k])
                if len(t_s):
                    stream.put(t_s, values)

    def _forward_reset(self, channel: Channel) -> None:
        """Reset the latch of the rig after the operator has reset that of the bench."""
        with self._counting:
            behind = (self._stops_reset, self._faults_reset) != (self._stops, self._faults)
            if behind and not self._interlock.latched:
                self._stops_reset, self._faults_reset = self._stops, self._faults
                channel.say({"kind": "reset", "stops": self._stops, "faults": self._faults})

    # -- loss -------------------------------------------------------------------------------------

    def _lose(self, ended: threading.Event, fault: core.Fault) -> None:
        """Handle the loss of the rig, unless it was closed."""
        if ended.is_set() or ended is not self._ending or self.lost is not None:
            return
        self.lost = fault
        self._give_up(fault)
        if self.hello.get("kind") == "hello":
            self._interlock.raise_fault(fault)
        self._greeting.came.set()

    def _give_up(self, fault: core.Fault) -> None:
        for motion in list(self._motions.values()):
            motion.end(fault)
        self._motions.clear()
        error = {"type": "fault", "fault": asdict(fault)}
        for answer in list(self._answers.values()):
            answer.message = {"kind": "reply", "error": error, "motion": None}
            answer.came.set()
        self._answers.clear()


SILENT = control_lost("The process that drives arm, gripper and wrist sensor is silent.")
GONE = control_lost("The process that drives arm, gripper and wrist sensor has ended.")
NO_ANSWER = control_lost("The process that drives arm, gripper and wrist sensor gives no answer.")
NO_START = control_lost("The process that drives arm, gripper and wrist sensor does not start.")
NOT_STARTED = core.Fault(
    "NOT-CONNECTED",
    "Arm, gripper and wrist sensor are not connected.",
    "Nothing was moved.",
    "Connect them first.",
    "arm",
)
