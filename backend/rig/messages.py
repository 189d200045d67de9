"""Messages between backend and real-time process, with the channel that carries them.

A message is JSON after its length: known kinds only, at most 64 KiB; numbers keep every digit, NaN
included. Sending never waits: a full queue counts as a closed channel. A killed parent is detected
in ``/proc`` (Linux), because closing its pipes took more than 100 ms on a busy computer.
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

from touchdown.backend import core, devices

Message = dict[str, Any]
MOST_BYTES = 65_536
LENGTH = struct.Struct("<I")
KINDS = frozenset(
    {
        *("begin", "hello", "refused"),
        *("order", "reply", "stop", "stop gripper", "retreat", "cancel", "reset", "limits"),
        *("felt", "ended", "fault", "log"),
    }
)


def pack(message: Message) -> bytes:
    """Return the bytes of ``message``; raises ``ValueError`` if its kind is unknown or it is too
    long.
    """
    if message.get("kind") not in KINDS:
        raise ValueError(f"there is no message of kind {message.get('kind')!r}")
    content = json.dumps(message, separators=(",", ":")).encode()
    if len(content) > MOST_BYTES:
        raise ValueError(f"a message of {len(content)} bytes is too long")
    return LENGTH.pack(len(content)) + content


def receive(stream: IO[bytes]) -> Message | None:
    """Return the next message, None at the end; raises ``ValueError`` for invalid bytes."""
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


def as_row(value: core.Fault | devices.Identity | None) -> Mapping[str, str] | None:
    """Return a fault or an identity as JSON."""
    return None if value is None else asdict(value)


def read_fault(row: Mapping[str, str] | None) -> core.Fault | None:
    """Return the fault of a JSON row."""
    return None if row is None else core.Fault(**row)


def error_row(error: Exception) -> Message:
    """Return an error as JSON; an unexpected one is named by its type."""
    if isinstance(error, core.FaultError):
        return {"type": "fault", "fault": as_row(error.fault)}
    if isinstance(error, core.RefusedError):
        return {"type": "refused", "reason": error.reason, "detail": error.detail}
    if isinstance(error, core.InputError):
        return {"type": "input", "what": error.what, "where": error.where, "fix": error.fix}
    if isinstance(error, core.StaleSampleError):
        return {"type": "stale", "text": str(error)}
    if isinstance(error, ValueError):
        return {"type": "value", "text": str(error)}
    return {"type": "other", "text": f"{type(error).__name__}: {error}"}


def read_error(row: Message) -> Exception:
    """Return the error of a JSON row."""
    match row["type"]:
        case "fault":
            return core.FaultError(core.Fault(**row["fault"]))
        case "refused":
            return core.RefusedError(row["reason"], row["detail"])
        case "input":
            return core.InputError(row["what"], row["where"], row["fix"])
        case "stale":
            return core.StaleSampleError(row["text"])
        case "value":
            return ValueError(row["text"])
    return core.FaultError(program_fault(row["text"]))


def program_fault(what: str) -> core.Fault:
    """Return the fault of a program error inside the rig."""
    return core.Fault(
        "RIG-ERROR",
        f"The rig process failed by an error of this program: {what}.",
        "The arm was stopped; the gripper was not opened.",
        "Copy the details for the maintainers, then press Reset.",
        "arm",
    )


Row = dict[str, Any]
POSE_AGE_S = 0.2


def device_row(device: devices.Device) -> Row:
    """Return the quickly changing state of any device."""
    fault, steps = getattr(device, "fault", None), getattr(device, "steps", None)
    return {
        "state": device.state.value,
        "steps": steps.done if isinstance(steps, devices.ConnectionSteps) else 0,
        "fault": as_row(fault if isinstance(fault, core.Fault) else None),
    }


def arm_row(arm: devices.Arm) -> Row:
    """Return the status, the turn of the hand and the joints; None where unknown."""
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
    if arm.state is devices.DeviceState.READY:
        try:
            pose = arm.pose(POSE_AGE_S)
            row["turn"] = [pose.rx_rad, pose.ry_rad, pose.rz_rad]
            row["joints"] = list(arm.joints_rad(POSE_AGE_S)) if arm.rotates else None
        except (core.StaleSampleError, core.TouchdownError):
            # The position is unknown at present; the reader's age limit reports it.
            return row
    return row


def gripper_row(gripper: devices.Gripper, homing: devices.HomingGripper | None) -> Row:
    """Return width, force, grip and the actions required from the operator. ``homing`` is the
    gripper if it needs homing.
    """
    return {
        **device_row(gripper),
        "grip": list(astuple(gripper.status())),
        "homed": homing is None or homing.homed,
        "lost_holding": homing is not None and homing.lost_holding,
    }


def sensor_row(sensor: devices.ForceTorqueSensor) -> Row:
    """Return the device row with the rated range and the start of a low rate."""
    slow_s = sensor.slow_since_s if isinstance(sensor, devices.ReportsSlowness) else None
    return {**device_row(sensor), "rated": sensor.rated.tolist(), "slow_since_s": slow_s}


def inspector_row(device: devices.Device, now_s: float) -> Row:
    """Return the slowly changing fields: identity, health with its time, fields of the
    inspector.
    """
    health = device.health
    fields: Mapping[str, str | float] = device.describe()
    return {
        "identity": as_row(device.identity),
        "health": [health.rate_hz, now_s - health.age_s, health.received, health.lost],
        "fields": dict(fields),
    }


WAITING = 512


class Channel:
    """Two-way channel. ``take`` gets each message, then ``ended`` is called, both on one thread."""

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
        """Start to listen."""
        self._speaker.start()
        self._listener.start()

    def say(self, message: Message) -> bool:
        """Queue a message; return False if the other side no longer reads."""
        try:
            self._waiting.put_nowait(pack(message))
        except queue.Full:
            return False
        return True

    def close(self) -> None:
        """Close for sending: the other side sees the end after all queued messages."""
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
        except Exception:  # noqa: BLE001 - invalid messages count as a closed channel
            return
        finally:
            self._ended()


EXITING = 0x4  # process flag PF_EXITING
# Pending SIGKILL. Threads of a process that dies of another signal get it too.
KILLED = 1 << (signal.SIGKILL - 1) if os.name == "posix" else 0
STATE, FLAGS, SIGNALS = 0, 6, 28  # fields after the name


class ParentProcess:
    """Watches the parent process; ``gone`` is fast enough for every cycle."""

    def __init__(self) -> None:
        self._number = os.getppid()
        self._descriptor: int | None = None
        with suppress(OSError):
            self._descriptor = os.open(Path("/proc") / str(self._number) / "stat", os.O_RDONLY)

    def gone(self) -> bool:
        """Return True if the parent is dead or dying."""
        if os.getppid() != self._number:
            return True
        if self._descriptor is None:
            return False
        try:
            return is_dying(os.pread(self._descriptor, 1024, 0))
        except ProcessLookupError:
            return True

    def close(self) -> None:
        """Close the files."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def is_dying(line: bytes) -> bool:
    """Parse a line of ``/proc/<pid>/stat``; the name in it may contain anything, brackets
    included.
    """
    fields = line.rpartition(b") ")[2].split()
    if len(fields) <= SIGNALS:
        return False
    over = fields[STATE] in (b"Z", b"X")
    return over or bool(int(fields[FLAGS]) & EXITING) or bool(int(fields[SIGNALS]) & KILLED)
