"""What a decoded message says, under the field names of the vector file."""

import math

from touchdown.backend.devices.bota import protocol
from touchdown.backend.devices.ft300 import protocol as robotiq_ft300
from touchdown.backend.devices.leptrino import protocol as leptrino
from touchdown.backend.devices.melfa import r3_protocol
from touchdown.backend.devices.melfa.realtime_protocol import (
    MelfaPose,
    RobotMonitor,
    kind_of,
    turns,
)
from touchdown.backend.devices.optoforce import protocol as optoforce
from touchdown.backend.devices.wsg import gcl as wsg_gcl
from touchdown.backend.devices.wsg import protocol as wsg_binary
from touchdown.backend.devices.wsg.protocol import SystemFlag, WsgCommand

CPF = 1_000_000.0


def _wrench(wrench):
    return {"force_n": list(wrench.force_n), "torque_nm": list(wrench.torque_nm)}


def _block(block):
    facts = {"kind": kind_of(block).value}
    if isinstance(block, MelfaPose):
        return facts | {"axes": list(block.axes), "flag1": block.flag1, "flag2": block.flag2}
    if isinstance(block, RobotMonitor):
        return facts | {
            "tcp_speed_fb": block.speed_feedback_mm_s,
            "remaining_fb": block.remaining_feedback_mm,
            "tcp_speed_cmd": block.speed_command_mm_s,
            "remaining_cmd": block.remaining_command_mm,
            "gap": block.gap,
            "transport_factor": block.transport_factor,
            "accel_state": block.accelerating,
            "step": block.step,
            "program": block.program,
            "temperature_c": block.temperature_c,
            "cycle_counter": block.cycle_counter,
        }
    return (
        facts if block is None else facts | {"axes": list(block.axes), "values": list(block.axes)}
    )


def _mxt(message, blocks, send_type):
    signals = message.signals
    return {
        "command": message.command,
        "send_type": send_type,
        "recv_types": list(message.monitors),
        "data": list(map(_block, blocks)),
        "send_io_type": signals.send,
        "recv_io_type": signals.receive,
        "bit_top": signals.head,
        "bit_mask": signals.mask,
        "io_data": signals.bits,
        "t_count": message.timeouts,
        "c_count": message.counter,
    }


def mxt_request(message, vector):
    send_type = {"none": 0, "pose": 1, "joint": 2, "pulse": 3}[kind_of(message.target).value]
    return _mxt(message, [message.target, None, None, None], send_type)


def mxt_reply(message, vector):
    return _mxt(message, message.blocks, message.send_type)


def monitor_request(message, vector):
    return {"command": message.command, "types": list(message.types)}


def monitor_reply(message, vector):
    return {
        "command": 1,
        "types": list(message.types),
        "input_head": message.input_head,
        "output_head": message.output_head,
        "input_data": message.inputs,
        "output_data": message.outputs,
        "counter": message.counter,
        "data": list(map(_block, message.blocks)),
    }


def r3_request(message, vector):
    return {
        "robot": message.robot,
        "slot": message.slot,
        "command": message.command,
        "argument": message.argument,
        "arguments": list(message.arguments),
    }


def _opened(answer):
    o = r3_protocol.read_opened(answer)
    names = (
        "xyz_axes joint_axes program_ext parameter_ext robot_type controller series date version "
        "language robot_info serial taskmax"
    )
    facts = {name: getattr(o, name) for name in names.split()}
    return facts | {"flag1": o.flags[0], "flag2": o.flags[1], "jog_speeds": list(o.jog_speeds)}


def _state(answer):
    s = r3_protocol.read_state(answer)
    run = r3_protocol.RunStatus
    names = "program line override edit_status error step task_program task_mode task_condition"
    return {name: getattr(s, name) for name in [*names.split(), "task_priority"]} | {
        "run_status": int(s.run),
        "stop_status": int(s.stop),
        "mech_info": s.mechanism,
        "mech_number": s.mechanism_in_use,
        "servo_on": run.SERVO_ON in s.run,
        "running": run.RUNNING in s.run,
        "operation_enabled": run.OPERATION_ENABLED in s.run,
        "teach": run.TEACH in s.run,
        "emergency": r3_protocol.StopStatus.EMERGENCY in s.stop,
    }


