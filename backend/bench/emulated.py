"""Session on the emulated bench: real drivers on real wires, simulated physics.

Scenes and seeds are those of the simulated bench. Time is the wall clock; connecting takes seconds.
"""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

from touchdown.backend.bench import assembly
from touchdown.backend.bench.emulated_child import EmulatedProcess
from touchdown.backend.bench.emulated_scene import (
    BENCH_FILE,
    TruthClient,
    longest_delay_s,
    processor_share,
)
from touchdown.backend.bench.session import Session
from touchdown.backend.calibration import CalibrationStore
from touchdown.backend.config import (
    HardwareSettings,
    StackSettings,
    describe_simulation,
    read_settings,
)
from touchdown.backend.core import BenchClock, Pose, RawStreams
from touchdown.backend.emulation import FaultPlan
from touchdown.backend.geometry import load_pieces
from touchdown.backend.learning import ModelRegistry
from touchdown.backend.rig import LATE_S, BenchDevices, FlightRecorder
from touchdown.backend.runs import (
    RecordingOptions,
    SceneChoice,
    SceneDevices,
    calibrations_folder,
    models_folder,
)
from touchdown.backend.sensing import gripper_payload
from touchdown.backend.simulation import start_command_mm

MEASURED_S = 2.0  # duration of the measurement of delays
# Later wake-ups void a press (replies of the arm), or cost it its permission to move (backend)
REPLY_LATE_S, BACKEND_LATE_S = 0.035, 0.1
# Runs end as they should with 25 % of a core (beside 6 busy programs), not with 17 % (beside 10).
PROGRAM_SHARE = 0.2


def real_time_notice(device_s: float, backend_s: float, share: float) -> str:
    """Return what a computer with these delays cannot keep up with, empty if nothing.

    ``share`` is the share of a processor core that a computing thread of this program gets.
    """
    limits = (
        (device_s, REPLY_LATE_S, "the arm's replies, so that presses are void"),
        (backend_s, BACKEND_LATE_S, "the program's commands, so that motions are held"),
    )
    late = [
        f"{what} ({1e3 * found_s:.0f} ms late, limit {1e3 * limit_s:.0f} ms)"
        for found_s, limit_s, what in limits
        if found_s > limit_s
    ]
    if share < PROGRAM_SHARE:
        late.append(
            "samples and pictures, so that presses are void "
            f"({share:.0%} of a core, needed {PROGRAM_SHARE:.0%})"
        )
    if not late:
        return ""
    return (
        f"This computer is too busy for real time: it delays {', and '.join(late)}. End other "
        "programs, or allow real-time priority (docs/hardware.md)."
    )


