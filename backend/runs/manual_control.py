"""Control of an idle bench: jog, grip, zero, preconditions of a run, stop button."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress

from touchdown.backend import core
from touchdown.backend.devices import (
    Device,
    DeviceState,
    Interlock,
    Jog,
    JogSurroundings,
    Motion,
    RobotMode,
)
from touchdown.backend.rig import BenchConnection, fault_of
from touchdown.backend.runs.bench import Bench
from touchdown.backend.runs.requests import Request, StackRequest

REFERENCE_FRAMES = 10
REFERENCE_S = 2.0
CLEAR_MM = 10.0  # manual opening beyond the present width
OPEN_MM_S = 5.0
WAITING = 4  # queue length of sensing orders


class ManualControl:
    """Manual control of one scene. ``tick`` is called once per bench step."""

    def __init__(
        self,
        scene: Bench,
        interlock: Interlock,
        around: JogSurroundings,
        publish: Callable[[core.Event], None],
    ) -> None:
        self._scene, self._interlock, self._around = scene, interlock, around
        self._publish = publish
        self._orders: deque[tuple[Callable[[], str], float]] = deque(maxlen=WAITING)
        self._grip: Motion | None = None
        self._switch: threading.Thread | None = None
        self.jog: Jog = Jog(scene.arm, interlock, around, self._refused)

    @property
    def active(self) -> bool:
        """True if something moves under manual control."""
        gripping = self._grip is not None and not self._grip.done
        return self.jog.active or gripping or self.switching

    @property
    def switching(self) -> bool:
        """True if the servo is being switched."""
        return self._switch is not None and self._switch.is_alive()

    @property
    def powered(self) -> bool:
        """True if the motors of the arm are on."""
        return self._scene.arm.status().robot_mode is not RobotMode.SERVO_OFF

    @property
    def holding(self) -> bool:
        """True if a piece is held."""
        return self._scene.gripper.status().holding

    @property
    def pressing_n(self) -> float:
        """Press force of the held piece, N; 0 without contact.

        Without a piece the tare still includes its weight, so the wrench is no contact force.
        """
        press_n = self._around.press_n() if self.holding else 0.0
        return press_n if press_n > self._interlock.limits.contact_n else 0.0

    @property
    def surface_mm(self) -> float:
        """Height of ``G`` at which a held piece touches the support; NaN if unknown."""
        return self._around.surface_mm()

    @property
    def rotates(self) -> bool:
        """True if the hand can rotate and single joints can be driven."""
        return self._scene.arm.rotates

    def refuse_turned(self) -> None:
        """Raise ``RefusedError`` if the hand is rotated: a probe needs a level face."""
        with suppress(core.StaleSampleError):
            core.require_unrotated(core.pose_rotation(self._scene.arm.pose(max_age_s=1.0)))

    # -- from any thread --------------------------------------------------------------------------

    def grip(self, force_n: float) -> None:
        """Close with ``force_n`` per finger; raises ``RefusedError``."""
        self._take()
        self._grip = self._scene.gripper.grip(force_n)

    def open(self, *, confirmed: bool) -> None:
        """Open the gripper; raises ``RefusedError``, "HOLDING" on a held piece unless confirmed."""
        self._take()
        status, press_n = self._scene.gripper.status(), self._around.press_n()
        self._grip = self._scene.gripper.open_by_hand(
            status.width_mm + CLEAR_MM, OPEN_MM_S, confirmed=confirmed
        )
        if status.holding:
            text = f"Opened by the operator on a held piece at {press_n:.1f} N of press force."
            self._publish(core.Said(self._around.now_s(), text))

    def servo(self, on: bool) -> None:
        """Switch the motors on a separate thread; raises ``RefusedError``."""
        if self._around.busy():
            raise core.RefusedError("BUSY", "A run is in progress: cancel it first.")
        if self.switching:
            raise core.RefusedError("MOVING", "The servo is being switched.")
        if on:
            self._interlock.refuse_latched()
        self._switch = threading.Thread(
            target=self._switch_servo, args=(on,), name="servo", daemon=True
        )
        self._switch.start()

    def zero_wrench(self) -> None:
        """Take a new tare, at rest in air."""
        self._order(self._zero, 0.0)

    def take_references(self) -> None:
        """Take new tactile references, at rest in air.

        Retries for ``REFERENCE_S`` while a marker is hidden.
        """
        self._order(self._reference, REFERENCE_S)

    # -- on the bench's own time ------------------------------------------------------------------

    def tick(self) -> None:
        """Process the jog lease, the end of a grip, and queued sensing orders."""
        lock = self._interlock
        if lock.recovering and abs(self._around.press_n()) <= lock.limits.contact_n:
            lock.recovering = False  # the wrist is free of contact
        self.jog.tick()
        if self._grip is not None and self._grip.done:
            self._grip = None
        if self._around.busy():
            self._orders.clear()
        while self._orders:
            order, until_s = self._orders.popleft()
            try:
                text = order()
            except core.RefusedError as error:
                if self._around.now_s() < until_s:
                    self._orders.appendleft((order, until_s))
                    return
                self._refused(error)
            except core.FaultError as error:
                self._refused(core.RefusedError(error.fault.code, error.fault.what))
            else:
                self._publish(core.Said(self._around.now_s(), text))

    # -- inside -----------------------------------------------------------------------------------

    def _take(self) -> None:
        """Raise ``RefusedError`` while something else moves, else renew the lease."""
        if self._around.busy():
            raise core.RefusedError("BUSY", "A run is in progress: cancel it first.")
        if self.active:
            raise core.RefusedError("MOVING", "Wait until the last motion has ended.")
        self._interlock.renew_lease(self._around.now_s())

    def _order(self, order: Callable[[], str], for_s: float) -> None:
        if self._around.busy():
            raise core.RefusedError("BUSY", "A run takes its own tare and references.")
        if len(self._orders) == WAITING:
            raise core.RefusedError("WAITING", "Earlier commands are still waiting.")
        self._orders.append((order, self._around.now_s() + for_s))

    def _zero(self) -> str:
        self._scene.sensing.zero_wrench(self._around.now_s())
        return "Force and moment are zeroed."

    def _reference(self) -> str:
        self._scene.sensing.take_references(REFERENCE_FRAMES)
        return "New tactile references are taken."

    def _switch_servo(self, on: bool) -> None:
        try:
            self._scene.arm.servo(on)
        except core.FaultError as error:
            self._refused(core.RefusedError(error.fault.code, error.fault.what))
        except core.RefusedError as error:
            self._refused(error)
        else:
            self._publish(core.Said(self._around.now_s(), f"The servo is {'on' if on else 'off'}."))

    def _refused(self, error: core.RefusedError) -> None:
        self._publish(core.Refused(self._around.now_s(), error.reason, error.detail))


def check_devices(connection: BenchConnection | None, request: Request) -> None:
    """Raise ``RefusedError`` for simulation-only requests on devices or a missing device.

    ``connection`` is None on benches whose scenes bring their own devices.
    """
    if connection is None:
        return
    refuse_simulated_only(request)
    if missing := connection.missing():
        names = ", ".join(missing)
        raise core.RefusedError("NOT-CONNECTED", f"Not connected: {names}. Connect first (Ctrl+L).")


def refuse_simulated_only(request: Request) -> None:
    """Raise ``RefusedError`` for a request that devices never run."""
    if isinstance(request, StackRequest) and request.strategy == "pick-and-place":
        raise core.RefusedError(
            "SIMULATED-ONLY", "A release without a test is for simulations only."
        )


def check_connected(
    connection: BenchConnection, names: Sequence[str] = (), *, homes: bool = False
) -> None:
    """Raise the first fault of a device, or the step its operator has to do first.

    ``names`` are the devices (empty: all); with ``homes`` the gripper is homed later.
    """
    wanted = names or tuple(connection.devices)
    for line in (line for line in connection.lines() if line.name in wanted):
        if line.fault is not None:
            raise core.FaultError(line.fault)
        if line.needs == "home" and not homes:
            raise core.RefusedError(
                "NOT-HOMED",
                "The gripper does not know where its jaws are: empty them, then home it (--home).",
            )
        if line.needs == "acknowledge":
            raise core.RefusedError(
                "FAST-STOP", "The gripper waits for an acknowledgement: see the Connect panel."
            )
    if connection.trouble is not None:
        raise connection.trouble
    if missing := [name for name in connection.missing() if name in wanted]:
        raise core.RefusedError("NOT-CONNECTED", f"Not connected: {', '.join(missing)}.")


def check_no_contact(hand: ManualControl | None) -> None:
    """Raise ``RefusedError`` while the held piece presses on something."""
    pressing_n = 0.0 if hand is None else hand.pressing_n
    if pressing_n:
        raise core.RefusedError(
            "IN-CONTACT",
            f"The piece presses with {pressing_n:.1f} N: lift before you start (jog +Z).",
        )


def connect_stop(connection: BenchConnection | None, interlock: Interlock) -> None:
    """Connect STOP to the connection, the arm and the gripper before there is a scene."""
    if connection is None:
        return
    interlock.on_stop(connection.cancel)
    for name in ("arm", "gripper"):
        stop = getattr(connection.devices.get(name), "stop", None)
        if stop is not None:
            interlock.on_stop(stop)


def latch_device_faults(devices: Iterable[Device], interlock: Interlock) -> None:
    """Latch the fault of each device that was lost or has a fault."""
    for device in devices:
        fault = fault_of(device)
        if fault is not None and device.state is DeviceState.FAULT:
            interlock.raise_fault(fault)


class FaultNotifier:
    """Publishes faults that were latched without a run, each once."""

    def __init__(
        self, hub: core.EventBus, interlock: Interlock, now_s: Callable[[], float]
    ) -> None:
        self._hub, self._interlock, self._now_s = hub, interlock, now_s
        self._told: set[tuple[str, str]] = set()
        hub.subscribe(self._note)

    def tell(self) -> None:
        """Publish latched faults that were not published since the last reset."""
        for fault in self._interlock.faults:
            if (fault.code, fault.device) not in self._told:
                self._hub.publish(core.FaultRaised(self._now_s(), fault))

    def tell_now(self, fault: core.Fault) -> None:
        """Latch and publish ``fault`` unless it was published since the last reset."""
        if (fault.code, fault.device) not in self._told:
            self._interlock.raise_fault(fault)
            self._hub.publish(core.FaultRaised(self._now_s(), fault))

    def _note(self, event: core.Event) -> None:
        if isinstance(event, core.FaultRaised):
            self._told.add((event.fault.code, event.fault.device))
        elif isinstance(event, core.FaultsReset):
            self._told.clear()
