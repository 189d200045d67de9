"""Session on one bench: its streams, its engine, its time.

Streams, event bus, interlock and engine live as long as the session. The scene (devices, world,
clock) is built for every trial, so that a trial depends on its seed only. ``run`` steps the bench
as fast as it computes; ``open`` paces the same bench against the wall clock on a thread. Both give
the same events.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from touchdown.backend.annotations import Dataset
from touchdown.backend.calibration import CalibrationStore, DayChecks, calibrated_positions
from touchdown.backend.config import BenchDescription, BenchIdentity, Limits, StackSettings
from touchdown.backend.core import (
    FINGERS,
    FRAME_CAPACITY,
    SAMPLE_CAPACITY,
    EpisodeDecision,
    Event,
    EventBus,
    Fault,
    FaultError,
    FaultRaised,
    FaultsReset,
    Finger,
    InputError,
    MarkerField,
    RawStreams,
    Recording,
    RefusedError,
    RepaintHold,
    RunFinished,
    Said,
    SampleStream,
    Stream,
    TactileFrame,
    TrialFinished,
    blocking_section,
    data_folder,
)
from touchdown.backend.devices import (
    NAMES,
    DegradedDevice,
    Device,
    GuardedArm,
    GuardedGripper,
    Interlock,
    JogSurroundings,
    Supervision,
    refuse_degraded,
)
from touchdown.backend.geometry import PieceLibrary
from touchdown.backend.learning import ModelCard
from touchdown.backend.learning.fused import Guard, network_path, open_guard
from touchdown.backend.placement import Estimator, SupportTower, load_network_of
from touchdown.backend.rig import BenchConnection
from touchdown.backend.runs import (
    DEVICE_FAULTS,
    SCENE_TIMEOUT_S,
    Bench,
    CancelledError,
    DriftMonitor,
    Engine,
    FaultNotifier,
    LiveThread,
    ManualControl,
    OperatorPrompt,
    Plan,
    RecordingOptions,
    Request,
    RunEnding,
    RunRecorder,
    RunStatus,
    SceneCheck,
    SceneChoice,
    SceneDevices,
    SceneFactory,
    SetRequest,
    UsedCalibrations,
    calibration_metadata,
    calibrations_for,
    check_connected,
    check_devices,
    check_no_contact,
    check_request,
    connect_stop,
    contact_height_mm,
    latch_device_faults,
    log_limit_change,
    make_plan,
    payload_wrench,
)
from touchdown.backend.sensing import STILL_S, LiveSensing, WrenchDrift

LOSS_S = 1.5  # time to find all devices that were lost at once
STEP_US = 20_000  # bench step, 20 ms: the delay of a cancel
REST_US = 100_000  # step of a live simulation while nothing moves
UNWATCHED_S = 0.5  # between two tracked pictures of still markers that nobody sees
# Mode of recordings by the mode of the bench; anything else is a lab
LIVE_MODES = {"simulated": "live simulation", "emulated": "emulated"}


@dataclass(frozen=True, slots=True)
class RunResult:
    """Result of a run that ended without an error.

    Attributes
    ----------
    trials : tuple of TrialFinished
        One event per finished trial, in order. Each has ``outcome``, ``probes``, ``reason``,
        ``margin_mm`` (mm; None where unknown) and ``seed``. Empty for requests without trials.
    ending : {"finished", "cancelled", "stopped", "failed"}
        How the run ended.
    reason : str
        One sentence on the ending.
    faults : tuple of Fault
        Faults raised during the run, in order.
    run_folder : Path or None
        Folder with the event log and the episodes, None if the run was not kept.

    Examples
    --------
    >>> RunResult().ending
    'finished'

    """

    trials: tuple[TrialFinished, ...] = ()
    ending: RunEnding = "finished"
    reason: str = ""
    faults: tuple[Fault, ...] = ()
    run_folder: Path | None = None


class Session:
    """One bench: simulated, emulated or of a laboratory. The only public face of a bench.

    Scripts open one with ``simulated_bench``, ``emulated_bench`` or ``open_lab`` and call ``run``.
    The window calls ``open``, then ``start``, ``stop``, ``reset``, ``answer`` and ``decide``.
    A session is a context manager; leaving the block closes it.

    Attributes
    ----------
    events : EventBus
        Publishes every event; ``subscribe`` takes a callable.
    interlock : Interlock
        Stop latch, faults and limits.
    engine : Engine
        Pause, resume and cancel of the run in progress.
    connection : BenchConnection or None
        Connection of the devices of a laboratory, None where each scene has its own devices.
    dataset : Dataset or None
        Dataset that takes collected episodes; set it between runs.
    calibrations : CalibrationStore or None
        Calibrations of the bench; set before the first scene.
    simulated : bool
        Whether the bench is simulated, without any device or wire.

    Examples
    --------
    >>> from touchdown.backend.bench import simulated_bench
    >>> with simulated_bench() as bench:
    ...     bench.simulated
    True

    """

    def __init__(
        self,
        make_stage: SceneFactory,
        check: SceneCheck,
        catalogue: PieceLibrary,
        *,
        settings: StackSettings,
        keep: RecordingOptions,
        description: BenchDescription,
    ) -> None:
        self._make_stage, self._check = make_stage, check
        self.catalogue: PieceLibrary = catalogue
        self.method: StackSettings = settings
        self.description: BenchDescription = description
        self.identity: BenchIdentity = BenchIdentity()  # for certificates; set before the first run
        self.simulated: bool = description.mode == "simulated"
        self.name: str = ""
        self.run_id: str = ""  # of the last run
        self.mode: str = ""  # of the last run
        self.limits_source: str = "the program itself"
        self.usual: SceneChoice = SceneChoice()
        self.resources: ExitStack[bool | None] = ExitStack()  # closed after everything else
        # Devices that outlive every scene, None if each scene has its own
        self.connection: BenchConnection | None = None
        self.events: EventBus = EventBus()
        self.interlock: Interlock = Interlock()
        self.prompt: OperatorPrompt = OperatorPrompt()
        # Holds repaints while a decision is computed.
        self.repaint_hold: RepaintHold = RepaintHold()
        self.decisions: deque[EpisodeDecision] = deque(maxlen=1)
        self.dataset: Dataset | None = None  # collected episodes; set only between runs
        self.calibrations: CalibrationStore | None = None  # set before the first scene
        # Folder of the states of guards; without kept runs no signals are compared
        self._guards = None if keep.runs is None else data_folder() / "guards"
        self._used: UsedCalibrations = {}
        self.raw: RawStreams = RawStreams.new()
        self.frames: Mapping[Finger, Stream[TactileFrame]] = self.raw.frames
        self.fields: Mapping[Finger, Stream[MarkerField]] = {
            finger: Stream(f"markers_{finger}", FRAME_CAPACITY) for finger in FINGERS
        }
        self.wrench: SampleStream = SampleStream("wrench", 6, SAMPLE_CAPACITY)
        self._supervision = Supervision(self.interlock, self.wrench, self.frames)
        self.engine: Engine = Engine(
            self.events, self.interlock, self.clock_s, self._supervision.unwell
        )
        # Mode of recordings of a live bench
        self.live_mode: str = LIVE_MODES.get(description.mode, "lab")
        self._keep, self._recorder = keep, RunRecorder(keep, self.events, self.interlock)
        self._teller = FaultNotifier(self.events, self.interlock, self.clock_s)
        self._scene: Bench | None = None  # assigned after the three below
        self._stage: SceneDevices
        self._hand: ManualControl
        self._drift: DriftMonitor
        ended, still = self.engine.abandon, self._teller.tell_now
        # Whether a window shows pictures, and whether a live view serves them
        self.watched: bool = True
        self.served: bool = False
        self._step_us = STEP_US  # of the next advance
        self._owed_us = 0  # live time that the bench has not advanced yet
        self._live = LiveThread(self._live_step, 1e-6 * STEP_US, ended, still)

    # -- for the window and for scripts -----------------------------------------------------------

    @property
    def devices(self) -> Mapping[str, Device]:
        """The five devices by name; on a simulated bench those of the present scene."""
        if self._scene is not None:
            return self._stage.devices
        return {} if self.connection is None else self.connection.devices

    @property
    def pace(self) -> float:
        """Bench seconds per wall second, measured while live."""
        return self._live.pace

    @property
    def still_s(self) -> float:
        """Time since the last step of the live bench, s."""
        return self._live.still_s

    @property
    def run_folder(self) -> Path | None:
        """Folder of the last run, None if it was not kept."""
        return self._recorder.folder

    @property
    def hand(self) -> ManualControl | None:
        """Manual control of the present scene, None before the first one."""
        return None if self._scene is None else self._hand

    @property
    def model(self) -> ModelCard | None:
        """Card of the model that estimates contact on the present scene, None without one."""
        estimator = None if self._scene is None else self._scene.estimator
        return estimator.card if isinstance(estimator, Estimator) else None

    @property
    def day_checks(self) -> DayChecks:
        """Daily checks of this bench; without a folder of calibrations none are kept."""
        if self.calibrations is None:
            return DayChecks(None)
        return self.calibrations.day_checks(self.identity, self.description.sha256)

    @property
    def degraded(self) -> tuple[DegradedDevice, ...]:
        """Sensors of the present scene that are late or slow now."""
        return () if self._scene is None else self._supervision.degraded

    @property
    def drift(self) -> WrenchDrift | None:
        """Drift of the wrist sensor, None while it is unknown."""
        return None if self._scene is None else self._scene.sensing.drift

    def clock_s(self) -> float:
        """Return the bench clock of the present scene."""
        return 0.0 if self._scene is None else self._scene.now_s()

    def status(self) -> RunStatus:
        """Return a snapshot of the engine."""
        return self.engine.status()

    def start(self, request: Request) -> None:
        """Begin a run on the live bench; returns at once.

        Raises ``RefusedError`` while another run is in progress or after a stop.
        """
        self._refuse_busy()
        if self.interlock.recovering:
            raise RefusedError("RECOVERY", "After a fault: jog away from contact first.")
        if not isinstance(request, SetRequest):
            check_no_contact(self.hand)
            refuse_degraded(self.degraded, self.clock_s())
            if self.hand is not None:
                self.hand.refuse_turned()
                if not self.hand.powered:
                    raise RefusedError(
                        "SERVO-OFF", "The servo of the arm is off: switch it on first."
                    )
        self.engine.begin(self._plan(request))

    def run(self, request: Request) -> RunResult:
        """Run ``request`` to its end on the calling thread, as fast as the bench allows.

        A simulated bench is stepped as fast as it computes; devices take their own time.

        Parameters
        ----------
        request : StackRequest, CollectRequest, CalibrateRequest, ProbeRequest or SetRequest
            The run. The same request with the same seed gives the same events on a simulated
            bench.

        Returns
        -------
        RunResult
            Finished trials, ending, faults and folder of the run. A run that was cancelled, or
            that a failed trial ended early, returns as well; see ``RunResult.ending``.

        Raises
        ------
        InputError
            If a piece, a bottom or a model is unknown, or the folder for runs cannot be written.
        RefusedError
            If another run is in progress, after a stop, or if a device is not connected or a
            calibration is missing.
        FaultError
            If a fault ended the run outside a trial.

        """
        if self.hand is not None and not self.simulated:
            self.hand.refuse_turned()
        plan = self._plan(request)
        events: list[Event] = []
        # Other events hold episodes and maps; a long run would fill the memory with them.
        kept = (TrialFinished, FaultRaised, RunFinished)
        leave = self.events.subscribe(lambda e: events.append(e) if isinstance(e, kept) else None)
        also = ""
        try:
            self.engine.run(plan, self.advance)
        finally:
            if {fault.code for fault in self.interlock.faults} & DEVICE_FAULTS:
                # Devices lost at the same time are found within this time, and each is named.
                until_s = self.clock_s() + LOSS_S
                while self.clock_s() < until_s:
                    self.advance()
                also = self._later_faults(events)
            leave()
            self._recorder.close()
        finished = next((e for e in reversed(events) if isinstance(e, RunFinished)), None)
        trials = [e for e in events if isinstance(e, TrialFinished)]
        if trials and also:
            trials[-1] = replace(trials[-1], reason=f"{trials[-1].reason}{also}")
        return RunResult(
            trials=tuple(trials),
            ending="finished" if finished is None else finished.ending,
            reason="" if finished is None else f"{finished.reason}{also}",
            faults=tuple(e.fault for e in events if isinstance(e, FaultRaised)),
            run_folder=self.run_folder,
        )

    def _later_faults(self, events: Sequence[Event]) -> str:
        """Return and publish the devices with faults that the end of the run does not name."""
        told = " ".join(e.reason for e in events if isinstance(e, TrialFinished | RunFinished))
        first, *later = (fault.device for fault in self.interlock.faults)
        names = (NAMES.get(device, device) for device in dict.fromkeys(later) if device != first)
        also = ", ".join(sorted(name for name in names if f"The {name} " not in told))
        if also:
            also = f" Also with a fault: {also}."
            self.events.publish(Said(self.clock_s(), also.strip()))
        return also

    def check(self, request: Request, *, connected: bool = False) -> None:
        """Raise what ``run`` would raise for a request on the devices of a lab; nothing moves.

        Before the devices are connected everything but their calibrations is checked, afterwards
        (``connected``) the calibrations.
        """
        if connected:
            refuse_beyond_gripper(self.method, self.devices.get("gripper"))
            calibrations_for(request, self.description.mode, self.calibrations, self.devices)
            return
        check_request(request, self)
        self._recorder.check()

    def stop(self) -> None:
        """STOP: latch, halt arm and gripper, end the run. Always allowed; returns at once."""
        self.interlock.stop()

    def reset(self) -> None:
        """Clear latch and faults after the operator checked the bench; nothing moves."""
        self.interlock.reset()
        self.events.publish(FaultsReset(self.clock_s()))

    def answer(self, yes: bool) -> None:
        """Approve or decline the pending action."""
        self.prompt.answer(yes)

    def decide(self, decision: EpisodeDecision) -> None:
        """Keep, discard, redo, flag or skip the newest collected episode; never waits."""
        self.decisions.append(decision)

    def prepare(self, choice: SceneChoice) -> None:
        """Set a scene without starting a run, for a live view."""
        self._set_scene(choice)

    def connect(self, *, home: bool = False) -> None:
        """Connect all devices of a laboratory and wait until they are ready.

        Does nothing on a simulated or an emulated bench, whose devices come with each scene.

        Parameters
        ----------
        home : bool, default: False
            Home the gripper as well. The jaws move and must be empty.

        Raises
        ------
        FaultError
            If a device cannot be connected or has a fault.
        RefusedError
            If a run is in progress, after a stop, or if the gripper has to be homed first.

        """
        if self.connection is None:
            return
        self.connection.begin()
        self.connection.wait()
        if home:
            self.home_gripper()
            self.connection.wait()
        check_connected(self.connection)

    def recording(self, start_s: float, end_s: float) -> Recording | None:
        """Return the signals between two bench times, None before the first scene."""
        return None if self._scene is None else self._scene.sensing.recording(start_s, end_s)

    def join(self, connection: BenchConnection, name: str, limits: Limits, source: str) -> None:
        """Take the devices of lab ``name``, which outlive every scene, and connect STOP to them."""
        self.connection, self.name, self.limits_source = connection, name, source
        self.interlock.change_limits(limits, self.clock_s())
        connect_stop(connection, self.interlock)

    def leave_scene(self) -> None:
        """Block all motion until a scene is set again, before a device is disconnected."""
        self._refuse_busy()
        self._scene = None

    def home_gripper(self) -> None:
        """Home the empty gripper; raises ``RefusedError``."""
        self._refuse_busy()
        if self.interlock.latched:
            raise RefusedError("LATCHED", "The bench is stopped: press Reset first.")
        if self.connection is not None:
            self.connection.home()

    def change_limits(self, limits: Limits, person: str) -> None:
        """Set other limits between motions, once the change is durable in the limit log.

        Raises ``RefusedError`` while something moves, ``InputError`` if the log cannot be written.
        """
        self._refuse_busy()
        if self._keep.runs is not None:
            log_limit_change(self._keep.runs, self.name, person, self.interlock.limits, limits)
        self.interlock.change_limits(limits, self.clock_s())
        self.events.publish(Said(self.clock_s(), f"Limits changed by {person}."))

    # -- time -------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Advance the bench by one step and process the samples."""
        step_us, self._step_us = self._step_us, STEP_US
        latch_device_faults(self.devices.values(), self.interlock)
        if (scene := self._scene) is not None:
            self._hand.tick()
            self._stage.advance(step_us)
            still_s = STILL_S if self.watched or self.served else UNWATCHED_S
            scene.sensing.update(still_s if self._idle else 0.0)
            self._drift.update()
            self._supervision.check(self.clock_s())
        if not self.engine.busy:
            self._teller.tell()

    def open(self, speed: float = 1.0) -> None:
        """Start the live thread; ``speed`` is simulated seconds per wall second."""
        self._live.open(speed)

    def close(self) -> None:
        """Stop motion, end the run and the live thread; the gripper stays as it is."""
        if self.engine.busy:
            self.interlock.stop("shutdown")
        self._live.close(lambda: self.engine.wait_idle(2.0))
        self._recorder.close()
        if self.connection is not None:
            self.connection.close()
        self.resources.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def _live_step(self) -> None:
        self.engine.tick()
        if not self.engine.busy:
            self._recorder.close()
        self._owed_us += STEP_US
        step_us = STEP_US
        if self._idle and self._scene is not None and self._stage.rests():
            step_us = REST_US
        while self._owed_us >= step_us:
            self._owed_us -= step_us
            self._step_us = step_us
            self.advance()

    @property
    def _idle(self) -> bool:
        """True if neither a run nor the operator moves the bench."""
        return not self.engine.busy and (self._scene is None or not self._hand.active)

    # -- inside -----------------------------------------------------------------------------------

    def _refuse_busy(self) -> None:
        if self.engine.busy:
            raise RefusedError("BUSY", "A run is in progress: cancel it first.")
        if self.hand is not None and self.hand.active:
            raise RefusedError("BY-HAND", "The bench is under manual control: end it first.")

    def _plan(self, request: Request) -> Plan[None]:
        check_devices(self.connection, request)
        self._used = calibrations_for(
            request, self.description.mode, self.calibrations, self.devices
        )
        self.run_id = datetime.now(UTC).strftime("%Y%m%d-%H%M%S-%f")[:-3]
        simulated = self.live_mode == LIVE_MODES["simulated"]
        self.mode = "stepped" if simulated and not self._live.running else self.live_mode
        return make_plan(request, self)

    # -- for plans --------------------------------------------------------------------------------

    def guard_of(self, method: StackSettings) -> Guard | None:
        """Return the guard of the network of ``method``, None without a calibration here."""
        if self._guards is None or method.strategy != "fused" or not self.identity.sha256:
            return None
        weights = network_path(method.fused.weights)
        card = load_network_of(method.fused).card
        return open_guard(weights, card.weights_sha256, self.identity.sha256, self._guards)

    def check_scene(self, choice: SceneChoice) -> Mapping[str, object]:
        """Return the settings a run on ``choice`` depends on, JSON-ready; raises ``InputError``."""
        refuse_beyond_limits(self.method, self.interlock.limits)
        refuse_beyond_gripper(self.method, self.devices.get("gripper"))
        return {**self._check(choice), "limits": self.interlock.limits.model_dump()}

    def open_record(self) -> None:
        """Open event log and episode store of the run; raises ``InputError``."""
        self._recorder.open(self.run_id, self.live_mode, self.description.model_dump_json())

    def set_scene(self, choice: SceneChoice, method: StackSettings) -> Bench:
        """Build a new scene and return its bench for the run in progress."""
        return self._for_run(self._set_scene(choice, self._used), method)

    def present_scene(self, method: StackSettings) -> Bench:
        """Return the bench of the present scene; raises ``RefusedError`` if there is none."""
        if self._scene is None:
            raise RefusedError("NO-SCENE", "No scene is set on the bench yet.")
        return self._for_run(self._scene, method)

    def _for_run(self, scene: Bench, method: StackSettings) -> Bench:
        bottoms = [self.catalogue.bottom(name) for name in scene.bottom.split("+")]
        self.interlock.untested_release = self.simulated and method.strategy == "pick-and-place"
        self.interlock.renew_lease(scene.now_s())
        self._recorder.store.started_ns = scene.started_ns
        return replace(
            scene,
            settings=method,
            store=self._recorder.store,
            calibrations=calibration_metadata(self._used),
            below=SupportTower.entered(scene.piece, bottoms, method.tower),
            placed=calibrated_positions(self._used),
        )

    @blocking_section("sets the scene", SCENE_TIMEOUT_S)
    def _set_scene(self, choice: SceneChoice, used: UsedCalibrations | None = None) -> Bench:
        """Build the scene and start its sensors; ``used`` are the calibrations of the run."""
        self.interlock.forget_stoppers()
        connect_stop(self.connection, self.interlock)
        for finger in FINGERS:
            self.frames[finger].clear()
            self.fields[finger].clear()
        raw = self.raw
        for samples in (raw.samples, raw.poses, raw.commands, self.wrench):
            samples.clear()
        cancelled = self.engine.cancelled
        try:
            stage = self._make_stage(choice, raw)
            for device in stage.devices.values():
                device.connect(5.0, cancelled)
        except FaultError:
            if cancelled.is_set():
                raise CancelledError("cancelled by the operator") from None
            raise
        payload = payload_wrench(self.calibrations, stage.devices, used)
        payload = stage.payload if payload is None else payload
        sensing = LiveSensing(raw, self.fields, self.wrench, payload)
        now_s = stage.clock.now_s

        def press_n() -> float:
            return sensing.press_n(now_s(), max_age_s=0.2)

        def surface_mm() -> float:
            return contact_height_mm(stage.piece, stage.bottom, self._used)

        arm = GuardedArm(stage.arm, self.interlock, now_s, press_n, surface_mm)
        gripper = GuardedGripper(stage.gripper, self.interlock, now_s)

        def lease_clock_s() -> float:
            # The wall clock while live, else the bench clock.
            return time.monotonic() if self._live.running else self.clock_s()

        around = JogSurroundings(
            now_s, lease_clock_s, press_n, surface_mm, lambda: self.engine.busy
        )
        scene = Bench(
            **stage.facts(),
            now_s=now_s,
            arm=arm,
            gripper=gripper,
            interlock=self.interlock,
            sensing=sensing,
            store=self._recorder.store,
            prompt=self.prompt,
            settings=self.method,
            wall_s=time.perf_counter,
            status=self.status,
            repaint_hold=self.repaint_hold,
            sensor_height_mm=self.description.sensor_height_mm,
            started_ns=time.time_ns() - round(1e9 * now_s()),
        )
        self._hand = ManualControl(scene, self.interlock, around, self.events.publish)
        self._drift = DriftMonitor(scene, surface_mm, self.events.publish)
        self._stage, self._scene = stage, scene
        self._supervision.begin(now_s(), gripper, stage.devices["force_torque"], arm)
        return scene


