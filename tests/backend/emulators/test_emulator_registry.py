"""Clients written without the product: sockets, serial ports and the manuals alone.

No codec of the product is used. Requests are literal bytes of a manual, and replies are parsed by
hand.
"""

import http.client
import re
import socket
import struct
import sys
import time
from functools import reduce
from pathlib import Path

import cv2
import numpy as np
import pytest
import serial

from touchdown.backend.bench.emulator_registry import emulate
from touchdown.backend.emulation.serving import EmulationChoice

LOAD = (1.0, -2.0, -10.5, 0.1, -0.2, 0.05)
LIMIT_S = 30.0
ptys = pytest.mark.skipif(sys.platform == "win32", reason="pseudo terminals")


@pytest.fixture
def serve(tmp_path):
    served = []

    def begin(kind, **more):
        made = emulate(EmulationChoice(kind, wrench=lambda now_s: LOAD, **more))
        made.start()
        served.append(made)
        return made

    yield begin
    for made in served:
        made.close()


def held(bits, byte, poly):
    return reduce(lambda c, _: c >> 1 ^ (poly if c & 1 else 0), range(8), bits ^ byte)


def modbus_crc(data):
    return reduce(lambda c, b: held(c, b, 0xA001), data, 0xFFFF)


def x25_crc(data):
    return reduce(lambda c, b: held(c, b, 0x8408), data, 0xFFFF) ^ 0xFFFF


def wsg_crc(data):
    def entry(k):
        shift = lambda c, _: (c << 1 ^ (0x1021 if c & 0x8000 else 0)) & 0xFFFF  # noqa: E731
        return reduce(shift, range(8), k << 8)

    return reduce(lambda c, b: entry((c ^ b) & 0xFF) ^ c >> 8, data, 0xFFFF)


class Heard:
    """Bytes received over a socket or a serial port; ``until`` waits for more."""

    def __init__(self, read):
        self._read, self.data = read, b""

    def until(self, found):
        end_s = time.monotonic() + LIMIT_S
        while (answer := found(self.data)) is None:
            assert time.monotonic() < end_s, self.data[-200:]
            self.data += self._read()
        return answer

    def until_text(self, text):
        self.until(lambda data: True if text in data else None)

    def frame(self, head, length, good):
        """Return the first valid frame that starts with ``head``."""

        def found(data):
            for start in re.finditer(b"(?=" + re.escape(head) + b")", data):
                frame = data[start.start() : start.start() + length]
                if len(frame) == length and good(frame):
                    return frame
            return None

        return self.until(found)


def over_tcp(address):
    client = socket.create_connection(address, timeout=LIMIT_S)
    return client, Heard(lambda: client.recv(4096))


def over_udp(address):
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wire.settimeout(LIMIT_S)
    wire.connect(address)
    return wire


@pytest.fixture
def port(serve, tmp_path):
    opened = []

    def begin(kind, baud):
        made = serve(kind, tty=tmp_path / kind)
        line = serial.Serial(str(tmp_path / kind), baud, timeout=0.1)
        opened.append(line)
        return line, Heard(lambda: line.read(64)), made.bench

    yield begin
    for line in opened:
        line.close()


# -- gripper ---------------------------------------------------------------------------------------


