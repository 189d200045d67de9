"""Hypothesis strategies: any message that a protocol can carry."""

from hypothesis import strategies as st

from tests.backend.wire.codecs import IN, MONITOR_KINDS, OUT
from touchdown.backend.devices.bota import protocol
from touchdown.backend.devices.dynpick import protocol as dynpick
from touchdown.backend.devices.ft300 import protocol as robotiq_ft300
from touchdown.backend.devices.leptrino import protocol as leptrino
from touchdown.backend.devices.melfa import protocol_monitor, protocol_mxt, protocol_r3
from touchdown.backend.devices.melfa.protocol_mxt import Kind, Pose, RobotMonitor, Values
from touchdown.backend.devices.netft import protocol as net_ft
from touchdown.backend.devices.optoforce import protocol as optoforce
from touchdown.backend.devices.wsg import protocol as wsg_binary
from touchdown.backend.devices.wsg import protocol_gcl
from touchdown.backend.devices.wsg.protocol import REPLIES, Command, Status

u8, u16, u32 = (st.integers(0, 2**bits - 1) for bits in (8, 16, 32))
i16, i32 = st.integers(-(2**15), 2**15 - 1), st.integers(-(2**31), 2**31 - 1)
f32 = st.floats(width=32, allow_nan=False, allow_infinity=False)
word = st.text("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789", min_size=1, max_size=8)
name = st.from_regex(r"\A[A-Z][A-Z0-9]{0,8}\Z")


def tuples(item, count):
    return st.tuples(*[item] * count)


pose = st.builds(Pose, tuples(f32, 8), u32, u32)


def values(kind):
    item = i32 if kind in (Kind.PULSE, Kind.CURRENT) else f32
    return st.builds(Values, st.just(kind), tuples(item, 6 if kind is Kind.FORCE else 8))


robmon = st.builds(
    RobotMonitor,
    *[f32] * 6,
    i16,
    i16,
    st.text("ABC0123", max_size=6),
    i16.map(lambda tenths: tenths / 10),
    u32,
)


WHOLE = (Kind.POSE, Kind.ROBMON)


def block(kind):
    if kind is Kind.NONE:
        return st.none()
    return {Kind.POSE: pose, Kind.ROBMON: robmon}[kind] if kind in WHOLE else values(kind)


def blocks(numbers, kinds):
    return st.tuples(*(block(kinds.get(number, Kind.NONE)) for number in numbers))


signals = st.builds(protocol_mxt.Signals, u16, u16, u16, u16, u16)
command = st.sampled_from(protocol_mxt.Command)
monitor_types = tuples(st.integers(0, 11), 4)
target = st.one_of(st.none(), pose, values(Kind.JOINT), values(Kind.PULSE))
mxt_reply = monitor_types.flatmap(
    lambda numbers: st.builds(
        protocol_mxt.Reply,
        command,
        st.integers(0, 11),
        st.just(numbers),
        blocks(numbers, protocol_mxt.MONITOR_KINDS),
        u32,
        signals,
        u16,
    )
)
data_types = tuples(st.sampled_from([0, *MONITOR_KINDS]), 4)
monitor_reply = data_types.flatmap(
    lambda numbers: st.builds(
        protocol_monitor.Reply,
        st.just(numbers),
        blocks(numbers, MONITOR_KINDS),
        u32,
        u16,
        u16,
        u32,
        u32,
    )
)
wsg_request = st.one_of(
    st.builds(
        wsg_binary.preposition, f32, f32, relative=st.booleans(), stop_on_block=st.booleans()
    ),
    st.builds(wsg_binary.grasp, f32, f32),
    st.builds(wsg_binary.set_force_limit, f32),
    st.builds(wsg_binary.update, st.sampled_from([Command.WIDTH, Command.SYSTEM_STATE]), u16),
    st.just(wsg_binary.acknowledge()),
    st.just(wsg_binary.Request(Command.STOP)),
    st.builds(
        wsg_binary.Request,
        st.sampled_from([Command.LOOP, Command.SET_TAG, 0x90]),
        st.tuples(st.binary(min_size=1, max_size=64)),
    ),
)
PARTS = {"f": f32, "B": u8, "H": u16, "I": u32, "h": i16.map(lambda tenths: tenths / 10)}


def _carried(layout):
    return st.tuples(*(PARTS[k] for k in layout[1:].replace("8f", "ffffffff")))


