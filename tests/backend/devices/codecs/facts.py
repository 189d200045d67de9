"""Value of a decoded message for each field of the vector file."""

import math

from touchdown.backend.devices.ft300 import protocol as ft300
from touchdown.backend.devices.leptrino import protocol as leptrino
from touchdown.backend.devices.melfa import r3_protocol
from touchdown.backend.devices.melfa.r3_protocol import RunFlags, StopFlags
from touchdown.backend.devices.melfa.realtime_protocol import MelfaPose, kind_of, turns
from touchdown.backend.devices.wsg.protocol import SystemFlag

COUNTS_PER_UNIT = 1_000_000.0  # of the vectors of a Net F/T
# Fields that are no content of the message: what its scale is taken from.
GIVEN = ("sensitivity", "rated", "scale", "counts_per_force", "counts_per_torque")


def facts(message, vector):
    """Return what ``message`` says, by the field names of its vector."""
    table = FACTS.get(vector["device"], {})
    if vector["device"] == "melfa-r3" and vector["direction"] == "device-to-pc":
        return r3_reply(message, vector)
    if vector["device"] == "netft" and vector["direction"] == "device-to-pc":
        (message,) = message
    return {
        key: wanted
        if key in GIVEN
        else table[key](message, vector)
        if key in table
        else getattr(message, key)
        for key, wanted in vector["fields"].items()
    }


def _at(place, name="values"):
    return lambda m, v: getattr(m, name)[place]


def _wrench(*scale):
    """Return the entries of a wrench whose scale are these fields of the vector."""

    def part(name):
        return lambda m, v: getattr(m.wrench(*(v["fields"][key] for key in scale)), name)

    return {"force_n": part("force_n"), "torque_nm": part("torque_nm")}


# -- MELFA ----------------------------------------------------------------------------------------


def _block(block):
    told = {"kind": kind_of(block).value}
    if isinstance(block, MelfaPose):
        return told | {"axes": block.axes, "flag1": block.flag1, "flag2": block.flag2}
    return told if block is None else told | {"axes": block.axes, "values": block.axes}


def _blocks(message, vector):
    target = getattr(message, "target", None)
    return [_block(block) for block in getattr(message, "blocks", (target, None, None, None))]


def _send_type(message, vector):
    if hasattr(message, "send_type"):
        return message.send_type
    return {"none": 0, "pose": 1, "joint": 2, "pulse": 3}[kind_of(message.target).value]


def _opened(answer):
    return dict(zip(("robot_type", "version"), r3_protocol.read_opened(answer), strict=True))


def _state(answer):
    told = r3_protocol.read_state(answer)
    names = "program line override edit_status error step task_program task_mode task_condition"
    return {name: getattr(told, name) for name in [*names.split(), "task_priority"]} | {
        "run_status": int(told.run),
        "stop_status": int(told.stop),
        "mech_info": told.mechanism,
        "mech_number": told.mechanism_in_use,
        "servo_on": RunFlags.SERVO_ON in told.run,
        "running": RunFlags.RUNNING in told.run,
        "operation_enabled": RunFlags.OPERATION_ENABLED in told.run,
        "teach": RunFlags.TEACH in told.run,
        "emergency": StopFlags.EMERGENCY in told.stop,
    }


def _axes(answer):
    told = r3_protocol.read_axes(answer)
    axes = {
        name: math.degrees(value) if name in "ABC" or name[0] == "J" else value
        for name, value in zip(told.names, told.values, strict=True)
    }
    found = {"axes": axes, "override": told.override, "end_speed": told.speed_mm_s}
    found |= {"plus_limit": told.plus_limit, "minus_limit": told.minus_limit}
    if told.flags is not None:
        first, second = told.flags
        found |= {"flag1": first, "flag2": second, "multi_turn": turns(second)}
    return found


# Reader of an answer by a field that only this answer has.
ANSWERS = {
    "xyz_axes": _opened,
    "edit_status": _state,
    "end_speed": _axes,
    "override": lambda answer: {"override": r3_protocol.whole(answer)},
    "level": lambda answer: dict(
        zip(("error", "level"), r3_protocol.read_error(answer), strict=True)
    ),
    "count": lambda answer: dict(
        zip(("name", "value", "count"), r3_protocol.read_parameter(answer), strict=True)
    ),
}


def r3_reply(message, vector):
    found = {"ok": message.ok, "alarm": message.alarm, "answer": message.answer}
    if not message.ok:
        return found | {"error": message.error, "extra": message.answer.split(";")[1:]}
    read = next((ANSWERS[key] for key in ANSWERS if key in vector["fields"]), lambda answer: {})
    # Nothing reads the other answers and fields: their text alone is checked.
    return vector["fields"] | read(message.answer) | found