def test_a_gripper_homes_and_grasps_for_a_client_of_its_manual(serve):
    made = serve("wsg", part_mm=20.0)
    client, heard = over_tcp(made.fronts[0].address)

    def ask(text, command):
        client.sendall(bytes.fromhex(text))
        return lambda: next_of(command)

    def next_of(command):
        def whole(data):
            if len(data) < 8 or len(data) < 8 + int.from_bytes(data[4:6], "little"):
                return None
            return 8 + int.from_bytes(data[4:6], "little")

        while True:
            size = heard.until(whole)
            frame, heard.data = heard.data[:size], heard.data[size:]
            assert frame[:3] == b"\xaa\xaa\xaa"
            assert wsg_crc(frame) == 0
            if frame[3] == command:
                return frame[6:-2]

    assert ask("aaaaaa24030061636bdcb9", 0x24)() == b"\0\0"
    homed = ask("aaaaaa200100008f83", 0x20)
    assert [homed(), homed()] == [b"\x1a\0", b"\0\0"]
    grasped = ask("aaaaaa2508000000a0410000f041f1d5", 0x25)
    assert [grasped(), grasped()] == [b"\x1a\0", b"\0\0"]
    assert ask("aaaaaa410300000000de42", 0x41)() == b"\0\0\x04"
    status, width_mm = struct.unpack("<Hf", ask("aaaaaa430300000000b810", 0x43)())
    assert (status, width_mm) == (0, pytest.approx(20.0, abs=0.5))
    client.close()


def test_the_same_gripper_speaks_text(serve):
    made = serve("wsg", part_mm=20.0, text=True)
    client, heard = over_tcp(made.fronts[0].address)
    for line, answers in (
        (b"FSACK()\n", [b"ACK FSACK\n"]),
        (b"HOME()\n", [b"ACK HOME\n", b"FIN HOME\n"]),
        (b"GRIP(10)\n", [b"ACK GRIP\n", b"FIN GRIP\n"]),
        (b"GRIPSTATE?\n", [b"GRIPSTATE=4\n"]),
    ):
        client.sendall(line)
        for answer in answers:
            heard.until_text(answer)
            heard.data = heard.data.split(answer, 1)[1]
    client.sendall(b"POS?\n")
    told = heard.until(lambda data: re.search(rb"POS=([0-9.]+)\n", data))
    assert float(told[1]) == pytest.approx(20.0, abs=0.5)
    client.close()


# -- arm -------------------------------------------------------------------------------------------

MXT = struct.Struct("<HHHH8fIIHHHHHHIHH8fIIHH8fIIHH8fII")


class Console:
    """Command channel of an arm, as text."""

    def __init__(self, client, heard):
        self._client, self._heard = client, heard

    def ask(self, text):
        self._client.sendall(text.encode() + b"\r")
        answer = self._heard.until(lambda data: data if data.endswith(b"\r") else None)
        self._heard.data = b""
        return answer.decode().strip()

    def wait_for(self, bit, *, on):
        end_s = time.monotonic() + LIMIT_S
        while bool(int(self.ask("1;1;STATE").split(";")[4][:2], 16) & bit) is not on:
            assert time.monotonic() < end_s

    def joints(self):
        return np.array(re.findall(r"J[1-6];([-0-9.]+)", self.ask("1;1;JPOSF")), dtype=float)


def exchange(wire, command, kind, joints=(0.0,) * 6):
    """Send one packet of the real-time stream that requests joint feedback; return the reply."""
    none = (0.0,) * 8 + (0, 0)
    packet = MXT.pack(
        *(command, kind, 2, 0), *joints, 0.0, 0.0, 0, 0, *(0,) * 7, 8, 0, *none, *(0, 0), *none,
        *(0, 0), *none,
    )  # fmt: skip
    assert len(packet) == 196
    wire.send(packet)
    return None if command == 255 else MXT.unpack(wire.recv(300))


