"""Messages between backend and real-time process, with the channel that carries them.

JSON with its length before it. Known kinds only, at most 64 KiB, never pickle; numbers keep every
digit, NaN included. Sending never waits: a bounded queue that is full counts as a closed channel. A
killed parent is detected in ``/proc`` before its pipes close, which took more than 100 ms on a busy
computer (Linux).
"""

from __future__ import annotations

import json
import os
import queue
import signal
import struct
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, astuple
from pathlib import Path
from typing import IO, Any

from touchdown.backend.core import (
    Fault,
    FaultError,
    InputError,
    RefusedError,
    StaleSampleError,
    TouchdownError,
)
from touchdown.backend.devices import (
    Arm,
    ConnectionSteps,
    Device,
    DeviceState,
    ForceTorqueSensor,
    Gripper,
    HomingGripper,
    Identity,
    ReportsSlowness,
)

Message = dict[str, Any]
MOST_BYTES = 65_536
LENGTH = struct.Struct("<I")
KINDS = frozenset(
    {
        *("begin", "hello", "refused"),
        *("order", "reply", "stop", "stop gripper", "retreat", "cancel", "reset", "limits"),
        *("felt", "ended", "fault"),
    }
)


def pack(message: Message) -> bytes:
    """Return the bytes of ``message``; ValueError for an unknown kind or too long a one."""
    if message.get("kind") not in KINDS:
        raise ValueError(f"there is no message of kind {message.get('kind')!r}")
    content = json.dumps(message, separators=(",", ":")).encode()
    if len(content) > MOST_BYTES:
        raise ValueError(f"a message of {len(content)} bytes is too long")
    return LENGTH.pack(len(content)) + content


def receive(stream: IO[bytes]) -> Message | None:
    """Return the next message, None at the end; ValueError for what is none."""
    head = stream.read(LENGTH.size)
    if len(head) < LENGTH.size:
        return None
    (size,) = LENGTH.unpack(head)
    if size > MOST_BYTES:
        raise ValueError(f"a message of {size} bytes is too long")
    content = stream.read(size)
    if len(content) < size:
        return None
    message = json.loads(content)
    if not isinstance(message, dict) or message.get("kind") not in KINDS:
        raise ValueError("a message of an unknown kind")
    return message


def fault_row(fault: Fault | None) -> Mapping[str, str] | None:
    """Return a fault ready for JSON."""
    return None if fault is None else asdict(fault)


def read_fault(row: Mapping[str, str] | None) -> Fault | None:
    """Return the fault of a row."""
    return None if row is None else Fault(**row)


def identity_row(identity: Identity | None) -> Mapping[str, str] | None:
    """Return who a device is, ready for JSON."""
    return None if identity is None else asdict(identity)


def read_identity(row: Mapping[str, str] | None) -> Identity | None:
    """Return the identity of a row."""
    return None if row is None else Identity(**row)


def error_row(error: Exception) -> Message:
    """Return an error ready for JSON; what nobody foresaw is told by its type."""
    if isinstance(error, FaultError):
        return {"type": "fault", "fault": fault_row(error.fault)}
    if isinstance(error, RefusedError):
        return {"type": "refused", "reason": error.reason, "detail": error.detail}
    if isinstance(error, InputError):
        return {"type": "input", "what": error.what, "where": error.where, "fix": error.fix}
    if isinstance(error, StaleSampleError):
        return {"type": "stale", "text": str(error)}
    if isinstance(error, ValueError):
        return {"type": "value", "text": str(error)}
    return {"type": "other", "text": f"{type(error).__name__}: {error}"}


def read_error(row: Message) -> Exception:
    """Return the error of a row, to be raised again."""
    match row["type"]:
        case "fault":
            return FaultError(Fault(**row["fault"]))
        case "refused":
            return RefusedError(row["reason"], row["detail"])
        case "input":
            return InputError(row["what"], row["where"], row["fix"])
        case "stale":
            return StaleSampleError(row["text"])
        case "value":
            return ValueError(row["text"])
    return FaultError(failed(row["text"]))


def failed(what: str) -> Fault:
    """Return the fault of a program error inside the rig."""
    return Fault(
        "RIG-ERROR",
        f"The rig process met an error of this program: {what}.",
        "The arm was stopped; the gripper was not opened.",
        "Copy the details for the maintainers, then press Reset.",
        "arm",
    )


Row = dict[str, Any]
POSE_AGE_S = 0.2


def device_row(device: Device) -> Row:
    """Return what changes quickly, of any device."""
    fault, steps = getattr(device, "fault", None), getattr(device, "steps", None)
    return {
        "state": device.state.value,
        "steps": steps.done if isinstance(steps, ConnectionSteps) else 0,
        "fault": fault_row(fault if isinstance(fault, Fault) else None),
    }


