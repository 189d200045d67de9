"""Real-time process: ``python -m touchdown.backend.rig.process``.

The backend starts it with one pipe in each direction. The first message has settings, limits, clock
and shared memory; the answer is an identity or a refusal. Then one cycle runs every 4 ms, at
real-time priority if permitted. A closed pipe, a dying parent or SIGTERM ends all motion, then the
process. It loads no Qt, torch or OpenCV.
"""

from __future__ import annotations

import gc
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import IO

from touchdown.backend import core
from touchdown.backend.config import HardwareSettings, Limits
from touchdown.backend.devices import make_arm, make_force_torque, make_gripper
from touchdown.backend.rig.host import Devices, RigHost
from touchdown.backend.rig.memory import SharedMemory, attach
from touchdown.backend.rig.messages import Channel, Message, ParentProcess, error_row, pack, receive

ROUND_S = 0.004
END_S = 0.03  # the end packets of the stream need three cycles
CLOSING_S = 1.0  # limit for loosened jaws to close
FAREWELL_S = 3.0  # limit for closing the devices after the backend is gone
CAPACITY = 32_768


def make_devices(settings: HardwareSettings, now_s: Callable[[], float]) -> Devices:
    """Return the three drivers of a lab file, not yet connected; raises ``InputError``."""
    samples = core.SampleStream("force_torque", 6, CAPACITY)
    poses = core.SampleStream("arm", 3, CAPACITY)
    sensor = make_force_torque(settings, now_s, samples)
    gripper = make_gripper(settings, now_s)
    return Devices(make_arm(settings, now_s, samples, poses), gripper, sensor, samples, poses)


def main() -> int:
    """Serve one backend until it disconnects; return the exit code."""
    # Both pipes are for messages; printing goes to standard error.
    source, sink = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    # Ctrl-C is handled by the backend, which ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    begin = receive(source)
    if begin is None:
        return 0
    begun_s = float(begin["begun_s"])

    def now_s() -> float:
        return time.monotonic() - begun_s

    try:
        settings = HardwareSettings.model_validate(begin["settings"])
        devices = make_devices(settings, now_s)
        memory = attach(Path(begin["memory"]))
    except (core.InputError, ValueError, OSError) as error:
        sink.write(pack({"kind": "refused", "error": error_row(error)}))
        sink.flush()
        return 2
    return _serve(begin, devices, memory, (source, sink), now_s, settings.melfa.realtime_priority)


def _serve(
    begin: Message,
    devices: Devices,
    memory: SharedMemory,
    pipes: tuple[IO[bytes], IO[bytes]],
    now_s: Callable[[], float],
    priority: int,
) -> int:
    channel: Channel

    def say(message: Message) -> bool:
        # A backend that no longer reads counts as lost.
        taken = channel.say(message)
        if not taken:
            host.leave()
        return taken

    # Before any thread starts: all inherit the priority, or one without it would delay the others.
    realtime = core.set_realtime_priority(priority)
    if not realtime:
        core.request_short_slices()
    parent = ParentProcess()
    host = RigHost(devices, Limits(**begin["limits"]), now_s, memory, say)
    channel = Channel(*pipes, host.take, host.abandon)

    def terminate(number: int, frame: FrameType | None) -> None:
        host.leave()

    signal.signal(signal.SIGTERM, terminate)
    # Permanent objects: exclude them from garbage collection. The backend expects the first cycle
    # within 250 ms of the greeting, less than a collection takes on a busy computer.
    gc.collect()
    gc.freeze()
    channel.say(_hello(devices, realtime=realtime))
    channel.start()
    log = logging.getLogger("touchdown")
    log.setLevel(logging.INFO)
    log.addHandler(_ForwardingHandler(say))
    try:
        _run_cycles(host, parent)
    finally:
        _end(host)
    return 0


class _ForwardingHandler(logging.Handler):
    """Sends log records to the backend, which owns the log file."""

    def __init__(self, say: Callable[[Message], bool]) -> None:
        super().__init__()
        self._say = say

    def emit(self, record: logging.LogRecord) -> None:
        self._say({"kind": "log", "level": record.levelno, "text": record.getMessage()})


def _hello(devices: Devices, *, realtime: bool) -> Message:
    arm = devices.arm
    ranges = [list(pair) for pair in arm.joint_limits_rad] if arm.rotates else []
    return {
        "kind": "hello",
        "pid": os.getpid(),
        "python": sys.version.split()[0],
        "realtime": realtime,
        "joint_ranges": ranges,
    }


def _run_cycles(host: RigHost, parent: ParentProcess) -> None:
    """Run a cycle every ``ROUND_S`` until one ends the process; missed cycles are skipped."""
    never = threading.Event()
    deadline_s = time.monotonic()
    while True:
        if parent.gone():
            host.abandon()
        if host.round():
            return
        deadline_s = max(deadline_s + ROUND_S, time.monotonic())
        never.wait(deadline_s - time.monotonic())


def _end(host: RigHost) -> None:
    """Stop, wait for the end packets of the stream and for closing jaws, then close the devices
    that answer. A device that is being connected is closed afterwards: no device is used by two
    threads.
    """
    host.leave()
    host.devices.arm.stop()
    closing, end_s = host.orders.stop_gripper(), time.monotonic() + CLOSING_S
    threading.Event().wait(END_S)
    while closing is not None and not closing.done and time.monotonic() < end_s:
        threading.Event().wait(END_S)

    def close(name: str) -> None:
        if host.workers.idle(name, FAREWELL_S):
            host.devices.named()[name].close()

    names = host.devices.named()
    farewells = [threading.Thread(target=close, args=(n,), daemon=True) for n in names]
    for farewell in farewells:
        farewell.start()
    end_s = time.monotonic() + FAREWELL_S
    for farewell in farewells:
        farewell.join(max(0.0, end_s - time.monotonic()))


if __name__ == "__main__":
    code = main()
    sys.stderr.flush()
    # Threads that wait for a pipe or a wire must not keep the process alive.
    os._exit(code)