def _axes(answer):
    r = r3_protocol.read_axes(answer)
    turning = {name for name in r.names if name in "ABC" or name[0] == "J"}
    axes = {
        name: math.degrees(value) if name in turning else value
        for name, value in zip(r.names, r.values, strict=True)
    }
    facts = {"axes": axes, "override": r.override, "end_speed": r.speed_mm_s}
    facts |= {"plus_limit": r.plus_limit, "minus_limit": r.minus_limit}
    if r.flags is not None:
        facts |= {"flag1": r.flags[0], "flag2": r.flags[1], "multi_turn": list(turns(r.flags[1]))}
    return facts


ANSWERS = {
    "xyz_axes": _opened,
    "edit_status": _state,
    "end_speed": _axes,
    "override": lambda answer: {"override": r3_protocol.whole(answer)},
    "message": lambda answer: {"message": answer},
    "level": lambda answer: dict(
        zip(("error", "level"), r3_protocol.read_error(answer), strict=True)
    ),
    "count": lambda answer: dict(
        zip(("name", "value", "count"), r3_protocol.read_parameter(answer), strict=True)
    ),
}


def r3_reply(message: r3_protocol.R3Reply, vector):
    facts = {"ok": message.ok, "alarm": message.alarm, "answer": message.answer}
    if not message.ok:
        return facts | {"error": message.error, "extra": message.answer.split(";")[1:]}
    read = next((ANSWERS[key] for key in ANSWERS if key in vector["fields"]), None)
    # Nothing reads the other answers: their text alone is checked.
    return (vector["fields"] if read is None else read(message.answer)) | facts


WSG_FIELDS = {
    WsgCommand.HOME: ("direction",),
    WsgCommand.PREPOSITION: ("flags", "width", "speed"),
    WsgCommand.GRASP: ("width", "speed"),
    WsgCommand.RELEASE: ("width", "speed"),
    WsgCommand.SET_SOFT_LIMITS: ("minus", "plus"),
    WsgCommand.SET_ACCELERATION: ("value",),
    WsgCommand.SET_FORCE_LIMIT: ("value",),
}
WSG_REPLY_FIELDS = {
    WsgCommand.SYSTEM_STATE: ("flags",),
    WsgCommand.GRASP_STATE: ("state",),
    WsgCommand.STATISTICS: ("total", "no_part", "lost_part"),
    WsgCommand.SYSTEM_INFO: ("type", "hw_rev", "sw_rev", "serial"),
    WsgCommand.SYSTEM_LIMITS: (
        "stroke",
        "min_speed",
        "max_speed",
        "min_acc",
        "max_acc",
        "min_force",
        "nom_force",
        "ovr_force",
    ),
}
UPDATES = {
    WsgCommand.SYSTEM_STATE,
    WsgCommand.GRASP_STATE,
    *range(WsgCommand.WIDTH, WsgCommand.FORCE + 1),
}


def wsg_request(message: wsg_binary.WsgRequest, vector):
    facts = {"id": message.command, "length": vector["fields"].get("length")}
    assert bytes.fromhex(vector["hex"])[4] == facts["length"]
    if message.command in UPDATES:
        flags, period_ms = message.values
        return facts | {
            "auto": bool(flags & 1),
            "on_change": bool(flags & 2),
            "period_ms": period_ms,
        }
    if message.command == WsgCommand.ACKNOWLEDGE:
        return facts | {"key": message.values[0].decode()}
    if message.command == WsgCommand.STATISTICS:
        return facts | {"reset": bool(message.values[0])}
    if message.command not in WSG_FIELDS:
        return facts | {"payload": b"".join(message.values).hex()}
    return facts | dict(zip(WSG_FIELDS[message.command], message.values, strict=True))


def wsg_reply(message: wsg_binary.WsgReply, vector):
    facts = {"id": message.command, "length": vector["fields"].get("length")}
    facts["status"] = message.status
    if message.command == WsgCommand.SYSTEM_STATE:
        facts["flag_names"] = [f.name for f in SystemFlag if message.values[0] & f]
    if message.command == WsgCommand.LOOP:
        return facts | {"payload": message.values[0].hex()}
    names = WSG_REPLY_FIELDS.get(message.command, ("value",)) if message.values else ()
    return facts | dict(zip(names, message.values, strict=True))


