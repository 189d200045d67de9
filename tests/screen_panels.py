"""States that need more than the stand-in bench: devices, jogging, wizards, models."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

from PySide6.QtWidgets import QFileDialog

from tests.app.tiny_packs import write_tiny_packs
from tests.backend.rig.scripted import ScriptedDevice, scripted
from tests.backend.runs.test_calibrated import SEEN
from touchdown.app.calibrate.presenter import CalibratePresenter
from touchdown.app.connect.devices import DevicesPresenter
from touchdown.app.connect.presenter import ConnectPresenter
from touchdown.app.shell import bench_caption
from touchdown.backend.bench.laboratory import calibrations_of, find_camera_conflicts
from touchdown.backend.calibration.records import CalibrationStore, DeviceName
from touchdown.backend.config import BenchDescription, TrainingSettings, load_lab
from touchdown.backend.core.events import (
    ActionChosen,
    CalibrationMeasured,
    HandOverAwaited,
    OutcomeAwaited,
    Paused,
    Said,
    SetUpAwaited,
    TrialFinished,
    TrialStarted,
)
from touchdown.backend.core.faults import Fault, FaultError
from touchdown.backend.core.values import Outcome
from touchdown.backend.devices.jog import JogRange, axes_of
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.identification.estimates import PARAMETERS
from touchdown.backend.learning.training_runs import RecordedTraining, TrainingRequest
from touchdown.backend.rig.connection import BenchConnection
from touchdown.backend.runs.outcome import outcome_from_signals
from touchdown.backend.runs.recorder import CONSEQUENCE, NEXT_STEP
from touchdown.backend.runs.requests import RunState
from touchdown.widgets.base import tr

if TYPE_CHECKING:
    from tests.app.stand_in import StandInBench
    from tests.screens import Stage

CLEAR_MM = 24.0  # height of the face over the surface while the hand is jogged
REPORT = Path(__file__).parents[1] / "docs/results/tables-full.json"
RECORDING = Path(__file__).parent / "data/foreign/press.mcap"
DAY_NAMES = (
    *(f"{side}_{key}" for key in ("markers", "noise_px") for side in ("left", "right")),
    "wrist_noise_n", "wrist_drift_n_min",
    *(f"{side}_{key}" for key in ("offset_px", "stiffness_px_n") for side in ("left", "right")),
)  # fmt: skip
PAYLOAD = CalibrationMeasured(
    0.0, "payload",
    names=("mass_kg", "com_x_mm", "com_y_mm", "com_z_mm"), values=(1.502, -0.3, 0.1, 62.4),
    sigmas=(0.004, 0.15, 0.15, 0.4), units=("kg", "mm", "mm", "mm"),
    residuals=(0.05, 0.08, 0.11, 0.06, 0.09, 0.07), residual=0.11, limit=0.3, unit="N",
    note="The hand was turned to six attitudes.", obstacle="",
)  # fmt: skip
LAB = """\
version = 1
name = "Bench 2"
kind = "hardware"

[melfa]
host = "192.168.0.20"

[wsg]
host = "192.168.0.30"

[ft]
driver = "dynpick"
address = "/dev/serial/by-id/usb-FTDI_FT232R_AB0L1XYZ-if00-port0"

