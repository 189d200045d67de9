"""Host of arm, gripper and wrist sensor in the real-time process.

The rig process, or a test with its own clock, calls ``round`` every 4 ms. ``take`` receives
messages on another thread. Commands that may take long run on one thread per device; STOP never
waits.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from touchdown.backend.config import Limits
from touchdown.backend.core import Fault, FaultError, Samples, SampleStream, TouchdownError
from touchdown.backend.devices import (
    Arm,
    Device,
    DeviceState,
    ForceTorqueSensor,
    Gripper,
    HomingGripper,
    Motion,
    RetreatingArm,
    TracedArm,
    recent_positions_mm,
    travelled_mm,
)
from touchdown.backend.rig import messages, safety
from touchdown.backend.rig.memory import BACKEND_BEAT, RIG_BEAT, STOPS, Ring, SharedMemory


class DeviceWorkers:
    """Runs the commands of each device one after the other, on one thread per device."""

    def __init__(self, names: Iterable[str], carry_out: Callable[[messages.Message], None]) -> None:
        self._carry_out, self._gone = carry_out, False
        self._waiting: dict[str, queue.SimpleQueue[messages.Message | None]] = {}
        self._threads: dict[str, threading.Thread] = {}
        for name in names:
            self._waiting[name] = queue.SimpleQueue()
            self._threads[name] = threading.Thread(
                target=self._work, args=(self._waiting[name],), name=f"rig {name}", daemon=True
            )
            self._threads[name].start()

    def give(self, name: str, order: messages.Message) -> bool:
        """Queue a command for a device; return False if there is no such device."""
        if name not in self._waiting:
            return False
        self._waiting[name].put(order)
        return True

    def leave(self) -> None:
        """Start no further command."""
        self._gone = True
        for waiting in self._waiting.values():
            waiting.put(None)

    def idle(self, name: str, limit_s: float) -> bool:
        """After ``leave``: wait until all threads are idle; return False after a timeout."""
        self._threads[name].join(limit_s)
        return not self._threads[name].is_alive()

    def _work(self, waiting: queue.SimpleQueue[messages.Message | None]) -> None:
        while (order := waiting.get()) is not None and not self._gone:
            self._carry_out(order)


# The state is published every 20 ms, fields for the window every 200 ms.
STATE_ROUNDS, SLOW_ROUNDS = 5, 50
OrderResult = Motion | list[float] | None
GRIP_STANDS_S = 0.3  # the jaws settle within this time after the gripper reports a grip
# Executed on the receiving thread, because they do not wait.
AT_ONCE = frozenset({"arm.halt", "arm.place_of"})


@dataclass(frozen=True, slots=True)
class Devices:
    """The devices with deadlines, and the streams that they fill."""

    arm: Arm
    gripper: Gripper
    force_torque: ForceTorqueSensor
    samples: SampleStream
    poses: SampleStream

    def named(self) -> dict[str, Device]:
        """Return the devices by name."""
        return {"force_torque": self.force_torque, "gripper": self.gripper, "arm": self.arm}


@dataclass
class _RunningMotion:
    """Motion with the number of the command that started it; ``felt``: its contact was reported."""

    number: int
    motion: Motion
    of_arm: bool
    felt: bool = False


class RigHost:
    """Control cycle of the devices; ``say`` sends a message and never waits."""

    def __init__(
        self,
        devices: Devices,
        limits: Limits,
        now_s: Callable[[], float],
        memory: SharedMemory,
        say: Callable[[messages.Message], bool],
    ) -> None:
        self.devices, self._now_s, self._memory, self._say = devices, now_s, memory, say
        # Read once: it takes longer than a cycle.
        self._traced = devices.arm if isinstance(devices.arm, TracedArm) else None
        self._homing = devices.gripper if isinstance(devices.gripper, HomingGripper) else None
        self._core = safety.Failsafe(now_s(), limits)
        self._lock = threading.RLock()
        self._showing, self._noting = threading.Lock(), threading.Lock()
        self.orders = safety.DriverCommands(devices.arm, devices.gripper, self.measured, now_s)
        self._motions: list[_RunningMotion] = []
        self._cancel = threading.Event()
        self._gone = False
        self._rounds = 0
        self._slow: dict[str, messages.Row] = {}
        self._cursors = [devices.samples.count, devices.poses.count]
        self._wrench_s = -np.inf
        self._held_since_s, self._gripped_mm = np.inf, np.nan
        self.workers = DeviceWorkers(devices.named(), self._carry_out)

    # -- time -------------------------------------------------------------------------------------

    def round(self) -> bool:
        """Run one control cycle; return True if the process has to end."""
        now_s = self._now_s()
        self._publish_samples(now_s)
        with self._lock:
            try:
                out = self._core.step(now_s, self._inbox())
            except Exception as error:  # noqa: BLE001 - whatever it is, the arm must not go on
                fault = self._core.latch(messages.program_fault(f"{type(error).__name__}: {error}"))
                out = safety.FailsafeOutput(stop=True, fault=fault, why=fault)
            self._act(now_s, out)
        self._tell_motions()
        if self._rounds % STATE_ROUNDS == 0:
            self._show(now_s, slow=self._rounds % SLOW_ROUNDS == 0)
        self._rounds += 1
        self._memory.beat(RIG_BEAT)
        return out.leave

    def _inbox(self) -> safety.FailsafeInput:
        memory = self._memory
        moving = any(one.of_arm and not one.motion.done for one in self._motions)
        # Loosened jaws need the backend, which watches the piece.
        moving = moving or self.orders.staged is not None
        return safety.FailsafeInput(
            memory.count(BACKEND_BEAT),
            memory.count(STOPS),
            memory.lease_until_s,
            moving,
            self._gone,
            self._wrench_s,
        )

    def _act(self, now_s: float, out: safety.FailsafeOutput) -> None:
        if out.stop:
            self._stop(now_s, "stop")
        elif out.hold:
            self._note(now_s, f"hold: {out.why.code if out.why else 'silent'}")
            self.devices.arm.halt()
            if self.orders.staged is not None:
                self.orders.stop_gripper()
        if out.why is not None:
            # The end of the process ends all motions, also those of the gripper.
            ended = [one for one in self._motions if out.leave or (one.of_arm and one.motion.done)]
            for one in ended:
                self._end(one, out.why)
        if out.fault is not None:
            fault = out.fault
            self._note(now_s, f"fault {fault.code}: {fault.what}")
            self._say(
                {"kind": "fault", "number": self._core.faults, "fault": messages.as_row(fault)}
            )

    def _stop(self, now_s: float, why: str) -> None:
        self._note(now_s, why)
        self.devices.arm.stop()
        self.orders.stop_gripper()

    def _draw_back(self) -> None:
        self._note(self._now_s(), "retreat")
        arm = self.devices.arm
        if isinstance(arm, RetreatingArm):
            arm.retreat()
        else:
            arm.stop()

    # -- shared memory ----------------------------------------------------------------------------

    def _publish_samples(self, now_s: float) -> None:
        """Copy new samples into the shared rings, and one line into the flight recorder."""
        wrench = self._copy_new_samples(0, self.devices.samples, self._memory.wrench)
        self._copy_new_samples(1, self.devices.poses, self._memory.poses)
        if wrench is not None:
            finite = np.isfinite(wrench.values).all(axis=1)
            if finite.any():
                self._wrench_s = float(wrench.t_s[finite][-1])
        if self._traced is not None and self.devices.arm.state is not DeviceState.CLOSED:
            self._memory.rounds.put(np.array([now_s]), np.array([self._traced.trace()]))

    def _copy_new_samples(self, which: int, stream: SampleStream, ring: Ring) -> Samples | None:
        """Copy new samples of a stream into its ring and return them, None without any."""
        if stream.count == self._cursors[which]:
            return None
        came = stream.since(self._cursors[which])
        self._cursors[which] = came.cursor
        if len(came.t_s):
            ring.put(came.t_s, came.values)
        return came

    def _show(self, now_s: float, *, slow: bool) -> None:
        with self._showing:
            if slow or not self._slow:
                self._slow = {
                    n: messages.inspector_row(d, now_s) for n, d in self.devices.named().items()
                }
            rows = {
                "arm": messages.arm_row(self.devices.arm),
                "gripper": messages.gripper_row(self.devices.gripper, self._homing),
                "force_torque": messages.sensor_row(self.devices.force_torque),
            }
            self._store_grip_width(now_s)
            self._memory.show({name: {**self._slow[name], **row} for name, row in rows.items()})

    def _store_grip_width(self, now_s: float) -> None:
        """Store the width of the gripped piece once the jaws have settled. A gripper reports a grip
        before its final width.
        """
        status = self.devices.gripper.status()
        if not status.holding:
            self._held_since_s, self._gripped_mm = np.inf, np.nan
            return
        self._held_since_s = min(self._held_since_s, now_s)
        if np.isnan(self._gripped_mm) and now_s >= self._held_since_s + GRIP_STANDS_S:
            self._gripped_mm = status.width_mm

    def _note(self, now_s: float, text: str) -> None:
        with self._noting:
            self._memory.note(now_s, text)

    # -- motions ----------------------------------------------------------------------------------

    def _tell_motions(self) -> None:
        with self._lock:
            for one in list(self._motions):
                if not one.felt and getattr(one.motion, "onset_s", None):
                    one.felt = True
                    self._say({"kind": "felt", "motion": one.number, **_contact(one.motion)})
                if one.motion.done:
                    # Publish the state first: the reader of the message must find it.
                    self._show(self._now_s(), slow=False)
                    self._end(one, _fault_of(one.motion))

    def _end(self, one: _RunningMotion, fault: Fault | None) -> None:
        self._motions.remove(one)
        self._note(self._now_s(), f"motion {one.number} ended{f': {fault.code}' if fault else ''}")
        row = messages.as_row(fault)
        self._say({"kind": "ended", "motion": one.number, "fault": row, **_contact(one.motion)})

    # -- messages ---------------------------------------------------------------------------------

    def take(self, message: messages.Message) -> None:
        """Process a message of the backend."""
        kind = message["kind"]
        if kind == "order":
            self._take_order(message)
        elif kind == "stop":
            with self._lock:
                if self._core.stop(message["stops"]):
                    self._stop(self._now_s(), "stop")
        elif kind == "retreat":
            self._draw_back()
        elif kind == "stop gripper":
            with self._lock:
                self.orders.stop_gripper()
        elif kind == "cancel":
            self._cancel.set()
        elif kind == "reset":
            with self._lock:
                self._core.reset(message["stops"], message["faults"])
        elif kind == "limits":
            with self._lock:
                self._core.limits = Limits(**message["limits"])

    def abandon(self) -> None:
        """Stop immediately, on the thread that detected the loss of the backend, and leave."""
        try:
            self.devices.arm.stop()
            self.orders.stop_gripper()
        finally:
            self.leave()

    def leave(self) -> None:
        """Handle the loss of the backend: the next cycle ends all motion and the process."""
        self._gone = True
        self._cancel.set()
        self.workers.leave()

    def _take_order(self, message: messages.Message) -> None:
        name = message["order"]
        if name in AT_ONCE:
            self._carry_out(message)
            return
        if not self.workers.give(name.split(".")[0], message):
            self._reply(message, error=ValueError(f"there is no order {name!r}"))

    def _carry_out(self, message: messages.Message) -> None:
        try:
            found = self._obey(message)
        except Exception as error:  # noqa: BLE001 - an order must not end the thread of its device
            self._reply(message, error=error)
        else:
            self._reply(message, found)

    def _obey(self, message: messages.Message) -> OrderResult:
        name, given = message["order"], message["args"]
        self._note(self._now_s(), f"order {message['id']} {name} {given}")
        device, _, verb = name.partition(".")
        if verb == "connect":
            self._cancel.clear()
            if self._gone:
                self._cancel.set()
            if device == "gripper" and self._homing is not None:
                self._homing.lost_holding |= given["lost_holding"]
            self.devices.named()[device].connect(given["timeout_s"], self._cancel)
            return None
        if verb == "close":
            self.devices.named()[device].close()
            return None
        if name not in safety.MOVES | safety.JAWS:
            return self.orders.give(name, given, self._core.limits)
        with self._lock:
            self._core.refuse(self._now_s(), message["lease_until_s"])
            if name in safety.MOVES:
                self._core.refuse_unfelt(self._now_s())
            stops = self._core.stops
        try:
            return self.orders.give(name, given, self._core.limits)
        finally:
            with self._lock:
                # A STOP that came while the motion was starting has not reached it.
                if self._core.stops > stops:
                    self._stop(self._now_s(), "stop")

    def _reply(
        self, message: messages.Message, found: OrderResult = None, error: Exception | None = None
    ) -> None:
        number = message["id"]
        answer: messages.Message = {"kind": "reply", "id": number, "motion": None}
        # Under the lock: the end of a motion is never reported before its start.
        with self._lock:
            if error is not None:
                answer["error"] = messages.error_row(error)
                self._note(self._now_s(), f"order {number} refused: {error}")
            elif found is None or isinstance(found, list):
                answer["value"] = found
            else:
                answer["motion"] = self._follow(number, found, message["order"])
                answer["sent"] = dict(found.sent)
            # Publish the state first: the reader of the answer must find it.
            self._show(self._now_s(), slow=message["order"] not in AT_ONCE | safety.MOVES)
            self._say(answer)

    def _follow(self, number: int, motion: Motion, order: str) -> int:
        """Track a motion; a continued motion keeps its number."""
        for known in self._motions:
            if known.motion is motion:
                return known.number
        self._motions.append(_RunningMotion(number, motion, order in safety.MOVES))
        return number

    # -- opening on a held piece ------------------------------------------------------------------

    def measured(self) -> safety.RigMeasurement:
        """Return the present measurements of the rig."""
        now_s, devices = self._now_s(), self.devices
        samples = devices.samples.window(now_s - 1.0, now_s)
        finite = np.isfinite(samples.values).all(axis=1)
        status = devices.gripper.status()
        return safety.RigMeasurement(
            press_n=np.nan if self._traced is None else self._traced.press_n,
            wrench_age_s=now_s - float(samples.t_s[finite][-1]) if finite.any() else np.nan,
            moved_mm=travelled_mm(recent_positions_mm(devices.poses, now_s)),
            width_change_mm=status.width_mm - self._gripped_mm,
            holding=status.holding,
            devices_ready=all(d.state is DeviceState.READY for d in devices.named().values()),
        )


def _contact(motion: Motion) -> messages.Message:
    return {
        "detected_s": getattr(motion, "detected_s", None),
        "onset_s": getattr(motion, "onset_s", None),
    }


def _fault_of(motion: Motion) -> Fault | None:
    try:
        motion.result()
    except FaultError as error:
        return error.fault
    except TouchdownError as error:
        return messages.program_fault(str(error))
    return None