def arm_row(arm: Arm) -> Row:
    """Return the status words, the turn of the hand and the joints; None where not known."""
    status = arm.status()
    row = {
        **device_row(arm),
        "status": [
            status.robot_mode.value,
            status.safety_mode.value,
            status.override,
            status.error,
        ],
        "turn": None,
        "joints": None,
    }
    if arm.state is DeviceState.READY:
        try:
            pose = arm.pose(POSE_AGE_S)
            row["turn"] = [pose.rx_rad, pose.ry_rad, pose.rz_rad]
            row["joints"] = list(arm.joints_rad(POSE_AGE_S)) if arm.rotates else None
        except (StaleSampleError, TouchdownError):
            # The place is not known at present: a reader's own age limit says so.
            return row
    return row


def gripper_row(gripper: Gripper, homing: HomingGripper | None) -> Row:
    """Return width, force, whether a piece is held, and what the operator has to do.

    ``homing``: the gripper again if it is one that is homed.
    """
    return {
        **device_row(gripper),
        "grip": list(astuple(gripper.status())),
        "homed": homing is None or homing.homed,
        "lost_holding": homing is not None and homing.lost_holding,
    }


def sensor_row(sensor: ForceTorqueSensor) -> Row:
    """Return the rated range as well, and since when it has been slow."""
    slow_s = sensor.slow_since_s if isinstance(sensor, ReportsSlowness) else None
    return {**device_row(sensor), "rated": sensor.rated.tolist(), "slow_since_s": slow_s}


def slow_row(device: Device, now_s: float) -> Row:
    """Return what a person looks at: identity, health with its time, fields of the inspector."""
    health = device.health
    fields: Mapping[str, str | float] = device.describe()
    return {
        "identity": identity_row(device.identity),
        "health": [health.rate_hz, now_s - health.age_s, health.received, health.lost],
        "fields": dict(fields),
    }


WAITING = 512


class Channel:
    """``take`` hears each message, ``ended`` once that no more come, both on the same thread."""

    def __init__(
        self,
        source: IO[bytes],
        sink: IO[bytes],
        take: Callable[[Message], None],
        ended: Callable[[], None],
    ) -> None:
        self._source, self._sink = source, sink
        self._take, self._ended = take, ended
        self._waiting: queue.Queue[bytes | None] = queue.Queue(WAITING)
        self._speaker = threading.Thread(target=self._speak, name="rig speaker", daemon=True)
        self._listener = threading.Thread(target=self._listen, name="rig listener", daemon=True)

    def start(self) -> None:
        """Begin to listen."""
        self._speaker.start()
        self._listener.start()

    def say(self, message: Message) -> bool:
        """Send a message in its turn; False if the other side does not take any more."""
        try:
            self._waiting.put_nowait(pack(message))
        except queue.Full:
            return False
        return True

    def close(self) -> None:
        """Say no more: the other side sees the end once all before has been sent."""
        with suppress(queue.Full):
            self._waiting.put_nowait(None)

    def join(self, limit_s: float) -> None:
        """Wait for both threads; the listener ends with the other side."""
        for thread in (self._speaker, self._listener):
            thread.join(limit_s)

    def _speak(self) -> None:
        with suppress(OSError, ValueError):
            while (content := self._waiting.get()) is not None:
                self._sink.write(content)
                self._sink.flush()
        with suppress(OSError):
            self._sink.close()

    def _listen(self) -> None:
        try:
            while (message := receive(self._source)) is not None:
                self._take(message)
        except Exception:  # noqa: BLE001 - who tells nonsense, of whatever kind, is as good as gone
            return
        finally:
            self._ended()


EXITING = 0x4  # of the flags of a process: it is dying (PF_EXITING)
# Of its waiting signals. Threads of a process that dies of any other one get it too.
KILLED = 1 << (signal.SIGKILL - 1) if os.name == "posix" else 0
STATE, FLAGS, SIGNALS = 0, 6, 28  # fields after the name


class ParentProcess:
    """Made while it lives; ``gone`` may be asked in every round."""

    def __init__(self) -> None:
        self._number = os.getppid()
        self._descriptor: int | None = None
        with suppress(OSError):
            self._descriptor = os.open(Path("/proc") / str(self._number) / "stat", os.O_RDONLY)

    def gone(self) -> bool:
        """Return whether it is dead, or cannot live on."""
        if os.getppid() != self._number:
            return True
        if self._descriptor is None:
            return False
        try:
            return is_dying(os.pread(self._descriptor, 1024, 0))
        except ProcessLookupError:
            return True

    def close(self) -> None:
        """Ask no more."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def is_dying(line: bytes) -> bool:
    """Read a line of ``/proc/<pid>/stat``; the name in it may hold anything, brackets included."""
    fields = line.rpartition(b") ")[2].split()
    if len(fields) <= SIGNALS:
        return False
    over = fields[STATE] in (b"Z", b"X")
    return over or bool(int(fields[FLAGS]) & EXITING) or bool(int(fields[SIGNALS]) & KILLED)
