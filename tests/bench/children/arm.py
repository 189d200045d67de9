"""Child of the arm's figures: the emulated controller, or the driver.

``emulate`` prints the ports and serves until its input ends. ``drive PORTS SECONDS LOAD PRIORITY``
streams beside so many busy threads of this process and prints its cycle times.
"""

import contextlib
import json
import sys
import threading
import time

import numpy as np

from tests.backend.devices.melfa.emulated_arm import settings
from touchdown.backend.config.hardware import MelfaSettings
from touchdown.backend.core import FaultError, Pose, SampleStream
from touchdown.backend.devices.melfa import READY_RAD, EmulatedMelfa, MelfaServer
from touchdown.backend.devices.melfa.driver import MelfaArm, MelfaPrograms
from touchdown.backend.devices.melfa.sockets import SocketLinks

UP, DOWN = Pose(0.0, 0.0, 120.0), Pose(0.0, 0.0, 60.0)
SPEED_MM_S = 20.0


def front() -> MelfaServer:
    """Return an emulated controller that waits longer than any stall of a shared machine."""
    wanted = settings(servo_delay_s=0.05, mxt={"mxttout": 2000})
    start = MelfaPrograms(wanted).placing.joints(np.array([0.0, 0.0, 60.0]), READY_RAD)
    return MelfaServer(EmulatedMelfa(wanted, start_rad=start))


def driver(wanted: MelfaSettings) -> MelfaArm:
    wires = SocketLinks(wanted, time.monotonic)
    arm = MelfaArm(wires, SampleStream("force_torque", 6, 1000), wanted, time.monotonic)
    arm.connect(10.0, threading.Event())
    return arm


def emulate() -> None:
    served = front()
    served.start()
    sys.stdout.write(served.settings.model_dump_json() + "\n")
    sys.stdout.flush()
    sys.stdin.read()
    served.close()


def burn(stop: threading.Event) -> None:
    """Keep the interpreter busy with plain Python, as drawing and bookkeeping do."""
    numbers = list(range(2000))
    while not stop.is_set():
        sum(number * number for number in numbers)


def drive(wanted: MelfaSettings, seconds: float, load: int, priority: int) -> None:
    wanted = wanted.model_copy(update={"realtime_priority": priority})
    stop = threading.Event()
    busy = [threading.Thread(target=burn, args=(stop,)) for _ in range(load)]
    arm = driver(wanted)
    for thread in busy:
        thread.start()
    begun = arm._wires.times
    until_s, goals = time.monotonic() + seconds, [UP, DOWN]
    # After a fault the owner of the wire goes on waking: its times are what is measured.
    while time.monotonic() < until_s:
        with contextlib.suppress(FaultError):
            goals.reverse()
            motion = arm.move_to(goals[0], SPEED_MM_S)
            while not motion.done and time.monotonic() < until_s:
                stop.wait(0.05)
        stop.wait(0.05)
    ended, holds = arm._wires.times, arm._core.holds
    stop.set()
    for thread in busy:
        thread.join()
    arm.close()
    found = {
        "wakes": ended.wakes - begun.wakes,
        "late": ended.late - begun.late,
        "latest_ms": 1e3 * ended.latest_s,
        "holds": holds,
        "realtime": ended.realtime,
        "fault": arm.fault.code if arm.fault else "",
    }
    sys.stdout.write(json.dumps(found) + "\n")


def main(arguments: list[str]) -> None:
    if arguments[0] == "emulate":
        emulate()
    elif arguments[0] == "burn":
        stop = threading.Event()
        for _ in range(int(arguments[1])):
            threading.Thread(target=burn, args=(stop,), daemon=True).start()
        sys.stdin.read()
        stop.set()
    else:
        wanted = MelfaSettings.model_validate_json(arguments[1])
        drive(wanted, float(arguments[2]), int(arguments[3]), int(arguments[4]))


if __name__ == "__main__":
    main(sys.argv[1:])