def gcl(message: wsg_gcl.GclLine, vector):
    match message:
        case wsg_gcl.GclCall(command, arguments):
            return {"command": command, "arguments": list(arguments)}
        case wsg_gcl.GclQuery(name):
            return {"query": name}
        case wsg_gcl.GclAssignment(name, value):
            plain = list(value) if isinstance(value, tuple) else value
            return {"name": name, "set": name, "value": plain}
        case wsg_gcl.GclAnswer(kind, command):
            return {"kind": kind, "command": command}
        case wsg_gcl.GclError(command, code):
            return {"kind": "ERR", "command": command, "code": code}


def dynpick_record(message, vector):
    sensitivity = vector["fields"]["sensitivity"]
    facts = {"tick": message.tick, "raw": list(message.counts), "sensitivity": sensitivity}
    return facts | _wrench(message.wrench(sensitivity))


def leptrino_packet(message: leptrino.Packet, vector):
    if isinstance(message, leptrino.LeptrinoNak):
        return {"nak": True}
    body = leptrino.encode(message)[2:-3].replace(b"\x10\x10", b"\x10")
    facts = {"length": len(body), "command": body[2], "code": body[3], "body": body.hex()}
    match message:
        case leptrino.SensorInfo(model, serial, firmware):
            facts |= {"type": model, "serial": serial, "firmware": firmware}
        case leptrino.RatedLoads(loads):
            facts |= {"rated": list(loads)}
        case leptrino.FilterSetting(_, index):
            facts |= {"filter": index}
        case leptrino.LeptrinoSample(_, counts, status, reserve):
            rated = vector["fields"]["rated"]
            facts |= {"raw": list(counts), "status": status, "reserve": reserve, "rated": rated}
            facts |= _wrench(message.wrench(rated))
    return facts


def ft300(message, vector):
    facts = {"slave": 9}
    match message:
        case robotiq_ft300.StreamStop():
            return {"jam_length": 50}
        case robotiq_ft300.Ft300Sample(counts):
            return {"raw": list(counts)} | _wrench(message.wrench())
        case robotiq_ft300.ReadRegisters(register, count):
            return facts | {"function": 3, "register": register, "count": count}
        case robotiq_ft300.WriteRegister(register, value):
            return facts | {"function": 6, "register": register, "values": [value]}
        case robotiq_ft300.WriteRegisters(register, values):
            return facts | {"function": 16, "register": register, "values": list(values)}
        case robotiq_ft300.ModbusWritten(register, count):
            return facts | {"function": 16, "register": register, "count": count}
        case robotiq_ft300.RegisterValues(values):
            signed = tuple(value - 0x10000 if value & 0x8000 else value for value in values)
            wrench = robotiq_ft300.Ft300Sample(signed).wrench()
            return facts | {"function": 3, "values": list(values)} | _wrench(wrench)


def bota_message(message, vector):
    match message:
        case protocol.BotaBoot():
            return {"boot": True}
        case protocol.BotaReply(command, code):
            return {"reply_to": command, "code": code}
        case protocol.BotaRequest(command, arguments):
            return {"command": command, "arguments": list(arguments)}
    forces, torques = list(message.values[:3]), list(message.values[3:])
    facts = {"status": message.status, "timestamp_us": message.timestamp_us}
    facts |= {"temperature_c": message.temperature_c, "force_n": forces, "torque_nm": torques}
    return facts


def optoforce_message(message, vector):
    if isinstance(message, optoforce.OptoforceConfig):
        return {"speed": message.speed, "filter": message.filter, "zero": message.zero}
    if isinstance(message, optoforce.OptoforceAck):
        return {"status": message.status}
    facts = {"count": message.count, "status": message.status, "raw": list(message.counts)}
    facts |= {"daq": message.daq, "sensor": message.sensor, "overload": list(message.overload)}
    facts |= {"multiple": bool(message.status & 8), "sensor_number": message.status & 7}
    if "scale" in vector["fields"]:
        scale = vector["fields"]["scale"]
        facts |= {"scale": scale, "force_n": message.scaled([1.0] * len(scale), scale)}
    return facts


def rdt_request(message, vector):
    return {"header": 0x1234, "command": message.command, "count": message.count}


def rdt_record(message, vector):
    (record,) = message
    facts = {"rdt_sequence": record.rdt_sequence, "ft_sequence": record.ft_sequence}
    facts |= {"status": record.status, "counts": list(record.counts)}
    facts |= {"counts_per_force": CPF, "counts_per_torque": CPF}
    return facts | _wrench(record.wrench(CPF, CPF))
