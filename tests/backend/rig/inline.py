"""A session whose arm, gripper and wrist sensor live in a rig in this process, on a hand-wound
clock: the driver of an emulated arm, with the simulated world behind it."""

import io
import itertools
import threading
from contextlib import ExitStack
from dataclasses import replace

from tests.backend.devices.melfa.emulated_arm import on_bench
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core import FaultError, SampleStream
from touchdown.backend.devices.melfa.force_program import PLACE_LATE_S
from touchdown.backend.rig.host import Devices, RigHost
from touchdown.backend.rig.link import LATE_S, NOT_STARTED, RigMotion
from touchdown.backend.rig.memory import BACKEND_BEAT, STOPS, drop, make
from touchdown.backend.rig.messages import pack, read_error, read_fault, receive
from touchdown.backend.rig.remote_devices import RigArm, RigForceTorque, RigGripper

ROUND_US = 4000


def through_json(message):
    """What the other side reads of ``message``."""
    return receive(io.BytesIO(pack(message)))


class InlineLink:
    """Stands in for the pipe: every order is carried out where it is given."""

    lost = None

    def __init__(self, interlock, devices, now_s):
        self._interlock, self._numbers = interlock, itertools.count(1)
        self._answers, self._motions, self._cursors = {}, {}, [0, 0]
        self._stops = self._faults = 0
        self._rows = {}
        self.refused, self.hello = [], {"joint_ranges": [[-3.0, 3.0]] * 6}
        self.memory, path = make()
        drop(path)
        self.host = RigHost(devices, interlock.limits, now_s, self.memory, self._hear)
        self.samples, self.poses = SampleStream("wrench", 6, 8192), SampleStream("arm", 3, 8192)
        self.running = False

    def start(self):
        self.running = True

    def close(self):
        self.running = False

    def settle(self):
        self._cursors[1] = self.memory.poses.count
        self.poses.clear()

    def round(self):
        self.memory.beat(BACKEND_BEAT)
        self.memory.permit(self._interlock.lease_until_s)
        self.host.round()
        pairs = ((self.memory.wrench, self.samples), (self.memory.poses, self.poses))
        for k, (ring, stream) in enumerate(pairs):
            t_s, values, self._cursors[k] = ring.since(self._cursors[k])
            # Where the rig's own stream is that of the session, nothing has to be copied.
            if len(t_s) and stream is not self.host.devices.samples:
                stream.put(t_s, values)

    def order(self, name, **arguments):
        if not self.running:
            raise FaultError(NOT_STARTED)
        if not self._interlock.latched:
            told = {"kind": "reset", "stops": self._stops, "faults": self._faults}
            self.host.take(through_json(told))
        number = next(self._numbers)
        order = {"kind": "order", "id": number, "order": name, "args": arguments}
        lease = {"lease_until_s": self._interlock.lease_until_s}
        self.host._carry_out(through_json({**order, **lease}))
        answer = self._answers.pop(number)
        if "error" in answer:
            error = read_error(answer["error"])
            self.refused.append(str(error))
            raise error
        return answer

    def move(self, name, **arguments):
        answer = self.order(name, **arguments)
        return self._motions.setdefault(answer["motion"], RigMotion(answer["sent"]))

    def stop(self):
        if self.running:
            self._stops += 1
            self.memory.beat(STOPS)
            self.host.take({"kind": "stop", "stops": self._stops})

    def say(self, kind):
        self.host.take({"kind": kind})

    def row(self, device):
        # While a state is being written the last one counts.
        self._rows = self.memory.seen() or self._rows
        return self._rows.get(device, {})

    def _hear(self, message):
        message = through_json(message)
        if message["kind"] == "reply":
            self._answers[message["id"]] = message
        elif message["kind"] == "fault":
            self._faults = message["number"]
            self._interlock.raise_fault(read_fault(message["fault"]))
        elif (motion := self._motions.get(message["motion"])) is not None:
            motion.detected_s, motion.onset_s = message["detected_s"], message["onset_s"]
            if message["kind"] == "ended":
                del self._motions[message["motion"]]
                motion.end(read_fault(message["fault"]))
        return True


class InlineBench:
    """Holds the session; ``links`` are those of its scenes, ``mode`` the stiffness mode."""

    def __init__(self, method=None, mode="software"):
        self._mode, self.links, self._ends = mode, [], ExitStack()
        self.session = simulated_session(method=method)
        self._make_simulated = self.session._make_stage
        self.session._make_stage = self._make_stage

    def close(self):
        self.session.close()
        self._ends.close()

    def _make_stage(self, choice, raw):
        # The poses come from the driver.
        unused = SampleStream("unused", 3, 1000)
        stage = self._make_simulated(choice, replace(raw, poses=unused))
        bench, now_s = stage.scoring.bench, stage.clock.now_s
        for device in (bench.force_torque, bench.gripper):
            device.connect(1.0, threading.Event())
        driver, wires = on_bench(bench, stiffness_mode=self._mode)
        driver.connect(1.0, threading.Event())
        devices = Devices(driver, bench.gripper, bench.force_torque, raw.samples, driver.poses)
        link = InlineLink(self.session.interlock, devices, now_s)
        link.samples, link.poses = raw.samples, raw.poses
        link.start()
        wires.meanwhile = link.round
        self.links.append(link)
        self._ends.callback(link.host.leave)

        def advance(step_us):
            for _ in range(step_us // ROUND_US):
                wires.advance(ROUND_US)
                link.round()

        advance(5 * ROUND_US)
        open_ones = {"arm", "gripper", "force_torque"}
        arm = RigArm("arm", link, now_s, open_ones)
        arm.place_late_s = PLACE_LATE_S if self._mode == "controller" else 0.0
        gripper = RigGripper("gripper", link, now_s, open_ones)
        wrist = RigForceTorque("force_torque", link, now_s, open_ones)
        named = {**bench.devices, "arm": arm, "gripper": gripper, "force_torque": wrist}
        return replace(
            stage, devices=named, arm=arm, gripper=gripper, advance=advance, wrench_late_s=LATE_S
        )
