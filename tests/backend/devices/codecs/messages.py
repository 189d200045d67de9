"""Hypothesis strategies: any message that a protocol can carry."""

from hypothesis import strategies as st

from tests.backend.devices.codecs.codecs import IN, MONITOR_KINDS, OUT
from touchdown.backend.devices.bota import protocol
from touchdown.backend.devices.dynpick import protocol as dynpick
from touchdown.backend.devices.ft300 import protocol as robotiq_ft300
from touchdown.backend.devices.leptrino import protocol as leptrino
from touchdown.backend.devices.melfa import r3_protocol, realtime_protocol
from touchdown.backend.devices.melfa.realtime_protocol import AxisValues, BlockKind, MelfaPose
from touchdown.backend.devices.netft import protocol as net_ft
from touchdown.backend.devices.optoforce import protocol as optoforce
from touchdown.backend.devices.wsg import gcl as wsg_gcl
from touchdown.backend.devices.wsg import protocol as wsg_binary
from touchdown.backend.devices.wsg.protocol import REPLIES, WsgCommand, WsgStatus

u8, u16, u32 = (st.integers(0, 2**bits - 1) for bits in (8, 16, 32))
i16, i32 = st.integers(-(2**15), 2**15 - 1), st.integers(-(2**31), 2**31 - 1)
f32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
word = st.text("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789", min_size=1, max_size=8)
name = st.from_regex(r"\A[A-Z][A-Z0-9]{0,8}\Z")


def tuples(item, count):
    return st.tuples(*[item] * count)


pose = st.builds(MelfaPose, tuples(f32, 8), u32, u32)


def values(kind):
    item = i32 if kind in (BlockKind.PULSE, BlockKind.CURRENT) else f32
    return st.builds(AxisValues, st.just(kind), tuples(item, 6 if kind is BlockKind.FORCE else 8))


def block(kind):
    if kind is BlockKind.NONE:
        return st.none()
    return pose if kind is BlockKind.POSE else values(kind)


def blocks(numbers, kinds):
    return st.tuples(*(block(kinds.get(number, BlockKind.NONE)) for number in numbers))


signals = tuples(u16, 5)
command = st.sampled_from(realtime_protocol.MxtCommand)
monitor_types = tuples(st.integers(0, 11), 4)
target = st.one_of(st.none(), pose, values(BlockKind.JOINT), values(BlockKind.PULSE))
mxt_reply = monitor_types.flatmap(
    lambda numbers: st.builds(
        realtime_protocol.MxtReply,
        command,
        st.integers(0, 11),
        st.just(numbers),
        blocks(numbers, realtime_protocol.MONITOR_KINDS),
        u32,
        signals,
        u16,
    )
)
data_types = tuples(st.sampled_from([0, *MONITOR_KINDS]), 4)
monitor_reply = data_types.flatmap(
    lambda numbers: st.builds(
        realtime_protocol.MonitorReply,
        st.just(numbers),
        blocks(numbers, MONITOR_KINDS),
        u32,
        st.tuples(u16, u16, u32, u32),
    )
)
wsg_request = st.one_of(
    st.builds(
        wsg_binary.preposition, f32, f32, relative=st.booleans(), stop_on_block=st.booleans()
    ),
    st.builds(wsg_binary.grasp, f32, f32),
    st.builds(wsg_binary.set_force_limit, f32),
    st.builds(wsg_binary.update, st.sampled_from([WsgCommand.WIDTH, WsgCommand.SYSTEM_STATE]), u16),
    st.just(wsg_binary.acknowledge()),
    st.just(wsg_binary.WsgRequest(WsgCommand.STOP)),
    st.builds(
        wsg_binary.WsgRequest,
        st.sampled_from([WsgCommand.LOOP, WsgCommand.SET_TAG, 0x90]),
        st.tuples(st.binary(min_size=1, max_size=64)),
    ),
)
PARTS = {"f": f32, "B": u8, "H": u16, "I": u32, "h": i16.map(lambda tenths: tenths / 10)}


def _carried(layout):
    return st.tuples(*(PARTS[k] for k in layout[1:].replace("8f", "ffffffff")))