def test_an_arm_is_switched_on_and_streamed_to_by_text_and_one_struct(serve):
    bench = serve("melfa").bench
    client, heard = over_tcp(("127.0.0.1", bench["melfa.r3"]["port"]))
    console = Console(client, heard)
    opened = console.ask("1;1;OPEN=PYTHON")
    assert opened.startswith("QoK3F;3F;7,0;")
    assert "RV-5AS-D;CR800" in opened
    assert console.ask("1;1;SRVON") == "QeR6020"
    assert console.ask("1;1;CNTLON") == "QoK"
    assert console.ask("1;1;SRVON") == "QoK"
    console.wait_for(0x20, on=True)
    before = console.joints()
    assert console.ask("1;1;RUNTDMXT;1") == "QoK"
    console.wait_for(0x40, on=True)
    wire = over_udp(("127.0.0.1", bench["melfa.mxt"]["port"]))
    first = exchange(wire, 0, 0)
    assert (first[1], first[2]) == (2, 2)
    joints = np.array(first[4:10])
    assert np.degrees(joints) == pytest.approx(before, abs=0.02)
    for _ in range(10):
        joints[0] += 0.001
        reply = exchange(wire, 1, 2, joints)
        assert reply[4] == pytest.approx(joints[0], abs=1e-6)
    exchange(wire, 255, 0)
    console.wait_for(0x40, on=False)
    end_s = time.monotonic() + LIMIT_S
    while console.joints()[0] - before[0] < np.degrees(0.01) - 0.02:
        assert time.monotonic() < end_s
    assert console.joints()[1:] == pytest.approx(before[1:], abs=0.02)
    assert console.ask("1;1;SRVOFF") == "QoK"
    client.close()
    wire.close()


# -- wrist sensors ---------------------------------------------------------------------------------


@ptys
def test_a_dynpick_answers_single_letters(port):
    line, heard, _ = port("dynpick", 921600)
    line.write(b"p")
    told = heard.until(lambda data: re.search(rb"((?:[0-9.]+,){5}[0-9.]+)\r\n", data))
    scale = np.array(told[1].split(b","), dtype=float)
    heard.data = b""
    line.write(b"R")
    record = heard.until(lambda data: re.fullmatch(rb"[0-9]([0-9A-F]{24})\r\n", data))
    fields = [int(record[1][4 * k : 4 * k + 4], 16) for k in range(6)]
    assert (np.array(fields) - 8192) / scale == pytest.approx(LOAD, abs=0.02)


@ptys
def test_a_leptrino_streams_its_stuffed_frames(port):
    line, heard, _ = port("leptrino", 460800)

    def frame(length, command):
        def found(data):
            for start in re.finditer(rb"\x10\x02", data):
                # A doubled 10 inside: one byte of data; then the end, and the XOR of all.
                body = re.match(rb"((?:[^\x10]|\x10\x10)*)\x10\x03(.)", data[start.end() :], re.S)
                if body is None:
                    continue
                plain = body[1].replace(b"\x10\x10", b"\x10")
                if plain[:3] == bytes([length, 0xFF, command]):
                    assert reduce(lambda a, b: a ^ b, plain + b"\x03") == body[2][0]
                    return plain
            return None

        return heard.until(found)

    line.write(bytes.fromhex("100204ff2b001003d3"))
    rated = np.array(struct.unpack("<6f", frame(0x1C, 0x2B)[4:]))
    line.write(bytes.fromhex("100204ff32001003ca"))
    counts = np.array(struct.unpack("<6h", frame(0x14, 0x32)[4:16]))
    assert counts / 10000.0 * rated == pytest.approx(LOAD, abs=0.05)
    line.write(bytes.fromhex("100204ff33001003cb"))
    frame(0x04, 0x33)


@ptys
def test_an_ft300_is_started_by_modbus_and_stopped_by_ff(port):
    line, heard, _ = port("ft300", 19200)
    line.write(bytes.fromhex("0910019a0001020200cdca"))
    heard.until_text(bytes.fromhex("0910019a00012152"))
    good = lambda f: modbus_crc(f[:14]).to_bytes(2, "little") == f[14:]  # noqa: E731
    values = struct.unpack("<6h", heard.frame(b"\x20\x4e", 16, good)[2:14])
    assert np.array(values) / [100, 100, 100, 1000, 1000, 1000] == pytest.approx(LOAD, abs=0.02)
    line.write(b"\xff" * 50)
    end_s = time.monotonic() + LIMIT_S
    while line.read(16):
        assert time.monotonic() < end_s