wsg_reply = st.one_of(
    st.builds(wsg_binary.Reply, u8, st.sampled_from([s for s in Status if s] + [999])),
    st.sampled_from([c for c in REPLIES if c not in (Command.LOOP, Command.GET_TAG)]).flatmap(
        lambda c: st.builds(wsg_binary.Reply, st.just(int(c)), st.just(0), _carried(REPLIES[c][-1]))
    ),
    st.builds(
        wsg_binary.Reply,
        st.sampled_from([Command.LOOP, Command.GET_TAG]),
        st.just(0),
        st.tuples(st.binary(min_size=1, max_size=64)),
    ),
)
plain_number = st.one_of(
    st.integers(-(10**9), 10**9), st.integers(-(10**6), 10**6).map(lambda n: n / 8)
)
scalar = st.one_of(plain_number, st.booleans(), st.text("abc XY[]()=?,", max_size=6))
gcl = st.one_of(
    st.builds(protocol_gcl.Call, name, st.lists(scalar, max_size=4).map(tuple)),
    st.builds(protocol_gcl.Query, name),
    st.builds(
        protocol_gcl.Assignment, name, st.one_of(plain_number, st.booleans(), tuples(scalar, 3))
    ),
    st.builds(protocol_gcl.Answer, st.sampled_from(["ACK", "FIN"]), name),
    st.builds(protocol_gcl.Failure, name, st.integers(0, 99999), st.text("abc XY", max_size=9)),
)
numbers = st.integers(-99999, 99999).map(lambda n: f"{n / 100:+.2f}")
r3_request = st.one_of(
    st.builds(protocol_r3.Request, st.sampled_from(["STATE", "STOP", "ERROR", "CLOSE", "STOPON"])),
    st.builds(protocol_r3.jog, st.integers(0, 5), u8, u8, st.integers(0, 2)),
    st.builds(
        lambda place, robot, slot: protocol_r3.Request("EXEC", f"Mvs {place}", robot, slot),
        tuples(numbers, 6).map(lambda six: f"({','.join(six)})(7,0)"),
        st.integers(0, 3),
        st.integers(0, 33),
    ),
    st.builds(lambda v, n: protocol_r3.Request("VAL=", f"{v}={n}", 1, 9), name, numbers),
    st.builds(lambda n: protocol_r3.Request("OVRD=", str(n)), st.integers(1, 100)),
    st.builds(lambda n: protocol_r3.Request("PAR", n), name),
)
r3_reply = st.builds(
    protocol_r3.Reply,
    st.sampled_from(["QoK", "Qok", "QeR", "Qer"]),
    st.text(st.characters(min_codepoint=0x20, max_codepoint=0xFF, exclude_characters="\x7f")),
)
leptrino_packet = st.one_of(
    st.builds(leptrino.Plain, u8, u8),
    st.builds(leptrino.Info, word, word, st.text("0123.", min_size=1, max_size=4)),
    st.builds(leptrino.Rated, tuples(st.floats(0.5, 1e5, width=32), 6)),
    st.builds(leptrino.Filter, st.sampled_from([0xA6, 0xB6]), u8),
    st.builds(leptrino.Sample, st.sampled_from([0x30, 0x32]), tuples(i16, 6), u8, u16),
)
ft300_shared = st.builds(robotiq_ft300.WriteOne, u16, u16)
ft300_incoming = st.one_of(
    st.builds(robotiq_ft300.Sample, tuples(i16, 6)),
    st.builds(robotiq_ft300.Registers, st.lists(u16, min_size=1, max_size=8).map(tuple)),
    st.builds(robotiq_ft300.Written, u16, u16),
    st.builds(robotiq_ft300.Refused, st.sampled_from([3, 6, 16]), u8),
    ft300_shared,
)
ft300_request = st.one_of(
    st.builds(robotiq_ft300.Read, u16, u16),
    st.builds(robotiq_ft300.WriteMany, u16, st.lists(u16, min_size=1, max_size=8).map(tuple)),
    st.just(robotiq_ft300.Stop()),
    ft300_shared,
)
bota_frame = st.builds(protocol.Frame, u16, tuples(f32, 6), u32, f32)
bota_request = st.one_of(
    st.sampled_from([protocol.Request("C"), protocol.Request("R")]),
    st.builds(lambda four: protocol.Request("c", four), tuples(st.integers(0, 9), 4)),
    st.builds(
        lambda sinc, three: protocol.Request("f", (sinc, *three)),
        st.integers(1, 999),
        tuples(st.integers(0, 1), 3),
    ),
)
optoforce_frame = st.sampled_from([3, 6, 12]).flatmap(
    lambda axes: st.builds(optoforce.Frame, u16, u16, tuples(i16, axes))
)
record = st.builds(net_ft.Record, u32, u32, u32, tuples(i32, 6))

MESSAGES = {
    ("melfa-mxt", OUT): st.builds(
        protocol_mxt.Request, command, target, monitor_types, u32, signals, u16
    ),
    ("melfa-mxt", IN): mxt_reply,
    ("melfa-monitor", OUT): st.builds(
        protocol_monitor.Request, st.sampled_from([1, 255]), tuples(u16, 4)
    ),
    ("melfa-monitor", IN): monitor_reply,
    ("melfa-r3", OUT): r3_request,
    ("melfa-r3", IN): r3_reply,
    ("wsg-binary", OUT): wsg_request,
    ("wsg-binary", IN): wsg_reply,
    ("wsg-gcl", OUT): gcl,
    ("wsg-gcl", IN): gcl,
    ("dynpick", OUT): st.sampled_from(dynpick.Command),
    ("dynpick", IN): st.builds(
        dynpick.Record, st.integers(0, 9), tuples(st.integers(0, 0x3FFF), 6)
    ),
    ("leptrino", OUT): leptrino_packet,
    ("leptrino", IN): leptrino_packet,
    ("robotiq-ft300", OUT): ft300_request,
    ("robotiq-ft300", IN): ft300_incoming,
    ("bota", OUT): bota_request,
    ("bota", IN): bota_frame,
    ("optoforce", OUT): st.builds(optoforce.Config, u8, u8, u8),
    ("optoforce", IN): st.one_of(st.builds(optoforce.Ack, u8), optoforce_frame),
    ("netft", OUT): st.builds(net_ft.Request, u16, u32),
    ("netft", IN): st.lists(record, min_size=1, max_size=4).map(tuple),
}
