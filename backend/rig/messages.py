"""What crosses the pipe between the backend and the rig process: JSON with its length before it.

Known kinds only, at most 64 KiB, never pickle. Numbers keep every digit, NaN included.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import asdict
from typing import IO, Any

from backend.core.faults import Fault, FaultError, InputError, RefusedError, StaleSampleError
from backend.devices.protocols import Identity

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
