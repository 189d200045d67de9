"""A session on the emulated bench: real drivers, sockets, terminals and pipes, simulated physics.

The same scenes and seeds as on the simulated bench; time is the wall's, connecting takes seconds.
"""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Mapping
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from types import TracebackType

from backend.assembly import Models, SimulatedBenchChoice, SimulatedScoring, make_scene
from backend.config.bench_facts import simulated_facts
from backend.config.hardware import HardwareSettings
from backend.config.load import load
from backend.config.method import StackSettings
from backend.core.clock import BenchClock
from backend.core.flow import Pose
from backend.emulated_child import EmulatedProcess
from backend.emulators.faults import FaultPlan
from backend.emulators.joined_serving import BENCH_FILE
from backend.emulators.truth import RemoteTruth
from backend.emulators.witness import Witnessed
from backend.learning.registry import Registry
from backend.objects.catalogue import load_catalogue
from backend.rig.flight import FlightRecorder
from backend.rig.link import LATE_S
from backend.rig.wired import WiredDevices
from backend.runs.bench import NoModel
from backend.runs.requests import SceneChoice
from backend.runs.stage import Stage
from backend.sensing.live import RawStreams
from backend.sensing.tare import gripper_payload
from backend.session import Keep, Session
from backend.simulation.holding import start_command_mm
from backend.simulation.scene import Scene


class EmulatedBench:
    """Holds the session and, scene by scene, the emulated devices and their drivers.

    ``plan``: what goes wrong, by the time since a scene was set; it may be changed between scenes.
    Close it when done.
    """

    def __init__(
        self,
        choice: SimulatedBenchChoice | None = None,
        *,
        keep: Keep | None = None,
        method: StackSettings | None = None,
        registry: Registry | None = None,
        plan: FaultPlan | None = None,
    ) -> None:
        choice = choice or SimulatedBenchChoice()
        self._settings, self.plan = choice.settings(), plan or FaultPlan()
        self._pieces, self._catalogue = choice.pieces, load_catalogue(choice.pieces)
        self._method = method or StackSettings()
        self._clock = BenchClock()
        facts = simulated_facts(self._settings)
        self._models = Models(registry, facts, self._method.belief.pitch_mm)
        self._present = ExitStack()
        self._process = EmulatedProcess(lambda fault: self.session.interlock.raise_fault(fault))
        self.session = Session(
            self._make_stage,
            self._check,
            self._catalogue,
            settings=self._method,
            keep=keep or Keep(),
            facts=facts,
        )
        self._wired: WiredDevices | None = None
        self._truth: RemoteTruth | None = None
        recorder = FlightRecorder(
            lambda: None if self._wired is None else self._wired.link.memory,
            lambda: self.session.run_folder,
        )
        self.session.hub.subscribe(recorder.note)

    def close(self) -> None:
        """End the run, disconnect the drivers, then take the emulated devices away."""
        self._process.end_if_still()
        self.session.close()
        self._present.close()
        self._process.close()

    def witnessed(self) -> Witnessed | None:
        """Return what the devices of the present scene have seen of their driver; None before.

        Raises ``OSError`` if they are gone.
        """
        return None if self._truth is None else self._truth.witnessed()

    def __enter__(self) -> EmulatedBench:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _make_stage(self, choice: SceneChoice, raw: RawStreams) -> Stage:
        self._present.close()
        scene = make_scene(self._catalogue, choice, self._settings)
        estimator = self._models.of(choice, scene.piece) or NoModel()
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            address = self._process.set_scene(
                choice, self._settings, self.plan, folder, self._pieces
            )
            self._truth = truth = RemoteTruth(scene, address)
            hardware = load(HardwareSettings, folder / BENCH_FILE)
            self._wired = wired = WiredDevices(
                hardware,
                self._clock.now_s,
                raw.frames,
                raw.samples,
                raw.poses,
                self.session.interlock,
            )
            stack.callback(wired.close)
            wired.connect(threading.Event())
            wired.home()
            self._present = stack.pop_all()
        wrist = self._settings.wrist
        return Stage(
            clock=self._clock,
            devices=wired.devices,
            arm=wired.arm,
            gripper=wired.gripper,
            piece=scene.piece,
            bottom="+".join(choice.bottoms),
            advance=self._clock.wait,
            scoring=SimulatedScoring(truth, self._method.policy.longest_step_mm, False),
            estimator=estimator,
            payload=gripper_payload(wrist.payload_kg, wrist.payload_com_mm),
            outline=scene.surface,
            jig=_jig(scene),
            wrench_late_s=1e-3 * hardware.ft.latency_ms + LATE_S,
            real_time=True,
        )

    def _check(self, choice: SceneChoice) -> Mapping[str, object]:
        scene = make_scene(self._catalogue, choice, self._settings)
        loaded = self._models.check(choice, scene.piece)
        return {
            "emulated": True,
            "simulation": self._settings.model_dump(mode="json"),
            "faults": self.plan.model_dump(mode="json"),
            "model": loaded
            and {"piece": loaded.card.piece, "weights_sha256": loaded.card.weights_sha256},
            "program": version("touchdown"),
        }


def _jig(scene: Scene) -> Pose | None:
    return Pose(*start_command_mm(scene).tolist()) if scene.jig else None
