"""One contract for every gripper: the simulated one, and the WSG over a real socket.

The WSG in both of its protocols, binary and text, and behind the link of a rig.
"""

import threading
import time
from functools import partial

import pytest

from tests.backend.devices.waiting import until
from tests.backend.rig.ticking import TickingRig, rounds_pass
from touchdown.backend.config.hardware import HardwareSettings, WsgSettings
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core.faults import FaultError, RefusedError
from touchdown.backend.devices.factories import make_gripper
from touchdown.backend.devices.interlock import ByHand
from touchdown.backend.devices.leptrino.emulator import EmulatedLeptrino
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.devices.wsg.driver import WsgGripper
from touchdown.backend.devices.wsg.emulator import EmulatedGcl, EmulatedWsg, GripperProfile
from touchdown.backend.devices.wsg.protocol import SystemFlag
from touchdown.backend.emulation.fault_plan import Faults
from touchdown.backend.emulation.server import TcpServer
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.geometry.tower import Tower
from touchdown.backend.simulation.devices.bench import SimulatedBench
from touchdown.backend.simulation.scene import Scene

PART_MM = 30.0


class Simulated:
    """The gripper of the simulated bench; its time is wound by hand."""

    def __init__(self):
        catalogue = load_pieces()
        bottoms = Tower((catalogue.bottom("short").body(),))
        settings = SimulationSettings(preset="mixed")
        self.bench = SimulatedBench(Scene(catalogue.top("pot"), bottoms, (6.0, 3.0), 11, settings))
        self.gripper = self.bench.gripper

    told = staticmethod(lambda: None)
    """Waits until what has just happened is told."""
    senseless = ValueError

    def connect(self):
        self.gripper.connect(1.0, threading.Event())
        self.rest(0.05)

    def let_go(self, width_mm):
        return self.gripper.open_to(width_mm, 20.0)

    def rest(self, seconds):
        self.bench.advance(round(seconds * 1e6))

    def close(self):
        self.gripper.close()


class OverTheWire:
    """A homed WSG driver and its emulated gripper with a piece between the jaws."""

    def __init__(self, **settings):
        faults = Faults("gripper")
        wsg = WsgSettings(**settings)
        self.emulated = EmulatedWsg(
            GripperProfile(stroke_mm=40.0), PART_MM, faults, keeps_grip=wsg.keeps_grip_after_07
        )
        text = wsg.protocol == "gcl"
        mouth = EmulatedGcl(self.emulated, wsg) if text else self.emulated
        self.front = TcpServer(mouth, faults=faults)
        host, port = self.front.address
        wsg = wsg.model_copy(update={"host": host, "port": port})
        self.gripper = make_gripper(HardwareSettings(wsg=wsg), time.monotonic)
        self.front.start()

    told = staticmethod(lambda: None)
    senseless = ValueError

    def connect(self):
        self.gripper.connect(2.0, threading.Event())
        if not self.gripper.homed:
            self.finish(self.gripper.home())
        until(lambda: self.gripper.status().width_mm > 0)

    def let_go(self, width_mm):
        return self.gripper.open_to(width_mm, 20.0)

    def finish(self, motion):
        until(lambda: motion.done)

    def rest(self, seconds):
        threading.Event().wait(seconds)

    def close(self):
        self.gripper.close()
        self.front.close()


class OverTheLink(OverTheWire):
    """The same driver inside a rig."""

    told = staticmethod(rounds_pass)
    senseless = (ValueError, RefusedError)

    def __init__(self):
        super().__init__()
        self._driver = self.gripper
        self._rig = TickingRig(time.monotonic, gripper=self._driver)
        self.gripper = self._rig.gripper

    def let_go(self, width_mm):
        # Behind a rig a piece is let go by a right only.
        with pytest.raises(RefusedError, match="by a right only"):
            super().let_go(width_mm)
        return self.gripper.open_held(ByHand(confirmed=True), width_mm, 20.0)

    def close(self):
        super().close()
        self._rig.close()


BINARY, TEXT = OverTheWire, partial(OverTheWire, protocol="gcl", stroke_mm=40.0)
WIRED = {"wsg": BINARY, "wsg text": TEXT, "wsg over the link": OverTheLink}
EVERY = {"simulated": Simulated, **WIRED}


@pytest.fixture(params=EVERY.values(), ids=EVERY.keys())
def bench(request):
    made = request.param()
    yield made
    made.close()


@pytest.fixture(params=WIRED.values(), ids=WIRED.keys())
def wired(request):
    made = request.param()
    yield made
    made.close()


def finish(bench, motion):
    wait(bench, lambda: motion.done)


def wait(bench, condition):
    end_s = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end_s, "it does not come"
        bench.rest(0.01)


def test_it_opens_and_closes_any_number_of_times_and_refuses_while_closed(bench):
    gripper = bench.gripper
    assert gripper.name == "gripper"
    for _ in range(2):
        assert gripper.state is DeviceState.CLOSED
        for command in (lambda: gripper.grip(10.0), lambda: gripper.open_to(20.0, 10.0)):
            with pytest.raises(FaultError):
                command()
        bench.connect()
        gripper.connect(1.0, threading.Event())
        assert gripper.state is DeviceState.READY
        assert gripper.identity.serial
        assert gripper.describe()
        gripper.close()
        gripper.close()


