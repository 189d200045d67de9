"""MXT stream of the emulated controller."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from touchdown.backend.core import FloatArray
from touchdown.backend.devices.framing import WireError
from touchdown.backend.devices.melfa.emulator_arm import (
    LIMITS_RAD,
    SPEEDS_RAD_S,
    angles_of,
    frame_of,
    hand_of,
    solve,
)
from touchdown.backend.devices.melfa.emulator_controller import STREAM, EmulatedController
from touchdown.backend.devices.melfa.protocol_mxt import (
    CYCLE_S,
    MONITOR_KINDS,
    Block,
    Command,
    Kind,
    Pose,
    Reply,
    Request,
    Values,
    decode_request,
    encode_reply,
    kind_of,
)

TOLERANCE = 1.2
"""How much over its top speed a joint may be told to go."""
PULSES_PER_RAD = 1e5
FLAGS = (7, 0)
_KINDS = {0: Kind.POSE, 1: Kind.JOINT, 2: Kind.PULSE}


class EmulatedStream:
    """``jump_rad`` may be set: the position that the first reply tells is off by it."""

    def __init__(self, controller: EmulatedController) -> None:
        self._controller, self._settings = controller, controller.settings
        controller.on_cycle = self._cycle
        self.jump_rad: FloatArray = np.zeros(6)
        self.commands = 0
        """Motion commands that were followed."""
        self.largest_share = 0.0
        """Largest step that was asked of a joint, as a share of its top speed."""
        self.late_command_s = 0.0
        """Longest time after the end of all motion at which a motion command still came."""
        self._begin()

    def _begin(self) -> None:
        self._running = False
        self._counter = self._timeouts = self._silent = 0

    def receive(self, now_s: float, data: bytes) -> bytes | None:
        """Take one datagram; return the reply, None where there is none."""
        controller = self._controller
        controller.advance(now_s)
        try:
            request = decode_request(data)
        except WireError:
            return None
        if controller.program != STREAM:
            if request.command is Command.MOVE and now_s > controller.stopped_s:
                late_s = now_s - controller.stopped_s
                self.late_command_s = max(self.late_command_s, late_s)
            return None
        if not self._running:
            self._begin()
            self._running = True
        self._silent = 0
        if request.command is Command.END:
            controller.finish_program()
            self._running = False
            return None
        if request.command is Command.MOVE and not self._follow(request):
            return None
        self._counter = (self._counter + 1) % (1 << 32)
        return self._reply(request)

    def _cycle(self) -> None:
        """Count a cycle without a packet; too many in a row are an error."""
        if self._controller.program != STREAM:
            self._running = False
            return
        limit = self._settings.mxt.mxttout
        if not self._running or limit < 0:
            return
        self._silent += 1
        if self._silent > 1:
            self._timeouts = (self._timeouts + 1) % (1 << 16)
        if self._silent > limit:
            self._controller.raise_error(self._settings.mxt.error_timeout)

    def _follow(self, request: Request) -> bool:
        controller, mxt = self._controller, self._settings.mxt
        if mxt.send_type_must_match and kind_of(request.target) is not _KINDS[mxt.position_type]:
            controller.raise_error(mxt.error_overspeed)
            return False
        target = self._joints(request.target)
        if target is None or (np.abs(target) > LIMITS_RAD).any():
            controller.raise_error(2602)
            return False
        if not controller.servo:
            controller.raise_error(2000)
            return False
        shares = np.abs(target - controller.joints.command_rad) / (SPEEDS_RAD_S * CYCLE_S)
        share = float(shares.max())
        self.largest_share = max(self.largest_share, share)
        if share > TOLERANCE:
            controller.raise_error(mxt.error_overspeed)
            return False
        controller.joints.command_rad = target
        self.commands += 1
        return True

    def _joints(self, target: Block) -> FloatArray | None:
        near = self._controller.joints.command_rad
        if isinstance(target, Values) and target.kind is Kind.JOINT:
            return np.array(target.axes[:6])
        if isinstance(target, Values) and target.kind is Kind.PULSE:
            return np.array(target.axes[:6]) / PULSES_PER_RAD
        if isinstance(target, Pose):
            frame = np.eye(4)
            a, b, c = target.axes[3:6]
            frame[:3, :3] = hand_of(a, b, c, self._settings.euler)
            frame[:3, 3] = target.axes[:3]
            return solve(frame, near)
        return None

    def _reply(self, request: Request) -> bytes:
        first, second, third, fourth = map(self._block, request.monitors)
        timeouts = self._timeouts if self._settings.mxt.mxttout >= 0 else 0
        reply = Reply(
            request.command,
            request.monitors[0],
            request.monitors,
            (first, second, third, fourth),
            self._counter,
            timeouts=timeouts,
        )
        self.jump_rad = np.zeros(6)
        return encode_reply(reply)

    def _block(self, monitor: int) -> Block:
        kind = MONITOR_KINDS[monitor]
        joints = self._controller.joints
        if kind is Kind.NONE:
            return None
        if kind is Kind.CURRENT:
            amount = joints.currents().round().astype(int).tolist()
            return Values(kind, (*amount, 0, 0))
        sources: tuple[Callable[[], FloatArray], ...] = (
            lambda: joints.command_rad + self.jump_rad,
            lambda: joints.filtered_rad,
            lambda: joints.feedback_rad,
        )
        angles = sources[(monitor - 1) // 3]()
        if kind is Kind.POSE:
            frame = frame_of(angles)
            turned = angles_of(frame[:3, :3], self._settings.euler)
            return Pose((*frame[:3, 3].tolist(), *turned, 0.0, 0.0), *FLAGS)
        if kind is Kind.PULSE:
            pulses = (angles * PULSES_PER_RAD).round().astype(int).tolist()
            return Values(kind, (*pulses, 0, 0))
        return Values(kind, (*angles.tolist(), 0.0, 0.0))