wsg_reply = st.one_of(
    st.builds(wsg_binary.WsgReply, u8, st.sampled_from([s for s in WsgStatus if s] + [999])),
    st.sampled_from([c for c in REPLIES if c not in (WsgCommand.LOOP, WsgCommand.GET_TAG)]).flatmap(
        lambda c: st.builds(
            wsg_binary.WsgReply, st.just(int(c)), st.just(0), _carried(REPLIES[c][-1])
        )
    ),
    st.builds(
        wsg_binary.WsgReply,
        st.sampled_from([WsgCommand.LOOP, WsgCommand.GET_TAG]),
        st.just(0),
        st.tuples(st.binary(min_size=1, max_size=64)),
    ),
)
plain_number = st.one_of(
    st.integers(-(10**9), 10**9), st.integers(-(10**6), 10**6).map(lambda n: n / 8)
)
scalar = st.one_of(plain_number, st.booleans(), st.text("abc XY[]()=?,", max_size=6))
gcl = st.one_of(
    st.builds(wsg_gcl.GclCall, name, st.lists(scalar, max_size=4).map(tuple)),
    st.builds(wsg_gcl.GclQuery, name),
    st.builds(
        wsg_gcl.GclAssignment, name, st.one_of(plain_number, st.booleans(), tuples(scalar, 3))
    ),
    st.builds(wsg_gcl.GclAnswer, st.sampled_from(["ACK", "FIN"]), name),
    st.builds(wsg_gcl.GclError, name, st.integers(0, 99999), st.text("abc XY", max_size=9)),
)
numbers = st.integers(-99999, 99999).map(lambda n: f"{n / 100:+.2f}")
r3_request = st.one_of(
    st.builds(
        r3_protocol.R3Request, st.sampled_from(["STATE", "STOP", "ERROR", "CLOSE", "STOPON"])
    ),
    st.builds(
        lambda mode, a, b: r3_protocol.R3Request("JOG", f"0{mode};00;{a:02X};{b:02X};00"),
        *(st.integers(0, 5), u8, u8),
    ),
    st.builds(
        lambda place, robot, slot: r3_protocol.R3Request("EXEC", f"Mvs {place}", robot, slot),
        tuples(numbers, 6).map(lambda six: f"({','.join(six)})(7,0)"),
        st.integers(0, 3),
        st.integers(0, 33),
    ),
    st.builds(lambda v, n: r3_protocol.R3Request("VAL=", f"{v}={n}", 1, 9), name, numbers),
    st.builds(lambda n: r3_protocol.R3Request("OVRD=", str(n)), st.integers(1, 100)),
    st.builds(lambda n: r3_protocol.R3Request("PAR", n), name),
)
r3_reply = st.builds(
    r3_protocol.R3Reply,
    st.sampled_from(["QoK", "Qok", "QeR", "Qer"]),
    st.text(st.characters(min_codepoint=0x20, max_codepoint=0xFF, exclude_characters="\x7f")),
)
leptrino_packet = st.one_of(
    st.builds(leptrino.PlainFrame, u8, u8),
    st.builds(leptrino.SensorInfo, word, word, st.text("0123.", min_size=1, max_size=4)),
    st.builds(leptrino.RatedLoads, tuples(st.floats(0.5, 1e5, width=32), 6)),
    st.builds(leptrino.FilterSetting, st.sampled_from([0xA6, 0xB6]), u8),
    st.builds(leptrino.LeptrinoSample, st.sampled_from([0x30, 0x32]), tuples(i16, 6), u8, u16),
)
ft300_shared = st.builds(robotiq_ft300.WriteRegister, u16, u16)
ft300_incoming = st.one_of(
    st.builds(robotiq_ft300.Ft300Sample, tuples(i16, 6)),
    st.builds(robotiq_ft300.RegisterValues, st.lists(u16, min_size=1, max_size=8).map(tuple)),
    st.builds(robotiq_ft300.ModbusWritten, u16, u16),
    st.builds(robotiq_ft300.ModbusRefusal, st.sampled_from([3, 6, 16]), u8),
    ft300_shared,
)
ft300_request = st.one_of(
    st.builds(robotiq_ft300.ReadRegisters, u16, u16),
    st.builds(robotiq_ft300.WriteRegisters, u16, st.lists(u16, min_size=1, max_size=8).map(tuple)),
    st.just(robotiq_ft300.StreamStop()),
    ft300_shared,
)
bota_frame = st.builds(protocol.BotaFrame, u16, tuples(f32, 6), u32, f32)
bota_request = st.one_of(
    st.sampled_from([protocol.BotaRequest("C"), protocol.BotaRequest("R")]),
    st.builds(lambda four: protocol.BotaRequest("c", four), tuples(st.integers(0, 9), 4)),
    st.builds(
        lambda sinc, three: protocol.BotaRequest("f", (sinc, *three)),
        st.integers(1, 999),
        tuples(st.integers(0, 1), 3),
    ),
)
optoforce_frame = st.sampled_from([3, 6, 12]).flatmap(
    lambda axes: st.builds(optoforce.OptoforceFrame, u16, u16, tuples(i16, axes))
)
record = st.builds(net_ft.RdtRecord, u32, u32, u32, tuples(i32, 6))

MESSAGES = {
    ("melfa-mxt", OUT): st.builds(
        realtime_protocol.MxtRequest, command, target, monitor_types, u32, signals, u16
    ),
    ("melfa-mxt", IN): mxt_reply,
    ("melfa-monitor", OUT): st.builds(
        realtime_protocol.MonitorRequest, st.sampled_from([1, 255]), tuples(u16, 4)
    ),
    ("melfa-monitor", IN): monitor_reply,
    ("melfa-r3", OUT): r3_request,
    ("melfa-r3", IN): r3_reply,
    ("wsg-binary", OUT): wsg_request,
    ("wsg-binary", IN): wsg_reply,
    ("wsg-gcl", OUT): gcl,
    ("wsg-gcl", IN): gcl,
    ("dynpick", OUT): st.sampled_from(dynpick.DynpickCommand),
    ("dynpick", IN): st.builds(
        dynpick.DynpickRecord, st.integers(0, 9), tuples(st.integers(0, 0x3FFF), 6)
    ),
    ("leptrino", OUT): leptrino_packet,
    ("leptrino", IN): leptrino_packet,
    ("robotiq-ft300", OUT): ft300_request,
    ("robotiq-ft300", IN): ft300_incoming,
    ("bota", OUT): bota_request,
    ("bota", IN): bota_frame,
    ("optoforce", OUT): st.builds(optoforce.OptoforceConfig, u8, u8, u8),
    ("optoforce", IN): st.one_of(st.builds(optoforce.OptoforceAck, u8), optoforce_frame),
    ("netft", OUT): st.builds(net_ft.RdtRequest, u16, u32),
    ("netft", IN): st.lists(record, min_size=1, max_size=4).map(tuple),
}