@ptys
def test_a_bota_goes_through_its_configuration_mode(port):
    line, heard, _ = port("bota", 460800)
    for text, answer in ((b"C", b"r,0,C,0"), (b"c,0,1,0,4", b"r,0,c,0"), (b"R", b"r,0,R,0")):
        line.write(text)
        heard.until_text(answer)
    good = lambda f: x25_crc(f[1:35]).to_bytes(2, "little") == f[35:]  # noqa: E731
    status, *values = struct.unpack("<H6f", heard.frame(b"\xaa", 37, good)[1:27])
    assert status == 0
    assert values == pytest.approx(LOAD, abs=0.01)


@ptys
def test_an_optoforce_takes_its_nine_bytes(port):
    line, heard, bench = port("optoforce", 1000000)
    line.write(bytes.fromhex("aa0032030a040000ed"))
    heard.until_text(bytes.fromhex("aa0050010000fb"))
    good = lambda f: sum(f[:20]) == int.from_bytes(f[20:], "big")  # noqa: E731
    frame = heard.frame(bytes.fromhex("aa070810"), 22, good)
    _, status, *counts = struct.unpack(">HH6h", frame[4:20])
    assert status == 0
    scale = np.array(bench["optoforce"]["capacity"]) / bench["optoforce"]["counts"]
    assert np.array(counts) * scale == pytest.approx(LOAD, abs=0.05)


def test_a_net_ft_tells_its_scale_by_page_and_its_samples_by_datagram(serve):
    made = serve("netft")
    page = http.client.HTTPConnection("127.0.0.1", made.bench["netft"]["http_port"], timeout=9)
    page.request("GET", "/netftapi2.xml")
    text = page.getresponse().read().decode()
    page.close()
    per_n, per_nm = (
        float(re.search(f"<{name}>([0-9.]+)</{name}>", text)[1]) for name in ("cfgcpf", "cfgcpt")
    )
    wire = over_udp(made.fronts[0].address)
    wire.send(bytes.fromhex("1234000200000000"))
    numbers = []
    for _ in range(3):
        number, _, status, *counts = struct.unpack(">III6i", wire.recv(100))
        numbers.append(number)
        assert status == 0
        scale = [per_n] * 3 + [per_nm] * 3
        assert np.array(counts) / scale == pytest.approx(LOAD, abs=0.001)
    assert numbers == [1, 2, 3]
    wire.send(bytes.fromhex("1234000000000000"))
    wire.close()


def test_the_monitor_of_the_controller_sends_what_it_was_asked_for(serve):
    made = serve("monitor")
    kind = made.bench["melfa.monitor"]["type_force"]
    wire = over_udp(made.fronts[0].address)
    wire.send(struct.pack("<HHHH", 1, 0, kind, 0).ljust(196, b"\0"))
    first, second = wire.recv(300), wire.recv(300)
    assert [len(first), len(second)] == [196, 196]
    assert struct.unpack_from("<H", first, 4) == (kind,)
    assert struct.unpack_from("<6f", first, 8) == pytest.approx(LOAD, abs=1e-5)
    counters = [struct.unpack_from("<I", packet, 60)[0] for packet in (first, second)]
    assert counters[1] == counters[0] + 1
    wire.send(struct.pack("<H", 255).ljust(196, b"\0"))
    wire.close()


# -- cameras ---------------------------------------------------------------------------------------


@ptys
def test_a_camera_is_found_by_its_name_and_gives_pictures(serve, tmp_path):
    serve("gelsight", folder=tmp_path, serial="2D8Y-69GR")
    (found,) = (tmp_path / "by-id").glob("*2D8Y*index0")
    name = (tmp_path / "names" / Path(found.resolve()).name / "name").read_text()
    assert name.startswith("GelSight Mini R0B 2D8Y-69GR")
    with found.open("rb", buffering=0) as pipe:
        heard = Heard(lambda: pipe.read(65536))
        jpeg = heard.until(lambda data: re.search(rb"\xff\xd8\xff.*?\xff\xd9", data, re.S))
    picture = cv2.imdecode(np.frombuffer(jpeg[0], np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] * 3 == picture.shape[0] * 4
    assert picture.std() > 1.0
