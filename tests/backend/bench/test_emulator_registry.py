"""Clients written without the product: sockets, pipes and the manuals alone.

No codec of the product is used. Requests are literal bytes of a manual, and replies are parsed by
hand.
"""

import re
import socket
import struct
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

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


class Heard:
    """Bytes received over a socket or a pipe; ``until`` waits for more."""

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


def over_tcp(address):
    client = socket.create_connection(address, timeout=LIMIT_S)
    return client, Heard(lambda: client.recv(4096))


def over_udp(address):
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wire.settimeout(LIMIT_S)
    wire.connect(address)
    return wire


# -- gripper ---------------------------------------------------------------------------------------


def test_a_gripper_speaks_text(serve):
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
