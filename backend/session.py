"""What a window or a script holds: one bench, its streams, its engine, its time.

Streams, hub, interlock and engine live as long as the session; the scene behind them (devices,
world, clock) is built anew for every trial, so that a trial depends on nothing but its seed.
``run`` drives the bench as fast as it computes; ``open`` paces the same bench against the wall
clock on one thread. Both give the same facts.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

from backend.config.method import StackSettings
from backend.core.facts import Fact, FaultsReset
from backend.core.faults import Fault, InputError, RefusedError
from backend.core.flow import FINGERS, Finger, MarkerField, TactileFrame
from backend.core.hub import Hub
from backend.core.stream import SampleStream, Stream
from backend.devices.guarded import GuardedArm, GuardedGripper
from backend.devices.interlock import Interlock
from backend.devices.protocols import Device
from backend.devices.supervision import Supervision
from backend.objects.catalogue import Catalogue
from backend.runs.bench import Bench
from backend.runs.engine import Engine
from backend.runs.gate import Gate
from backend.runs.journal import Journal
from backend.runs.plan import Plan
from backend.runs.requests import RunStatus, StackRequest
from backend.runs.stage import Stage
from backend.runs.store import RunStore
from backend.runs.trials import RunHead, stack_run
from backend.sensing.live import LiveSensing, RawStreams

STEP_US = 20_000
"""The bench advances in steps of 20 ms: a cancel is seen within that time."""
BEHIND_S = 0.25
"""A live bench that is later than this against the wall clock gives up catching up."""
FRAME_CAPACITY, SAMPLE_CAPACITY = 192, 60_000
"""Newest 7.7 s of images per finger (44 MB each) and 60 s of 1 kHz samples are kept."""


class MakeStage(Protocol):
    """Builds the scene of one trial on the session's streams."""

    def __call__(self, request: StackRequest, seed: int, raw: RawStreams) -> Stage:
        """Return the stage; raises ``InputError`` for an unknown piece, bottom or model."""


Check = Callable[[StackRequest], Mapping[str, object]]
"""Raises ``InputError`` before anything is written or moved; else returns what the run depends on
beside request and method, JSON-ready: bench settings, model, program."""


@dataclass(frozen=True, slots=True)
class Keep:
    """Where runs are kept (None: nowhere), and whether episodes are kept beside the journal."""

    runs: Path | None = None
    episodes: bool = True