def test_it_takes_the_piece_holds_it_with_the_force_and_lets_it_go(bench):
    bench.connect()
    wide = bench.gripper.status()
    grip = bench.gripper.grip(10.0)
    assert grip.sent == {"force_n": 10.0}
    with pytest.raises(ValueError, match="under way"):
        grip.result()
    finish(bench, grip)
    grip.result()
    # Through a rig what it tells may be a moment older than the end of the motion.
    wait(bench, lambda: abs(bench.gripper.status().force_n - 10.0) <= 1.5)
    held = bench.gripper.status()
    assert held.holding
    assert held.width_mm < wide.width_mm
    opening = bench.let_go(held.width_mm + 4.0)
    finish(bench, opening)
    opening.result()
    assert not bench.gripper.status().holding
    assert bench.gripper.status().width_mm == pytest.approx(held.width_mm + 4.0, abs=0.1)


def test_stop_is_legal_in_every_state_and_ends_a_grip(bench):
    bench.gripper.stop()
    bench.connect()
    bench.gripper.stop()
    grip = bench.gripper.grip(10.0)
    bench.rest(0.05)
    bench.gripper.stop()
    bench.told()
    assert grip.done
    with pytest.raises(FaultError):
        grip.result()
    assert not bench.gripper.status().holding
    bench.gripper.close()
    bench.gripper.stop()


def test_stop_and_close_keep_a_grip_that_stands(bench):
    bench.connect()
    finish(bench, bench.gripper.grip(10.0))
    bench.gripper.stop()
    bench.rest(0.1)
    assert bench.gripper.status().holding
    bench.gripper.close()
    bench.connect()
    bench.rest(0.1)
    assert bench.gripper.status().holding


def test_a_newer_command_ends_the_older_one(bench):
    bench.connect()
    first = bench.gripper.grip(10.0)
    bench.rest(0.02)
    second = bench.gripper.open_to(38.0, 50.0)
    bench.told()
    with pytest.raises(FaultError):
        first.result()
    finish(bench, second)
    second.result()


@pytest.mark.promise("P1")
@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_senseless_numbers_are_refused(bench, bad):
    bench.connect()
    for command in (lambda: bench.gripper.grip(bad), lambda: bench.gripper.open_to(20.0, bad)):
        with pytest.raises(bench.senseless, match=r"finite|positive"):
            command()


@pytest.mark.promise("G2")
def test_a_link_lost_while_holding_waits_for_the_operator(wired):
    wired.connect()
    finish(wired, wired.gripper.grip(10.0))
    wired.front.inject("unplug", 0.05)
    until(lambda: wired.gripper.state is DeviceState.FAULT)
    assert wired.gripper.fault.code == "WSG-LINK"
    with pytest.raises((FaultError, RefusedError)):
        wired.gripper.open_to(38.0, 50.0)
    until(lambda: not wired.front.faults.names(time.monotonic()))

    def back():
        try:
            wired.gripper.connect(2.0, threading.Event())
        except FaultError:
            return False
        return True

    until(back)
    assert wired.gripper.fault.code == "WSG-FAST-STOP"
    with pytest.raises(FaultError):
        wired.gripper.grip(10.0)
    # Nothing was asked of the jaws by coming back either.
    assert wired.emulated.barred == 0
    assert wired.emulated.jaws.motion is None
    wired.gripper.acknowledge()
    until(lambda: wired.gripper.state is DeviceState.READY)
    finish(wired, wired.gripper.grip(10.0))
    assert wired.gripper.status().holding


@pytest.mark.promise("G1")
def test_readings_go_on_and_a_lost_piece_is_seen(wired):
    wired.connect()
    finish(wired, wired.gripper.grip(10.0))
    before = wired.gripper.health.received
    until(lambda: wired.gripper.health.received > before + 5)
    wired.emulated.jaws.part_mm = None
    until(lambda: not wired.gripper.status().holding)
    until(lambda: wired.gripper.describe()["lost_parts"] == 1)
    assert wired.gripper.state is DeviceState.READY


@pytest.mark.promise("S5")
def test_another_device_is_refused_by_name():
    front = TcpServer(EmulatedLeptrino(lambda now_s: (0.0,) * 6))
    front.start()
    gripper = WsgGripper(*front.address, WsgSettings(), time.monotonic)
    words = "This is a Leptrino force/torque sensor, expected a WSG gripper"
    with pytest.raises(FaultError, match=words):
        gripper.connect(1.0, threading.Event())
    assert gripper.state is DeviceState.CLOSED
    front.close()


def test_nobody_there_is_a_fault():
    gripper = WsgGripper("127.0.0.1", 1, WsgSettings(), time.monotonic)
    with pytest.raises(FaultError, match="cannot be reached"):
        gripper.connect(1.0, threading.Event())


@pytest.mark.parametrize("protocol", ["binary", "gcl"])
def test_a_gripper_that_lets_go_after_a_goodbye_is_left_without_one(protocol):
    wired = OverTheWire(protocol=protocol, stroke_mm=40.0, keeps_grip_after_07=False)
    wired.connect()
    finish(wired, wired.gripper.grip(10.0))
    wired.gripper.close()
    until(lambda: SystemFlag.FAST_STOP in wired.emulated.jaws.flags)
    wired.gripper.connect(2.0, threading.Event())
    assert wired.gripper.fault.code == "WSG-FAST-STOP"
    wired.gripper.acknowledge()
    until(lambda: wired.gripper.state is DeviceState.READY)
    wired.gripper.close()
    assert SystemFlag.FAST_STOP not in wired.emulated.jaws.flags
    wired.close()
