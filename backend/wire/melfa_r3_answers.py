"""What the answers of R3 say: state, errors, signals, options. Source: BFP-A4288-V."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import IntFlag

from backend.wire.framing import WireError
from backend.wire.melfa_r3_positions import whole

EMERGENCY_ERRORS = frozenset({50, 51, 61, 70, 71})
OUT_OF_RANGE_ERRORS = frozenset({2601, 2602, 2603, 2800, 2801, 2802, 2810})
NOT_READY_ERRORS = frozenset({2000, 5120, 5600, 5610, 5620, 5630, 5640, 6020})
REJECTED_ERRORS = frozenset({4140, 4340, 4350})
"""Any other number is a fault of the device."""


class Run(IntFlag):
    """Run status."""

    REPEAT = 0x01
    CYCLE_STOP = 0x02
    MACHINE_LOCK = 0x04
    TEACH = 0x08
    TEACH_RUNNING = 0x10
    SERVO_ON = 0x20
    RUNNING = 0x40
    OPERATION_ENABLED = 0x80


class Stop(IntFlag):
    """Stop status."""

    EMERGENCY = 0x01
    STOP = 0x02
    WAIT = 0x04
    STOP_SIGNAL = 0x08
    PROGRAM_SELECT_ENABLED = 0x10
    PSEUDO_INPUT = 0x40


@dataclass(frozen=True, slots=True)
class Opened:
    """Answer to OPEN: who the controller is. ``jog_speeds`` in %; axes as bits."""

    xyz_axes: int
    joint_axes: int
    flags: tuple[int, int]
    jog_speeds: tuple[int, ...]
    program_ext: str
    parameter_ext: str
    robot_type: str
    controller: str
    series: str
    date: str
    version: str
    language: str
    robot_info: str
    serial: str
    taskmax: int


@dataclass(frozen=True, slots=True)
class State:
    """Answer to STATE; ``error`` 0 is none."""

    program: str
    line: int
    override: int
    edit_status: int
    run: Run
    stop: Stop
    error: int
    step: int
    mechanism: int
    task_program: str
    task_mode: str
    task_condition: str
    task_priority: int
    mechanism_in_use: int

    def answer(self) -> str:
        """Return the text of the answer, with as many empty fields as the printed sample."""
        status = f"{self.run:02X}{self.stop:02X}{self.error}"
        front = f"{self.program};{self.line};{self.override};{self.edit_status};{status}"
        tail = f"{self.task_program};{self.task_mode};{self.task_condition};{self.task_priority}"
        return f"{front};{self.step};{self.mechanism};;;;;;;;{tail};{self.mechanism_in_use}"


@dataclass(frozen=True, slots=True)
class Progress:
    """Answer to DSTATE."""

    run: Run
    stop: Stop
    error: int
    step: int
    mechanism: int

    def answer(self) -> str:
        """Return the text of the answer."""
        return f"{self.run:02X}{self.stop:02X}{self.error};{self.step};{self.mechanism}"


def read_opened(answer: str) -> Opened:
    """Return the answer to OPEN; raises ``WireError``."""
    parts = _parts(answer, 16, "r3 open")
    flag1, flag2 = (whole(part) for part in _pair(parts[2], ","))
    return Opened(
        _hexadecimal(parts[0]),
        _hexadecimal(parts[1]),
        (flag1, flag2),
        tuple(map(_hexadecimal, parts[3].split(","))),
        parts[4],
        parts[5],
        parts[6],
        parts[7],
        parts[8],
        parts[9],
        parts[10],
        parts[11],
        parts[13],
        parts[14],
        whole(parts[15]),
    )


def read_state(answer: str) -> State:
    """Return the answer to STATE; the number of empty fields in its middle is left open."""
    parts = _parts(answer, 12, "r3 state")
    run, stop, error = _status(parts[4])
    line, override, edit_status, step, mechanism = (whole(parts[i]) for i in (1, 2, 3, 5, 6))
    task_program, mode, condition, priority, in_use = parts[-5:]
    return State(
        parts[0],
        line,
        override,
        edit_status,
        run,
        stop,
        error,
        step,
        mechanism,
        task_program,
        mode,
        condition,
        whole(priority),
        whole(in_use),
    )


def read_progress(answer: str) -> Progress:
    """Return the answer to DSTATE; raises ``WireError``."""
    parts = _parts(answer, 3, "r3 dstate")
    return Progress(*_status(parts[0]), whole(parts[1]), whole(parts[2]))


def read_error(answer: str) -> tuple[int, int]:
    """Return number and level (1 high, 2 low, 3 caution) of the active error; (0, 0) if none."""
    if not answer:
        return 0, 0
    error, level = _pair(answer, ";")
    return whole(error), whole(level)


def read_hands(answer: str) -> tuple[tuple[int, int, int], ...]:
    """Return (signal, 1 open or 2 closed, type) of each hand; -1 where there is none."""
    texts = answer.split(";")
    if len(texts) % 3 or not all(re.fullmatch(r"-1|[0-9]{1,5}", text) for text in texts):
        raise WireError("fields", "r3 hands")
    numbers = list(map(int, texts))
    return tuple(zip(numbers[::3], numbers[1::3], numbers[2::3], strict=True))


def read_stop_signals(answer: str) -> tuple[int, int]:
    """Return the stop and the emergency lines as bits."""
    stop, emergency = _pair(answer, ";")
    return whole(stop), whole(emergency)


def read_parameter(answer: str) -> tuple[str, str, int]:
    """Return name, value and count of a parameter."""
    name, *value, count = _parts(answer, 3, "r3 parameter")
    return name, ";".join(value), whole(count)


def read_bits(answer: str) -> int:
    """Return 16 signals."""
    if len(answer) != 4:
        raise WireError("fields", "r3 signals", len(answer))
    return _hexadecimal(answer)


def read_origin(answer: str) -> tuple[bool, int]:
    """Return whether the origin is set, and for which axes as bits."""
    found = re.fullmatch(r"([A-Z])([0-9A-F]{2})([0-9A-F]{2})", answer)
    if found is None:
        raise WireError("fields", "r3 origin")
    return found[1] == "N", _hexadecimal(found[2])


def read_ports(answer: str) -> tuple[int, tuple[int, ...]]:
    """Return the real-time port and those of the command channels from OPSTSRD."""
    realtime = re.search(r"PortNo\(R-time\) ([0-9]{1,5})", answer)
    options = re.search(r"PortNo\(OPT[0-9-]+\) ([0-9]{1,5}(?:/[0-9]{1,5})*)", answer)
    if realtime is None or options is None:
        raise WireError("fields", "r3 options")
    return int(realtime[1]), tuple(map(int, options[1].split("/")))


def _parts(answer: str, least: int, where: str) -> list[str]:
    parts = answer.split(";")
    if len(parts) < least:
        raise WireError("fields", where, len(answer))
    return parts


def _pair(text: str, mark: str) -> tuple[str, str]:
    first, found, second = text.partition(mark)
    if not found:
        raise WireError("fields", "r3 answer", len(text))
    return first, second


def _status(text: str) -> tuple[Run, Stop, int]:
    if len(text) < 5:
        raise WireError("fields", "r3 status", len(text))
    return Run(_hexadecimal(text[:2])), Stop(_hexadecimal(text[2:4])), whole(text[4:])


def _hexadecimal(text: str) -> int:
    if re.fullmatch(r"[0-9A-F]{1,8}", text) is None:
        raise WireError("number", "r3 answer")
    return int(text, 16)
