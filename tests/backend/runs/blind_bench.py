"""Simulated bench of one scene without cameras, for plans that use no images.

Arm, gripper, wrist, interlock and engine are those of the product.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from touchdown.backend.bench.assembly import make_scene
from touchdown.backend.config.method import ProbeSettings, StackSettings
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core.event_bus import EventBus
from touchdown.backend.core.events import Event
from touchdown.backend.core.scheduling import RepaintHold
from touchdown.backend.core.streams import SampleStream, Stream
from touchdown.backend.core.values import FINGERS, FloatArray, Pose
from touchdown.backend.devices.guarded_devices import GuardedArm, GuardedGripper
from touchdown.backend.devices.interlock import Interlock, Limits
from touchdown.backend.devices.protocols import Arm
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.bench import Bench, NoEstimator, OperatorPrompt
from touchdown.backend.runs.engine import Engine
from touchdown.backend.runs.plan import Plan
from touchdown.backend.runs.recorder import RunStore
from touchdown.backend.runs.requests import RunState, RunStatus, SceneChoice
from touchdown.backend.sensing.live import LiveSensing, RawStreams
from touchdown.backend.sensing.zeroing import gripper_payload
from touchdown.backend.simulation.conditions import true_offset_mm
from touchdown.backend.simulation.devices.bench import BenchStreams, SimulatedBench
from touchdown.backend.simulation.gripper import HeldPiece, start_command_mm

# Short ways: a touch takes less than a second of the bench's time.
BRISK = StackSettings(probe=ProbeSettings(start_height_mm=1.0, travel_mm_s=50.0, approach_mm_s=4.0))
STEP_US = 20_000


class BlindBench:
    """One scene with the piece in its jig; ``run`` runs a plan to its end."""

    def __init__(
        self,
        choice: SceneChoice,
        preset: str = "mixed",
        changes: Mapping[str, object] = MappingProxyType({}),
        arm: Callable[[Arm], Arm] = lambda arm: arm,
    ) -> None:
        """``arm`` returns a replacement of the simulated arm."""
        settings = SimulationSettings.model_validate(
            {"preset": preset, "cycle_us": STEP_US, **changes}
        )
        scene = make_scene(load_pieces(), choice, settings)
        streams = BenchStreams.new()
        self.simulated = SimulatedBench(scene, streams=streams)
        for name, device in self.simulated.devices.items():
            if not name.startswith("tactile"):
                device.connect(1.0, threading.Event())
        self.facts: list[Event] = []
        hub, self.interlock = EventBus(), Interlock(Limits(contact_speed_mm_s=4.0))
        hub.subscribe(self.facts.append)
        now_s = self.simulated.clock.now_s
        self.engine = Engine(hub, self.interlock, now_s)
        wrench = SampleStream("wrench", 6, 60_000)
        payload = gripper_payload(settings.wrist.payload_kg, settings.wrist.payload_com_mm)
        raw = RawStreams(streams.frames, streams.samples, streams.poses, streams.commands)
        fields = {finger: Stream(f"markers_{finger}", 8) for finger in FINGERS}
        self.sensing = LiveSensing(raw, fields, wrench, payload)

        def press_n() -> float:
            return self.sensing.press_n(now_s(), max_age_s=0.2)

        def surface_mm() -> float:
            return scene.piece.grip_height_mm or 0.0

        self.bench = Bench(
            now_s=now_s,
            arm=GuardedArm(arm(self.simulated.arm), self.interlock, now_s, press_n, surface_mm),
            gripper=GuardedGripper(self.simulated.gripper, self.interlock, now_s),
            interlock=self.interlock,
            sensing=self.sensing,
            estimator=NoEstimator(),
            piece=scene.piece,
            bottom="+".join(choice.bottoms),
            store=RunStore(None, {}),
            prompt=OperatorPrompt(),
            settings=BRISK,
            scoring=None,
            wall_s=time.perf_counter,
            status=lambda: RunStatus(RunState.IDLE),
            repaint_hold=RepaintHold(),
            outline=scene.surface,
            jig=Pose(*start_command_mm(scene).tolist()),
        )
        self.centres_mm: list[FloatArray] = []
        """Per grip, where the hand truly has to be for the face to lie over the bottom's centre."""
        self._held: HeldPiece | None = None
        self._advance()

    def run(self, plan: Callable[[Bench], Plan[object]]) -> object:
        """Return the value of ``plan``; raises the error that ended it."""
        self.interlock.renew_lease(self.bench.now_s())
        return self.engine.run(plan(self.bench), self._advance)

    def _advance(self) -> None:
        self.simulated.advance(STEP_US)
        self.sensing.update()
        holding = self.simulated._world.holding
        if holding is not None and holding is not self._held:
            still = replace(holding.conditions, label_error_mm=np.zeros((1, 2)))
            self.centres_mm.append(-true_offset_mm(np.zeros((1, 2)), still)[0])
        self._held = holding
