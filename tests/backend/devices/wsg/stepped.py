"""The WSG driver's core and the emulated gripper on a hand-wound clock, in either protocol."""

from touchdown.backend.config.hardware import WsgSettings
from touchdown.backend.devices.wsg.driver import WsgCore
from touchdown.backend.devices.wsg.emulator import EmulatedGcl, EmulatedWsg
from touchdown.backend.devices.wsg.gcl import GclProtocol
from touchdown.backend.devices.wsg.protocol import BinaryProtocol
from touchdown.backend.emulation.fault_plan import Faults

PART_MM = 40.0


class Bench:
    """Core, language and gripper on one clock; what was asked is kept in ``sent``, in order."""

    def __init__(self, part_mm=PART_MM, homed=True, **settings):
        self.now_s = 0.0
        self.faults = Faults("gripper")
        self.faults.begin(0.0)
        wsg = WsgSettings(**settings)
        self.gripper = EmulatedWsg(part_mm=part_mm, faults=self.faults)
        self.core, self.text = WsgCore(wsg), wsg.protocol == "gcl"
        self.language = GclProtocol(wsg) if self.text else BinaryProtocol()
        self.mouth = EmulatedGcl(self.gripper, wsg) if self.text else self.gripper
        self.sent, self.said, self.deaf = [], [], False
        self.damage = bytes
        self.send(self.core.subscribe(0.0))
        if homed:
            self.end(self.order(self.core.home))

    def send(self, requests):
        for request in requests:
            self.sent.append(request)
            self.say(self.language.encode([request]))

    def say(self, content):
        if content:
            self.said.append(content)
        # What the language answers itself is heard even without a wire.
        self.hear(b"" if self.deaf or not content else self.mouth.receive(self.now_s, content))

    def hear(self, data):
        for reply in self.language.take(self.damage(data)):
            self.send(self.core.feed(self.now_s, reply))

    def advance(self, seconds):
        for _ in range(round(seconds / 0.01)):
            self.now_s += 0.01
            if not self.deaf:
                for message in self.faults.outgoing(self.now_s, [self.mouth.due(self.now_s)]):
                    self.hear(message)
            self.say(self.language.due(self.now_s))
            self.send(self.core.tick(self.now_s))

    def order(self, begin, *args):
        requests = begin(self.now_s, *args)
        motion = self.core.motion
        self.send(requests)
        return motion

    def end(self, motion, limit_s=30.0):
        until_s = self.now_s + limit_s
        while not motion.done:
            assert self.now_s < until_s
            self.advance(0.01)
        return motion

    def held(self):
        self.end(self.order(self.core.grip, 10.0)).result()
        return self.core.status