class Session:
    """A bench that can be run headless (``run``) or live (``open``, then ``engine``)."""

    def __init__(
        self,
        make_stage: MakeStage,
        check: Check,
        catalogue: Catalogue,
        *,
        settings: StackSettings,
        keep: Keep,
        simulated: bool,
    ) -> None:
        self._make_stage, self._check, self.catalogue = make_stage, check, catalogue
        self._settings, self._keep, self.simulated = settings, keep, simulated
        self.hub, self.interlock, self.gate = Hub(), Interlock(), Gate()
        self.frames: Mapping[Finger, Stream[TactileFrame]] = {
            finger: Stream(f"tactile_{finger}", FRAME_CAPACITY) for finger in FINGERS
        }
        self.fields: Mapping[Finger, Stream[MarkerField]] = {
            finger: Stream(f"markers_{finger}", FRAME_CAPACITY) for finger in FINGERS
        }
        samples = SampleStream("force_torque", 6, SAMPLE_CAPACITY)
        poses = SampleStream("arm", 3, SAMPLE_CAPACITY)
        self.wrench = SampleStream("wrench", 6, SAMPLE_CAPACITY)
        self._raw = RawStreams(self.frames, samples, poses)
        self._supervision = Supervision(self.interlock, self.wrench, self.frames)
        self.engine = Engine(self.hub, self.interlock, self.clock_s)
        self._stage: Stage | None = None
        self._sensing: LiveSensing | None = None
        self._store: RunStore | None = None
        self._journal: Journal | None = None
        self._leave: Callable[[], None] | None = None
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._speed = 1.0
        self.pace = 0.0
        """Simulated seconds per wall second, measured while live."""
        self.run_folder: Path | None = None

    # -- for the window and for scripts -----------------------------------------------------------

    @property
    def devices(self) -> Mapping[str, Device]:
        """The five devices of the present scene by name (empty before the first)."""
        return {} if self._stage is None else self._stage.devices

    def clock_s(self) -> float:
        """Return the bench clock of the present scene."""
        return 0.0 if self._stage is None else self._stage.clock.now_s()

    def status(self) -> RunStatus:
        """Return a snapshot of the engine."""
        return self.engine.status()

    def start(self, request: StackRequest) -> None:
        """Begin a run (live); raises ``RefusedError`` while another goes on or after STOP."""
        if self.engine.busy:
            raise RefusedError("BUSY", "A run is going on: cancel it first.")
        self.engine.begin(self._plan(request))

    def run(self, request: StackRequest) -> None:
        """Run to the end on this thread, as fast as it computes. Raises what ended it early."""
        plan = self._plan(request)
        try:
            self.engine.run(plan, self.advance)
        finally:
            self._end_run()

    def stop(self) -> None:
        """STOP: latch, halt arm and gripper, end the run. Legal always; returns at once."""
        self.interlock.stop()

    def reset(self) -> None:
        """Clear latch and faults after the operator looked; nothing moves."""
        self.interlock.reset()
        self.hub.publish(FaultsReset(self.clock_s()))

    def answer(self, yes: bool) -> None:
        """Approve or decline the action that waits."""
        self.gate.answer(yes)

    def prepare(self, request: StackRequest) -> None:
        """Set a scene without starting a run, so that a live view has something to show."""
        self._set_stage(request, request.seed)

    # -- time -------------------------------------------------------------------------------------

    def advance(self) -> None:
        """Move the bench by one step and process what the sensors delivered."""
        if self._stage is None or self._sensing is None:
            return
        self._stage.advance(STEP_US)
        self._sensing.update()
        self._supervision.check(self._stage.clock.now_s())

    def open(self, speed: float = 1.0) -> None:
        """Start the live thread; ``speed`` simulated seconds per wall second."""
        if self._thread is None:
            self._closing.clear()
            self._speed = speed
            self._thread = threading.Thread(target=self._live, name="bench", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop motion, end the run and the live thread; the gripper stays as it is."""
        if self.engine.busy:
            self.interlock.stop("shutdown")
        thread, self._thread = self._thread, None
        if thread is not None:
            self.engine.wait_idle(2.0)
            self._closing.set()
            thread.join(5.0)
        self._end_run()

    def _live(self) -> None:
        try:
            self._keep_pace()
        except BaseException as error:
            # Whatever it was: latch, stop, end the run, and let the exception hooks show it.
            self.engine.abandon(error)
            raise

    def _keep_pace(self) -> None:
        due_s = time.monotonic()
        measured_s, steps = due_s, 0
        while not self._closing.is_set():
            self.engine.tick()
            if not self.engine.busy:
                self._end_run()
            self.advance()
            steps += 1
            due_s += STEP_US * 1e-6 / self._speed
            now_s = time.monotonic()
            if now_s - measured_s >= 1.0:
                self.pace = steps * STEP_US * 1e-6 / (now_s - measured_s)
                measured_s, steps = now_s, 0
            if now_s - due_s > BEHIND_S:
                due_s = now_s
            self._closing.wait(max(0.0, due_s - now_s))

    # -- inside -----------------------------------------------------------------------------------

    def _plan(self, request: StackRequest) -> Plan[None]:
        run_id = datetime.now(UTC).strftime("%Y%m%d-%H%M%S-%f")[:-3]
        settings = self._settings.model_copy(
            update={"strategy": request.strategy, "mode": request.mode}
        )

        def prepare(trial: int) -> Bench:
            return self._begin_trial(request, settings, trial)

        def plan() -> Plan[None]:
            record = {
                "request": asdict(request),
                "method": settings.model_dump(mode="json"),
                **self._check(request),
            }
            head = RunHead(run_id, self.simulated, json.dumps(record))
            self._open_run(run_id)
            return (yield from stack_run(prepare, request, head))

        return plan()

    def _begin_trial(self, request: StackRequest, settings: StackSettings, trial: int) -> Bench:
        stage, sensing = self._set_stage(request, request.seed + trial)
        assert self._store is not None
        now_s = stage.clock.now_s
        self.interlock.untested_release = self.simulated and request.strategy == "pick-and-place"
        self.interlock.renew_lease(now_s())

        def press_n() -> float:
            return sensing.press_n(now_s(), max_age_s=0.2)

        return Bench(
            now_s=now_s,
            arm=GuardedArm(stage.arm, self.interlock, now_s, press_n),
            gripper=GuardedGripper(stage.gripper, self.interlock, now_s),
            interlock=self.interlock,
            sensing=sensing,
            estimator=stage.estimator,
            piece=stage.piece,
            bottom=stage.bottom,
            store=self._store,
            gate=self.gate,
            settings=settings,
            scoring=stage.scoring,
            wall_s=time.perf_counter,
            probe_count=lambda: self.engine.status().probe,
        )

    def _set_stage(self, request: StackRequest, seed: int) -> tuple[Stage, LiveSensing]:
        """Build the scene, clear the streams, connect the devices, and let the sensors start."""
        self.interlock.forget_stoppers()
        for finger in FINGERS:
            self.frames[finger].clear()
            self.fields[finger].clear()
        for samples in (self._raw.samples, self._raw.poses, self.wrench):
            samples.clear()
        stage = self._make_stage(request, seed, self._raw)
        sensing = LiveSensing(self._raw, self.fields, self.wrench, stage.payload)
        cancel = threading.Event()
        for device in stage.devices.values():
            device.connect(5.0, cancel)
        self._stage, self._sensing = stage, sensing
        self._supervision.begin(stage.clock.now_s())
        return stage, sensing

    def _open_run(self, run_id: str) -> None:
        self._end_run()
        folder = None if self._keep.runs is None else self._keep.runs / run_id
        episodes = None
        if folder is not None:
            self._journal = _new_journal(folder)
            self._leave = self.hub.subscribe(self._record)
            episodes = folder / "episodes" if self._keep.episodes else None
        self.run_folder = folder
        mode = "live simulation" if self.simulated else "lab"
        self._store = RunStore(episodes, {"run": run_id, "mode": mode})

    def _record(self, fact: Fact) -> None:
        """Append ``fact`` to the journal; a disk that refuses stops the run with a fault."""
        if self._journal is None:
            return
        try:
            self._journal(fact)
        except OSError as error:
            journal, self._journal = self._journal, None
            journal.abandon()
            self.interlock.raise_fault(
                Fault(
                    "JOURNAL-FAILED",
                    f"The run journal cannot be written: {error.strerror or error}.",
                    "The run ends; every fact up to here is on disk, the gripper was not opened.",
                    f"Make room on the disk of {journal.folder}, then press Reset.",
                    "store",
                )
            )

    def _end_run(self) -> None:
        """Close journal and store of the last run, if any."""
        if self._leave is not None:
            self._leave()
        if self._journal is not None:
            self._journal.close()
        if self._store is not None:
            self._store.close()
        self._leave = self._journal = self._store = None


def _new_journal(folder: Path) -> Journal:
    """Begin the journal of a run; raises ``InputError`` where the folder cannot be written."""
    try:
        return Journal(folder)
    except OSError as error:
        raise InputError(
            f"The run cannot be kept: {error.strerror or error}.",
            str(folder.parent),
            "Name a folder that can be written (--runs, or TOUCHDOWN_DATA).",
        ) from error
