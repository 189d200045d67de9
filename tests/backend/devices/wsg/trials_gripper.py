"""One order to a gripper and one fault at a random instant, on a hand-wound clock."""

import random

from tests.backend.devices.trials import Ended
from tests.backend.devices.wsg.stepped import Bench
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.wsg import gcl, protocol
from touchdown.backend.devices.wsg.driver import link_fault
from touchdown.backend.devices.wsg.protocol import GraspState, SystemFlag, WsgCommand, WsgRequest

MOTIONS = {WsgCommand.HOME, WsgCommand.PREPOSITION, WsgCommand.GRASP, WsgCommand.RELEASE}
OPENING = {WsgCommand.PREPOSITION, WsgCommand.RELEASE}
CALLS = {
    "HOME": WsgCommand.HOME,
    "MOVE": WsgCommand.PREPOSITION,
    "GRIP": WsgCommand.GRASP,
    "RELEASE": WsgCommand.RELEASE,
}
WIRE = ("lost", "flip", "garbage", "cut", "duplicate", "late")
KINDS = (*WIRE, "silent", "mute", "unplug", "part_lost", "fast_stop", "power", "stop", "closed")
CODES = {
    "mute": {"WSG-LINK"},
    "unplug": {"WSG-LINK"},
    "fast_stop": {"WSG-FAST-STOP"},
    "power": {"WSG-DEVICE"},
}
SILENT_S, MUTE_S = 1.0, 3.5  # shorter, and longer, than what means a lost link


class GripperTrial:
    """Draws everything from ``seed``."""

    def __init__(self, seed: int) -> None:
        self.seed, self.rng = seed, random.Random(seed)
        self.protocol = self.rng.choice(("binary", "gcl"))
        self.bench = Bench(protocol=self.protocol)
        self.commanded: list[tuple[float, WsgCommand]] = []
        self._listen()
        self.barred_s = float("inf")

    def run(self) -> Ended:
        """Order, break, wait, and look."""
        bench = self.bench
        doing = self.rng.choice(("grip", "hold", "open"))
        if doing != "open":
            bench.order(bench.core.grip, 10.0)
        if doing == "hold":
            bench.advance(3.0)
        if doing == "open":
            bench.order(bench.core.open_to, self.rng.uniform(45.0, 60.0), 20.0)
        bench.advance(self.rng.uniform(0.0, 0.5))
        fault = self.rng.choice(KINDS)
        held = bench.gripper.jaws.state is GraspState.HOLDING
        ordered = len(self.commanded)
        self._break(fault)
        broken = self._broken(fault, held, ordered)
        return Ended(self.seed, f"{self.protocol} {doing}", fault, tuple(broken))

    def _listen(self) -> None:
        """Write down every motion that the gripper is really told, from its own bytes."""
        receive, text = self.bench.mouth.receive, self.protocol == "gcl"
        decoder = gcl.lines() if text else protocol.requests()

        def heard(now_s: float, data: bytes) -> bytes:
            for said in decoder.feed(data):
                command = _motion(said)
                if command is not None:
                    self.commanded.append((now_s, command))
            return receive(now_s, data)

        self.bench.mouth.receive = heard

    def _break(self, fault: str) -> None:
        bench = self.bench
        if fault in (*WIRE, "silent"):
            share = 1.0 if fault == "silent" else 0.3
            bench.faults.inject(bench.now_s, fault, SILENT_S, share=share)
        elif fault == "mute":
            bench.deaf = True
            bench.advance(MUTE_S)
            self.barred_s = bench.now_s
        elif fault in ("part_lost", "fast_stop", "power"):
            bench.faults.inject(bench.now_s, fault, 0.3)
            bench.advance(0.3)
            self.barred_s = bench.now_s if fault != "part_lost" else float("inf")
        elif fault == "unplug":
            bench.mouth.closed(bench.now_s)
            bench.deaf = True
            bench.core.latch(link_fault("The connection to the gripper is lost."))
            self.barred_s = bench.now_s
        elif fault == "stop":
            bench.send(bench.core.stop())
        elif fault == "closed":
            bench.send(bench.core.stop())
            bench.send([WsgRequest(WsgCommand.DISCONNECT)])
            bench.mouth.closed(bench.now_s)
            bench.deaf = True
            self.barred_s = bench.now_s
        bench.advance(6.0)

    def _broken(self, fault: str, held: bool, ordered: int) -> list[str]:
        bench, core = self.bench, self.bench.core
        codes = CODES.get(fault, set())
        code = core.fault.code if core.fault else ""
        later = self.commanded[ordered:]
        jaws = bench.gripper.jaws
        rows = {
            f"fault {code}": code in codes if codes else code in self._allowed(fault),
            "a motion that never ends": core.motion is None,
            "a motion while it is barred": all(t_s <= self.barred_s for t_s, _ in later),
            "a motion that nobody ordered": len(later) == 0 or fault in WIRE,
            "it opens by itself": not held or not OPENING & {command for _, command in later},
            "an order is taken in a fault": not code or _refuses(bench),
        }
        if fault in (*WIRE, "silent", "stop"):
            told = core.status
            rows["the width told is another"] = abs(told.width_mm - jaws.width_mm) < 0.2
            rows["the grip told is another"] = told.holding == (jaws.state is GraspState.HOLDING)
        if fault == "part_lost" and held:
            rows["the lost piece is not told"] = core.lost_parts == 1 and not core.status.holding
        if fault == "closed":
            rows["a fast stop after a goodbye"] = SystemFlag.FAST_STOP not in jaws.flags
        if fault == "unplug":
            rows["no fast stop after a torn wire"] = SystemFlag.FAST_STOP in jaws.flags
        return [name for name, holds in rows.items() if not holds]

    def _allowed(self, fault: str) -> set[str]:
        """A line of text carries no checksum: a flipped bit may look like any flag."""
        if self.protocol == "gcl" and fault == "flip":
            return {"", "WSG-FAST-STOP", "WSG-DEVICE"}
        return {"", "WSG-LINK"} if fault == "closed" else {""}


def _motion(said: object) -> WsgCommand | None:
    if isinstance(said, WsgRequest) and said.command in MOTIONS:
        return WsgCommand(said.command)
    if isinstance(said, gcl.GclCall):
        return CALLS.get(said.command)
    return None


def _refuses(bench: Bench) -> bool:
    before = len(bench.sent)
    try:
        bench.core.grip(bench.now_s, 10.0)
    except FaultError:
        return len(bench.sent) == before
    return False


def trial(seed: int) -> Ended:
    """Run one."""
    return GripperTrial(seed).run()