def refuse_beyond_gripper(method: StackSettings, gripper: Device | None) -> None:
    """Raise ``InputError`` for a grip force that the gripper reports to be too large for it."""
    most_n = math.inf if gripper is None else gripper.describe().get("most_force_n", math.inf)
    asked_n = method.probe.grip_force_n
    if not asked_n <= float(most_n):
        raise InputError(
            f"The method asks for {asked_n:g} N per finger, the gripper grips with up to "
            f"{most_n:g} N.",
            "probe.grip_force_n",
            "Lower it. If the gripper does not report its range, set wsg.force_max_n.",
        )


def refuse_beyond_limits(method: StackSettings, limits: Limits) -> None:
    """Raise ``InputError`` for a setting of the method that a limit of the bench would refuse."""
    probe = method.probe
    nominal_n = probe.stiffness_n_mm[2] * probe.depth_mm
    for key, value, unit, limit in (
        ("travel_mm_s", probe.travel_mm_s, "mm/s", "speed_mm_s"),
        ("approach_mm_s", probe.approach_mm_s, "mm/s", "contact_speed_mm_s"),
        ("depth_mm", nominal_n, "N (depth by stiffness)", "probe_n"),
    ):
        most = getattr(limits, limit)
        if not value <= most:
            what = f"The method asks for {value:g} {unit}, the bench permits {most:g}."
            fix = f"Lower it, or raise limits.{limit} in the lab file."
            raise InputError(what, f"probe.{key}", fix)
