"""Child that serves an emulated arm, gripper and wrist sensor and logs the packets to the arm.

``python -m tests.bench.children.logged_arm HOST`` prints the settings that lead a driver there;
each line is answered with what came since the last one. Packets are timed by the kernel as they
reach the socket, so that a late controller sees no burst that was none.
"""

import json
import socket
import struct
import sys
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np

from tests.backend.devices.melfa.emulated_arm import settings as melfa_settings
from tests.backend.rig.served import Served
from tests.bench.children.watched_arm import LineChild
from touchdown.backend.bench.emulated_scene import EMULATOR_PRIORITY, shorten_switch_interval
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core.scheduling import round_robin_priority
from touchdown.backend.devices.framing import ProtocolError
from touchdown.backend.devices.melfa.emulator import TIMEOUT_CYCLES, MelfaServer
from touchdown.backend.devices.melfa.realtime_protocol import (
    CYCLE_S,
    MxtCommand,
    decode_mxt_request,
)
from touchdown.backend.emulation.server import CHUNK

# Linux, asm-generic/socket.h: arrival time with each datagram, as two 64-bit numbers
SO_TIMESTAMPNS = 35


@dataclass(frozen=True, slots=True)
class Told:
    """``packets`` of the stream, ``moves`` of them motion commands; ``gap_ms`` between two, most.

    ``left_out``: share of the cycles between the first and the last that had no packet.

    ``ahead``: by how many commands any stretch of them outran its cycles. One a cycle are 0, and
    1 is a late one that the next follows at once; what was missed and then made up is more.
    ``share``: largest step of a joint, share of its top speed. ``late_ms``: how long after an error
    of the controller, or the end of its program by itself, a command still came.
    """

    packets: int
    moves: int
    left_out: float
    gap_ms: float
    ahead: float
    share: float
    late_ms: float


class LoggedFront(MelfaServer):
    """A controller that notes when each packet of the stream came, and whether it commands."""

    def __init__(self, *more: object, **named: object) -> None:
        self.came: list[tuple[float, bool]] = []
        super().__init__(*more, **named)  # type: ignore[arg-type]

    def _listen(self) -> None:
        super()._listen()
        self._sources[0].setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)

    def _take(self, stream: socket.socket, answers: list[bytes]) -> tuple[str, int] | None:
        try:
            data, notes, _, caller = stream.recvmsg(CHUNK, socket.CMSG_SPACE(16))
        except (BlockingIOError, ConnectionError):
            return None
        ((_, _, stamp),) = notes
        seconds, nanoseconds = struct.unpack("@qq", stamp)
        try:
            moves = decode_mxt_request(data).command is MxtCommand.MOVE
        except ProtocolError:
            moves = False
        self.came.append((seconds + 1e-9 * nanoseconds, moves))
        if (answer := self._device.stream.receive(self._log_received(data), data)) is not None:
            answers.append(answer)
        return caller[0], caller[1]

    def told(self) -> Told:
        came, self.came = self.came, []
        stream = self._device.stream
        all_s = np.array([t_s for t_s, _ in came])
        moves_s = np.array([t_s for t_s, moves in came if moves])
        share, stream.largest_share = stream.largest_share, 0.0
        gap_ms = 1e3 * float(np.diff(all_s).max()) if len(all_s) > 1 else 0.0
        late_ms = 1e3 * stream.late_command_s
        cycles = float(all_s[-1] - all_s[0]) / CYCLE_S if len(all_s) > 1 else 0.0
        left_out = max(0.0, 1.0 - (len(all_s) - 1) / cycles) if cycles else 0.0
        return Told(len(all_s), len(moves_s), left_out, gap_ms, ahead_of(moves_s), share, late_ms)


def ahead_of(times_s: np.ndarray) -> float:
    """Return by how much any stretch of commands at ``times_s`` (n,) outran one a cycle."""
    if not len(times_s):
        return 0.0
    lead = np.arange(len(times_s)) - (times_s - times_s[0]) / CYCLE_S
    return float((lead - np.minimum.accumulate(lead)).max())


class LoggedArm(LineChild):
    """``settings`` lead a driver to the devices."""

    def __init__(self, host: str) -> None:
        super().__init__(__name__, host)
        self.settings = HardwareSettings.model_validate_json(self.first)

    def told(self) -> Told:
        return Told(**json.loads(self.ask()))


def main(host: str) -> None:
    with round_robin_priority(EMULATOR_PRIORITY):
        served = Served(partial(LoggedFront, host=host))
    # Tests let it wait for a computer that stalls: here it ends a silent stream, as on hardware.
    device = served.arm._device
    device.stream._settings = melfa_settings(mxt={"mxttout": TIMEOUT_CYCLES})
    shorten_switch_interval()
    sys.stdout.write(served.settings.model_dump_json() + "\n")
    sys.stdout.flush()
    for _ in sys.stdin:
        sys.stdout.write(json.dumps(asdict(served.arm.told())) + "\n")
        sys.stdout.flush()
    served.close()


if __name__ == "__main__":
    main(sys.argv[1])