class EmulatedBench:
    """Session with the emulated devices and drivers of each scene. Close it when done.

    ``plan`` has the faults by the time since a scene was set; it may change between scenes.
    """

    def __init__(
        self,
        choice: assembly.SimulatedBenchChoice | None = None,
        *,
        keep: RecordingOptions | None = None,
        method: StackSettings | None = None,
        registry: ModelRegistry | None = None,
        plan: FaultPlan | None = None,
    ) -> None:
        choice = choice or assembly.SimulatedBenchChoice()
        self._settings, self.plan = choice.settings(), plan or FaultPlan()
        self._pieces, self._catalogue = choice.pieces, load_pieces(choice.pieces)
        self._method = method or StackSettings()
        self._clock = BenchClock()
        description = describe_simulation(self._settings)
        self._models = assembly.BenchModels(registry, description, self._method.belief.pitch_mm)
        self._present = ExitStack()
        self._process = EmulatedProcess(lambda fault: self.session.interlock.raise_fault(fault))
        self.session: Session = Session(
            self._make_stage,
            self._check,
            self._catalogue,
            settings=self._method,
            keep=keep or RecordingOptions(),
            description=description,
        )
        self.session.live_mode = "emulated"
        self._wired: BenchDevices | None = None
        self._truth: TruthClient | None = None
        recorder = FlightRecorder(
            lambda: None if self._wired is None else self._wired.link.memory,
            lambda: self.session.run_folder,
        )
        self.session.events.subscribe(recorder.note)

    def close(self) -> None:
        """End the run, disconnect the drivers, then end the emulated devices."""
        self._process.end_if_still()
        self.session.close()
        self._present.close()
        self._process.close()

    def measure_real_time(self, seconds: float = MEASURED_S) -> str:
        """Return what this computer cannot keep up with at present, empty if nothing.

        The process of the devices computes as much as it will during a run; this takes
        ``seconds`` and the start of that process. Raises ``FaultError`` if it does not start.
        """
        found: list[float] = []

        def measure() -> None:
            found.extend((longest_delay_s(seconds / 2), processor_share(seconds / 2)))

        thread = threading.Thread(target=measure)
        thread.start()
        device_s = self._process.longest_delay_s(seconds)
        thread.join()
        return real_time_notice(device_s, *found)

    def __enter__(self) -> EmulatedBench:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def _make_stage(self, choice: SceneChoice, raw: RawStreams) -> SceneDevices:
        self._present.close()
        scene = assembly.make_scene(self._catalogue, choice, self._settings)
        estimator = self._models.of(choice, scene.piece)
        cancelled = self.session.engine.cancelled
        with ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            address = self._process.set_scene(
                choice, self._settings, self.plan, folder, self._pieces, cancelled
            )
            self._truth = truth = TruthClient(scene, address)
            hardware = read_settings(HardwareSettings, folder / BENCH_FILE)
            now_s, interlock = self._clock.now_s, self.session.interlock
            self._wired = wired = BenchDevices(hardware, now_s, raw, interlock)
            stack.callback(wired.close)
            wired.connect(cancelled)
            wired.home(cancelled)
            self._present = stack.pop_all()
        wrist = self._settings.wrist
        return SceneDevices(
            clock=self._clock,
            devices=wired.devices,
            arm=wired.arm,
            gripper=wired.gripper,
            piece=self._catalogue.top(choice.piece),  # without a drawn centre of mass
            bottom="+".join(choice.bottoms),
            advance=self._clock.wait,
            scoring=assembly.SimulatedScoring(truth, self._method.policy.longest_step_mm, False),
            estimator=estimator,
            payload=gripper_payload(wrist.payload_kg, wrist.payload_com_mm),
            outline=scene.surface,
            jig=Pose(*start_command_mm(scene).tolist()) if scene.jig else None,
            wrench_late_s=1e-3 * hardware.ft.latency_ms + LATE_S,
            real_time=True,
        )

    def _check(self, choice: SceneChoice) -> Mapping[str, object]:
        scene = assembly.make_scene(self._catalogue, choice, self._settings)
        loaded = self._models.check(choice, scene.piece)
        bench = {
            "emulated": True,
            "simulation": self._settings.model_dump(mode="json"),
            "faults": self.plan.model_dump(mode="json"),
        }
        return assembly.run_record(bench, loaded)


@contextmanager
def emulated_bench(
    *,
    preset: str | None = None,
    faults: FaultPlan | None = None,
    method: StackSettings | None = None,
    pieces: Path | str | None = None,
    runs: Path | str | None = None,
) -> Iterator[Session]:
    """Open an emulated bench: real drivers on real wires, simulated physics, in real time.

    Parameters
    ----------
    preset : {"mixed", "quiet", "hard", "off", "realistic", "bench-v1", "bench-v2"}, optional
        Named noise settings, "mixed" by default.
    faults : FaultPlan, optional
        Faults of the devices by the time since a scene was set; none by default.
    method, pieces, runs
        As of ``simulated_bench``.

    Yields
    ------
    Session
        The session; drivers and emulated devices are taken down at the end of the block.

    Raises
    ------
    InputError
        If the preset or a file is invalid.

    Examples
    --------
    Real time, with sockets and child processes:

    >>> from touchdown.backend.runs import StackRequest
    >>> with emulated_bench() as bench:  # doctest: +SKIP
    ...     bench.run(StackRequest(seed=7)).trials[0].outcome

    """
    with EmulatedBench(
        assembly.SimulatedBenchChoice(preset=preset, pieces=Path(pieces) if pieces else None),
        keep=RecordingOptions(Path(runs) if runs else None),
        method=method,
        registry=ModelRegistry(models_folder()),
        plan=faults,
    ) as bench:
        store = CalibrationStore(calibrations_folder(), "emulated", "--emulated")
        bench.session.calibrations = store
        yield bench.session