[gelsight]
left = { serial = "2D8Y-69GR" }
right = { serial = "2D8Y-70GT" }
"""
FULL = Fault("DISK-FULL", "Only 0.42 GB are free on the disk of the dataset.", CONSEQUENCE,
             NEXT_STEP)  # fmt: skip


class Hand:
    """Hand that can be jogged everywhere in air, and only upwards in contact."""

    rotates, powered, active, holding, switching = True, True, False, True, False

    def __init__(self, bench: StandInBench) -> None:
        self._bench = bench
        self.jog = SimpleNamespace(
            active=False,
            state=SimpleNamespace(order=None, speed=0.0, slow=""),
            rooms=self._rooms,
            end=lambda hold: None,
        )

    @property
    def surface_mm(self) -> float:
        return float(self._bench.contact_z_mm)

    @property
    def pressing_n(self) -> float:
        return 7.8 if self._bench.press else 0.0

    def _rooms(self, _frame: str) -> dict[str, JogRange]:
        axes = (f"{sign}{axis}" for sign in "+-" for axis in axes_of("XYZ"))
        rooms = {axis: JogRange(24.0 if axis[1] in "xyz" else 0.26) for axis in axes}
        rooms["-z"] = JogRange(float(self._bench.clear_mm))
        if self._bench.press:
            why = {axis: "DRAGGING" if axis[1] in "xy" else "TURN-PRESSING" for axis in rooms}
            rooms |= {axis: JogRange(0.0, why[axis]) for axis in rooms if axis[1] != "z"}
            rooms["-z"] = JogRange(1.0)
        return rooms


def train_models(folder: Path) -> None:
    folder.mkdir()
    write_tiny_packs(folder)
    for modality, layers in (("FT+Tac", 1), ("FT", 2)):
        settings = TrainingSettings(
            modality=modality, hidden=12, layers=layers, epochs=6, batch=8, seed=1
        )
        for _ in RecordedTraining(TrainingRequest(folder, "pot", settings)).reports():
            pass


def by_hand(stage: Stage) -> Iterator[str]:
    """Jog pads with their ranges: hold, step, and keys."""
    main, page = stage.main, stage.main.workspaces["operate"].page
    main.go("operate")
    page.jog.show_turning("")
    stage.live(0.0)
    yield "operate-jog"
    page.jog.pace.steps[3].setChecked(True)
    page.jog.show_armed(True)
    stage.settle()
    yield "operate-step-armed"
    page.jog.show_armed(False)
    page.jog.turn.click()
    stage.settle()
    yield "operate-turn"
    page.jog.turn.click()
    page.jog.pace.steps[0].setChecked(True)
    stage.live(0.0)


def beside_the_queue(stage: Stage) -> Iterator[str]:
    """Panels beside the queue: agreement, log, bulk edit, health; random audit; empty queue."""
    label = stage.main.workspaces["collect"].label
    page = label.label_page
    for tab, name in ((1, "agree"), (2, "log"), (3, "bulk"), (4, "health")):
        page.side.choose(tab)
        label.tools.side.show("")
        stage.settle()
        yield f"label-{name}"
    page.side.choose(0)
    for queue in ("audit", "conflicts"):
        page.queue.setCurrentIndex(page.queue.findData(queue))
        label._choose_queue(queue)
        stage.settle()
        yield f"label-queue-{queue}"
    page.queue.setCurrentIndex(page.queue.findData("unlabelled"))
    label._choose_queue("unlabelled")
    stage.settle()


def imported(stage: Stage) -> Iterator[str]:
    """Import of a recording, before a file is chosen and with contradictions of its mapping."""
    stage.main.actions.action("collect.import").trigger()
    sheet = stage.main.workspaces["collect"].recordings
    stage.settle()
    yield "import"
    sheet.take(RECORDING)
    stage.until(sheet.preview.isEnabled)
    sheet.read()
    stage.until(sheet.preview.isEnabled)
    yield "import-contradicted"
    sheet.close()


def reviewed(stage: Stage, runs: Path) -> Iterator[str]:
    """A recorded run with its pictures, then a series of the dataset."""
    recorded = stage.recorded.run_folder
    shutil.copytree(recorded, runs / recorded.name)
    workspace = stage.main.workspaces["review"]
    workspace.presenter.recordings.refresh()
    stage.until(lambda: not workspace.reader.busy)
    for row, name in ((0, "run"), (1, "series")):
        workspace.page.runs.setCurrentIndex(workspace.page.runs.model().index(row, 0))
        stage.until(lambda: not workspace.reader.busy)
        yield f"review-{name}"
    yield from _report(stage, "review-report", (0, 3, -1))


def trained(stage: Stage, packs: Path) -> Iterator[str]:
    """Data with a split; one training, then two compared; a model in use."""
    main, workspace = stage.main, stage.main.workspaces["train"]
    main.go("train")
    workspace.take_folder(packs)
    stage.until(lambda: bool(workspace.presenter.runs) and not workspace._worker.busy)
    yield "train-one"
    runs = [run.uuid for run in workspace.presenter.runs.values()]
    workspace.page.runs.choose(runs[:2])
    stage.until(lambda: not workspace._worker.busy)
    yield "train-compared"
    workspace.presenter._show_progress(tr("epoch {} of {}, about {} left", 3, 16, "4 min"))
    workspace.page.form.divide.setChecked(True)
    stage.until(lambda: not workspace._worker.busy)
    yield "train-leakage"
    workspace.page.form.divide.setChecked(False)


def attended(stage: Stage) -> Iterator[str]:
    """Trial on devices: set the scene, hand the piece over, report the outcome."""
    main, bench, run = stage.main, stage.bench, stage.repeated()
    page = main.workspaces["stack"].page
    main.go("stack")
    page.run.show_devices(True)
    trial = run.until(TrialStarted)
    bench.set_state(RunState.RUNNING, trial=1, trials=2, probe=0, phase="", asks="set the scene")
    bench.events.publish(SetUpAwaited(0.0, "pot", "short", trial.start_mm, holds=False))
    stage.live(0.0)
    yield "stack-set-the-scene"
    bench.set_state(RunState.RUNNING, asks="a hand at the jaws")
    bench.events.publish(HandOverAwaited(0.0, "pot", gives=True))
    stage.live(0.0)
    yield "stack-hand-over"
    while (decided := run.until(ActionChosen)).action.kind != "release":
        pass
    run.until(Said)
    pot = bench.catalogue.piece("pot")
    bench.set_state(RunState.RUNNING, asks="say the outcome", probe=decided.probe)
    bench.events.publish(
        OutcomeAwaited(9.0, *outcome_from_signals(pot, side_n=0.3, left_n=0.1, holding=False))
    )
    stage.live(0.0)
    yield "stack-say-the-outcome"
    yield from _photo(stage)
    why = "Void: the bottom was put in the wrong place."
    bench.events.publish(
        TrialFinished(9.0, 1, trial.seed, Outcome.ABORTED, why, decided.probe, None, None)
    )
    bench.tell_finish()
    bench.set_state(RunState.IDLE, trial=0, probe=0, phase="", asks="")
    stage.live(0.0)
    yield "stack-void"
    page.run.show_devices(False)
    bench.at_mm = None


def _photo(stage: Stage) -> Iterator[str]:
    asks, folder = stage.main.workspaces["stack"].attended, stage.folder / "photographed"
    folder.mkdir()
    stage.main.window.grab().save(str(folder / "bench.png"))
    stage.bench.run_folder = folder
    asks.ask_photo()
    (dialog,) = stage.main.window.findChildren(QFileDialog)
    dialog.setDirectory(str(folder))
    stage.settle()
    yield "stack-photo-dialog"
    dialog.reject()
    asks.add_photo(folder / "bench.png")
    stage.until(lambda: not asks._files.busy)
    yield "stack-photo-kept"
    stage.bench.run_folder = None


def in_large_text(stage: Stage, percent: int) -> Iterator[str]:
    """Label half and report at another font scale."""
    main = stage.main
    main.go("collect")
    main.workspaces["collect"].page.show_half("label")
    stage.settle()
    yield f"text-{percent}-label"
    main.workspaces["collect"].page.show_half("collect")
    main.go("review")
    yield from _report(stage, f"text-{percent}-report", (0, 3))
    yield from _devices(stage, stage.folder / "lab.toml", f"text-{percent}-devices")


def _report(stage: Stage, name: str, rows: tuple[int, ...]) -> Iterator[str]:
    workspace = stage.main.workspaces["review"]
    reports = workspace.reports
    reports.open(REPORT)
    stage.until(lambda: reports.sheet is not None and not workspace.reader.busy)
    for row in rows:
        reports.sheet.parts.setCurrentRow(row % reports.sheet.parts.count())
        stage.until(lambda: not workspace.reader.busy)
        yield f"{name}-{row % reports.sheet.parts.count()}"
    reports.sheet.close()


def _exchanged(folder: Path) -> Path:
    """Write a lab file and a calibration with the cameras of the fingers exchanged."""
    path = folder / "exchanged" / "lab.toml"
    path.parent.mkdir(exist_ok=True)
    template = Path(str(files("touchdown.resources"))) / "benches" / "lab.toml"
    path.write_text(template.read_text().replace("FILL-IN", "2D8Y-69G"))
    lab = load_lab(path)
    cameras = (("left", lab.settings.gelsight.right), ("right", lab.settings.gelsight.left))
    who = {
        f"tactile_{finger}": DeviceName(maker="GelSight", model="Mini", serial=camera.serial)
        for finger, camera in cameras
    }
    calibrations_of(lab).accept(SEEN.to_event(0.0, "camera"), who)
    return path


def _connecting(stage: Stage, folder: Path) -> Iterator[str]:
    main, bench = stage.main, stage.bench
    devices, _ = scripted()
    gripper = devices["gripper"]
    gripper.fails_at, gripper._fail = "configure", lambda _: _refuse(gripper)
    connection = BenchConnection(devices)
    panel = ConnectPresenter(bench, connection, main.window, main.cards, main.panels.limits)
    panel.open()
    yield "connect-closed"
    connection.begin()
    stage.until(lambda: not connection.busy)
    panel.draw(at_once=True)
    yield "connect-failed"
    # Real texts: a lab file with the cameras exchanged.
    lab = load_lab(_exchanged(folder))
    connection.notices = find_camera_conflicts(lab)
    panel.draw(at_once=True)
    yield "connect-exchanged"
    panel.sheet.close()
    connection.close()


def sheets(stage: Stage, folder: Path) -> Iterator[str]:
    """Connect panel, limits, calibration wizard."""
    main, bench = stage.main, stage.bench
    main.go("operate")
    bench.clear_mm = CLEAR_MM
    stage.live(0.0)
    bench.name, facts = "Bench 2", bench.description
    bench.description = BenchDescription(mode="hardware")
    main.window.show_bench(bench_caption(bench))
    yield from _connecting(stage, folder)
    yield from _devices(stage, folder / "lab.toml", "connect-devices")
    bench.name, bench.description = "", facts
    main.window.show_bench(bench_caption(bench))
    main.actions.action("limits").trigger()
    yield "limits"
    main.panels.limits.sheet.edit.click()
    yield "limits-unlocked"
    main.panels.limits.sheet.close()
    bench.calibrations = CalibrationStore(folder / "calibrations", "simulated")
    wizard = CalibratePresenter(bench, main.theme, main.window, main.cards)
    wizard.open()
    stage.settle()
    wizard.draw(at_once=True)
    yield "calibrate"
    wizard._measured["payload"] = PAYLOAD
    wizard.draw(at_once=True)
    yield "calibrate-measured"
    assert wizard.sheet is not None
    wizard._choose(1)
    wizard.draw(at_once=True)
    yield "calibrate-board"
    for day in range(9):
        # The gel of the left finger becomes soft.
        motion = 1.30 + 0.02 * (day % 3) + (0.5 if day == 8 else 0.0)
        values = (63.0, 63.0, 0.025, 0.027, 0.1, 0.02 + 0.005 * (day % 4), 0.08, 0.15, motion, 1.38)
        check = replace(PAYLOAD, what="day", names=DAY_NAMES, values=values)
        bench.day_checks.judge(check, datetime.now(UTC) - timedelta(days=8 - day))
    wizard.open("day")
    stage.settle()
    yield "calibrate-day"
    wizard.sheet.close()
    yield from _identified(wizard, folder)
    bench.calibrations = None


def _identified(wizard: CalibratePresenter, folder: Path) -> Iterator[str]:
    wizard._identify()
    assert wizard.identify is not None
    wizard.identify.dataset.setText("lab/first-day")
    wizard.identify.show_line("fit, round 2: 1,204 of 2,304 ... about 3.5 min left")
    yield "identify"
    reason = (
        "Better: on 30 presses of 5 held-out grippings the error of the prediction is 31 % of that "
        "of the nominal bench; smaller in 5 of 5 grippings."
    )
    keys = (*list(PARAMETERS)[::2], "mu_grip")
    found = {
        "accepted": True, "reason": reason, "report": str(folder / "bench.html"),
        "use": {k: "no, not a setting" if k.startswith("delay.") else "yes" for k in keys},
        "estimates": {key: _estimate(key) for key in keys},
        "names": {key: PARAMETERS[key][5] for key in keys},
    }  # fmt: skip
    wizard.identify.show_end(0, json.dumps(found))
    yield "identify-accepted"
    wizard.identify.close()


def _estimate(key: str) -> list[float | str]:
    """Return a value within the range of a parameter, its uncertainty, and its unit."""
    unit, _, _, low, high, _ = PARAMETERS[key]
    return [0.7 * low + 0.3 * high, 0.02 * (high - low), unit]


def _refuse(gripper: ScriptedDevice) -> None:
    gripper.state = DeviceState.CLOSED
    raise FaultError(Fault("GRIPPER-FORCE", "The gripper refuses a grip force of 10 N.",
                           "Nothing moved.", "Raise its force limit, then press Retry.",
                           "gripper"))  # fmt: skip


def _devices(stage: Stage, file: Path, name: str) -> Iterator[str]:
    bench = stage.bench
    source, bench.limits_source = bench.limits_source, str(file)
    file.write_text(LAB, "utf-8")
    chosen = DevicesPresenter(bench, stage.main.window)
    chosen.open()
    hand, bench.connection = bench.hand, BenchConnection(scripted()[0])  # nothing is plugged in
    bench.hand, bench.simulated = None, False
    bench.frames["left"].clear(), bench.frames["right"].clear(), bench.wrench.clear()
    _show_state(stage, DeviceState.CLOSED)
    yield name
    bench.connection.close()
    bench.hand, bench.simulated, bench.connection = hand, True, None
    _show_state(stage, DeviceState.READY)
    assert chosen.sheet is not None
    chosen.sheet.close()
    bench.limits_source = source


def _show_state(stage: Stage, state: DeviceState) -> None:
    for device in stage.bench.devices.values():
        device.state = state
    stage.main._chips._drawn_s = float("-inf")
    if state is DeviceState.READY:
        stage.live(0.0)
    else:
        stage.bench._now_us += 11_000_000  # longer than the traces
    stage.settle()


def pauses(stage: Stage) -> Iterator[str]:
    """Full disk; question on closing the window."""
    main, bench = stage.main, stage.bench
    main.go("collect")
    bench.set_state(RunState.PAUSED, text=FULL.what)
    bench.events.publish(Paused(0.0, FULL))
    stage.live(0.0)
    yield "collect-disk-full"
    main.cards.clear(main.cards.codes)
    main.go("stack")
    bench.set_state(RunState.RUNNING, trial=1, trials=3, probe=1, phase="press")
    main.window.close()
    stage.settle()
    yield "quit-question"
    main.cards.withdraw()
    bench.set_state(RunState.IDLE, trial=0, trials=0, probe=0, phase="")
