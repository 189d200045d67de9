"""Session on the devices of a lab file.

Nothing is connected at first: ``Session.connect`` or ``session.connection`` does that. The scene is
set once all devices are ready.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from touchdown.backend import calibration
from touchdown.backend.bench.assembly import BenchModels, run_record
from touchdown.backend.bench.session import Session
from touchdown.backend.config import Lab, StackSettings, load_lab
from touchdown.backend.core import BenchClock, InputError, RawStreams, raised_priority
from touchdown.backend.geometry import Piece, PieceLibrary, load_pieces
from touchdown.backend.learning import ModelRegistry
from touchdown.backend.rig import LATE_S, BenchConnection, BenchDevices, FlightRecorder
from touchdown.backend.runs import (
    GelCheck,
    RecordingOptions,
    SceneChoice,
    SceneDevices,
    models_folder,
)
from touchdown.backend.sensing import gripper_payload


@dataclass(frozen=True, slots=True)
class LabChoice:
    """Choice of a laboratory by its file; ``pieces`` is a folder with further piece files.

    ``any_gels``: also connect gels without a calibration, to calibrate them. ``campaign``: on
    hardware, require valid calibrations. ``window``: remedies name the window, not commands.
    """

    file: Path
    pieces: Path | None = None
    any_gels: bool = False
    campaign: bool = False
    window: bool = False


def lab_session(
    choice: LabChoice,
    *,
    keep: RecordingOptions | None = None,
    method: StackSettings | None = None,
    registry: ModelRegistry | None = None,
) -> Session:
    """Return a session on the devices of ``choice``; raises ``InputError`` for an invalid file.

    For a campaign it raises ``RefusedError`` naming the first invalid calibration and the command
    that measures it, before anything is connected. Devices are compared when a run begins. A model
    that fits the first piece is loaded now, since loading later would disturb the arm's stream.
    """
    written, catalogue = load_lab(choice.file), load_pieces(choice.pieces)
    if choice.campaign and written.settings.kind == "hardware":
        calibrations_of(written).in_use({}, required=True)
    lab, seats = written, _seats(written)
    if seats is not None:
        gelsight = calibration.calibrated_cameras(written.settings.gelsight, seats)
        lab = Lab(written.path, written.settings.model_copy(update={"gelsight": gelsight}))
    method = method or StackSettings()
    bench = _LabBench(lab, catalogue, method, registry)
    session = Session(
        bench.make_stage, bench.check, catalogue,
        settings=method, keep=keep or RecordingOptions(), description=lab.facts,
    )  # fmt: skip
    session.identity = written.identity
    store = calibrations_of(lab, window=choice.window)
    connection = bench.wire(session, store, any_gels=choice.any_gels)
    connection.notices = find_camera_conflicts(written, window=choice.window)
    return session


START_SPEED = 0.1  # share of every speed in air, until the operator changes it


def open_lab(
    path: Path | str,
    *,
    method: StackSettings | None = None,
    pieces: Path | str | None = None,
    runs: Path | str | None = None,
    speed: float = START_SPEED,
) -> Session:
    """Return the bench of a lab file; nothing is connected before ``Session.connect``.

    The priority of the calling thread is raised until the session is closed, where the system
    permits it: sensors and arm are served in real time.

    Parameters
    ----------
    path : Path or str
        Lab file (TOML).
    method, pieces, runs
        As of ``simulated_bench``.
    speed : float, default: 0.1
        Share of every speed in air, 0.1 to 1.

    Returns
    -------
    Session
        A context manager. Runs on devices ask their operator: subscribe to ``events`` and reply
        with ``answer``.

    Raises
    ------
    InputError
        If the lab file is invalid or names an unknown piece.

    Examples
    --------
    >>> with open_lab("lab.toml") as bench:  # doctest: +SKIP
    ...     bench.connect(home=True)
    ...     result = bench.run(ProbeRequest())

    """
    with ExitStack() as stack:
        stack.enter_context(raised_priority())  # inherited by all threads of the session
        session = lab_session(
            LabChoice(Path(path), Path(pieces) if pieces else None),
            keep=RecordingOptions(Path(runs) if runs else None),
            method=method,
            registry=ModelRegistry(models_folder()),
        )
        session.resources.push(stack.pop_all())
    session.interlock.override_speed(speed)
    return session


def calibrations_of(lab: Lab, *, window: bool = False) -> calibration.CalibrationStore:
    """Return the calibrations of a laboratory, beside its file or in the configured folder."""
    bench = None if window else f"--bench {shlex.quote(str(lab.path))} --home"
    return calibration.CalibrationStore(lab.calibrations, lab.settings.kind, bench, lab.facts.gels)


def find_camera_conflicts(lab: Lab, *, window: bool = False) -> dict[str, str]:
    """Return by camera its conflict with the calibration, which wins, and a replaced gel."""
    seats, store = _seats(lab), calibrations_of(lab, window=window)
    if seats is None:
        return {}
    step = store.step("camera")
    found = calibration.camera_conflicts(lab.settings.gelsight, seats, step)
    for finger, text in store.gels.replaced_after(seats.file.date).items():
        name, told = f"tactile_{finger}", f"T{text[1:]}: calibration, models and certificates of "
        told += f"the old gel do not hold. {step[:1].upper()}{step[1:]}"
        found[name] = ". ".join(filter(None, (found.get(name), told)))
    return found


def _seats(lab: Lab) -> calibration.CalibrationRecord | None:
    """Return the calibration of the cameras; an expired one still holds for the assignment."""
    kept = calibrations_of(lab).status("camera", {})
    return kept.record if kept.condition in ("valid", "expired", "gel replaced") else None


class _LabBench:
    """Makes the scenes of a laboratory, always with the same devices."""

    def __init__(
        self,
        lab: Lab,
        catalogue: PieceLibrary,
        method: StackSettings,
        registry: ModelRegistry | None,
    ) -> None:
        self._lab, self._catalogue, self._clock = lab, catalogue, BenchClock()
        self._models = BenchModels(registry, lab.facts, method.belief.pitch_mm)
        self._models.since_ns = calibrations_of(lab).gels.replaced_ns()
        first = SceneChoice(lab.settings.piece, tuple(lab.settings.bottom.split("+")))
        self._scene(first)
        try:
            self._models.of(first, catalogue.top(first.piece))
        except InputError:
            # Without a model the bench can be moved, probed and collected on.
            first = SceneChoice(first.piece, first.bottoms, estimates=False)
        self._first = first

    def wire(
        self, session: Session, store: calibration.CalibrationStore, *, any_gels: bool
    ) -> BenchConnection:  # fmt: skip
        """Make the drivers on the streams of ``session``; return their connection."""
        raw, settings, session.usual = session.raw, self._lab.settings, self._first
        now_s, interlock = self._clock.now_s, session.interlock
        self._wired = wired = BenchDevices(settings, now_s, raw, interlock)
        recorder = FlightRecorder(lambda: wired.link.memory, lambda: session.run_folder)
        session.events.subscribe(recorder.note)
        serials = settings.serials.model_dump()
        connection = BenchConnection(wired.devices, serials)

        def set_first() -> None:
            # Devices that were only reconnected keep their scene.
            if session.hand is None:
                session.prepare(self._first)

        connection.when_ready = set_first
        session.calibrations = store
        session.events.subscribe(store.gels.take)
        connection.prove = GelCheck(None if any_gels else store, wired.devices, raw.frames).prove
        session.join(connection, settings.name, settings.limits, str(self._lab.path))
        return connection

    def make_stage(self, choice: SceneChoice, raw: RawStreams) -> SceneDevices:
        """Return the devices as a scene, with the piece and bottom that the operator named."""
        piece, settings, wired = self._scene(choice), self._lab.settings, self._wired
        mounting = settings.mounting
        return SceneDevices(
            clock=self._clock,
            devices=wired.devices,
            arm=wired.arm,
            gripper=wired.gripper,
            piece=piece,
            bottom="+".join(choice.bottoms),
            advance=self._clock.wait,
            scoring=None,
            estimator=self._models.of(choice, piece),
            payload=gripper_payload(mounting.payload_kg, mounting.payload_com_mm),
            outline=self._catalogue.bottom(choice.bottoms[-1]).face,
            wrench_late_s=1e-3 * settings.ft.latency_ms + LATE_S,
            real_time=True,
        )

    def check(self, choice: SceneChoice) -> Mapping[str, object]:
        """Return the settings a run depends on; raises ``InputError`` for an unknown piece."""
        piece = self._scene(choice)
        bench = {"lab": self._lab.settings.model_dump(mode="json")}
        return run_record(bench, self._models.check(choice, piece))

    def _scene(self, choice: SceneChoice) -> Piece:
        for name in choice.bottoms:
            self._catalogue.bottom(name)
        return self._catalogue.top(choice.piece)