# -- sensors and gripper --------------------------------------------------------------------------


def _body(message, vector):
    return leptrino.encode(message)[2:-3].replace(b"\x10\x10", b"\x10")


FUNCTIONS = {
    ft300.ReadRegisters: 3,
    ft300.RegisterValues: 3,
    ft300.WriteRegister: 6,
    ft300.WriteRegisters: 16,
    ft300.ModbusWritten: 16,
}


def _ft300_wrench(name):
    def part(message, vector):
        if isinstance(message, ft300.RegisterValues):
            signed = tuple(value - 0x10000 if value & 0x8000 else value for value in message.values)
            message = ft300.Ft300Sample(signed)
        return getattr(message.wrench(), name)

    return part


WSG_LIMITS = "stroke min_speed max_speed min_acc max_acc min_force nom_force ovr_force"
FACTS = {
    "melfa-mxt": {
        "send_type": _send_type,
        "recv_types": lambda m, v: m.monitors,
        "data": _blocks,
        "t_count": lambda m, v: m.timeouts,
        "c_count": lambda m, v: m.counter,
        "send_io_type": _at(0, "signals"),
        "recv_io_type": _at(1, "signals"),
        "bit_top": _at(2, "signals"),
        "bit_mask": _at(3, "signals"),
        "io_data": _at(4, "signals"),
    },
    "melfa-monitor": {
        "command": lambda m, v: getattr(m, "command", 1),
        "data": _blocks,
        "input_head": _at(0, "signals"),
        "output_head": _at(1, "signals"),
        "input_data": _at(2, "signals"),
        "output_data": _at(3, "signals"),
    },
    "wsg-binary": {
        "id": lambda m, v: m.command,
        "length": lambda m, v: bytes.fromhex(v["hex"])[4],
        "payload": lambda m, v: b"".join(m.values).hex(),
        "key": lambda m, v: m.values[0].decode(),
        "auto": lambda m, v: bool(m.values[0] & 1),
        "on_change": lambda m, v: bool(m.values[0] & 2),
        "reset": lambda m, v: bool(m.values[0]),
        "flag_names": lambda m, v: [f.name for f in SystemFlag if m.values[0] & f],
        **dict.fromkeys(("direction", "flags", "value", "state", "minus"), _at(0)),
        "width": _at(-2),
        "speed": _at(-1),
        **dict.fromkeys(("period_ms", "plus"), _at(1)),
        **{name: _at(place) for place, name in enumerate(("total", "no_part", "lost_part"))},
        **{name: _at(place) for place, name in enumerate(("type", "hw_rev", "sw_rev", "serial"))},
        **{name: _at(place) for place, name in enumerate(WSG_LIMITS.split())},
    },
    "wsg-gcl": {
        "kind": lambda m, v: getattr(m, "kind", "ERR"),
        "query": lambda m, v: m.name,
        "set": lambda m, v: m.name,
    },
    "dynpick": {
        "command": lambda m, v: m.value.decode(),
        "raw": lambda m, v: m.counts,
        **_wrench("sensitivity"),
    },
    "leptrino": {
        "nak": lambda m, v: isinstance(m, leptrino.LeptrinoNak),
        "body": lambda m, v: _body(m, v).hex(),
        "length": lambda m, v: len(_body(m, v)),
        "command": lambda m, v: _body(m, v)[2],
        "code": lambda m, v: _body(m, v)[3],
        "filter": lambda m, v: m.index,
        "type": lambda m, v: m.model,
        "raw": lambda m, v: m.counts,
        **_wrench("rated"),
    },
    "robotiq-ft300": {
        "slave": lambda m, v: ft300.SLAVE,
        "function": lambda m, v: FUNCTIONS[type(m)],
        "values": lambda m, v: getattr(m, "values", None) or [m.value],
        "jam_length": lambda m, v: ft300.STOP_BYTES,
        "raw": lambda m, v: m.counts,
        "force_n": _ft300_wrench("force_n"),
        "torque_nm": _ft300_wrench("torque_nm"),
    },
    "bota": {
        "boot": lambda m, v: True,
        "reply_to": lambda m, v: m.command,
        "force_n": lambda m, v: m.values[:3],
        "torque_nm": lambda m, v: m.values[3:],
    },
    "optoforce": {
        "raw": lambda m, v: m.counts,
        "multiple": lambda m, v: bool(m.status & 8),
        "sensor_number": lambda m, v: m.status & 7,
        "force_n": lambda m, v: m.scaled([1.0] * 3, v["fields"]["scale"]),
    },
    "netft": {"header": lambda m, v: 0x1234, **_wrench("counts_per_force", "counts_per_torque")},
}
