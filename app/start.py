"""Starts Qt, the window and the bench; one-shot modes for pictures and measurements."""

from __future__ import annotations

import argparse
import gc
import json
import sys
from functools import partial
from pathlib import Path

from PySide6.QtCore import QObject, QTimer
from PySide6.QtWidgets import QApplication

from app.application import TouchdownApp
from app.closing import end_for_sure
from app.error_hooks import ErrorBox, install, log_to
from app.link import Link
from app.measure import Measurement
from app.review.workspace import ReviewWorkspace
from app.settings import settings_path
from backend.core.faults import InputError
from backend.runs.store import calibrations_folder, data_folder, models_folder

SWITCH_S = 0.0005
"""Window and bench hand over to each other this often.

A decision is hundreds of short library calls, each of which waits for its turn again. On two busy
cores 2 ms gave a median of 20 ms a decision and 40 ms of lag (p99), 0.5 ms gave 13 ms and 23 ms.
"""


def run(args: argparse.Namespace) -> int:
    """Run the window until it is closed."""
    sys.setswitchinterval(SWITCH_S)
    application = QApplication(sys.argv[:1])
    application.setApplicationName("Touchdown")
    application.setDesktopFileName("touchdown")
    box = ErrorBox()
    restore = install(box)
    log_to(data_folder() / "log")
    path = settings_path()
    if args.reset_layout:
        path.unlink(missing_ok=True)
    main = TouchdownApp(application, box, path, data_folder() / "runs")
    try:
        _show(main, args)
        if args.measure:
            Measurement(main, args.after, _print)
        elif args.grab is not None:
            _Grab(main, args)
        return application.exec()
    finally:
        main.close()
        # What hangs now holds no label and moves nothing.
        end_for_sure()
        restore()


def _show(main: TouchdownApp, args: argparse.Namespace) -> None:
    if args.theme is not None:
        main.look.show(args.theme, main.theme.scale)
    main.start()
    if args.size is not None:
        main.window.resize(*args.size)
    if args.page is not None:
        main.go(args.page)
    elif args.grab is not None or args.measure:
        main.go("stack")
    if args.replay is not None:
        main.go("review")
        review = main.workspaces["review"]
        assert isinstance(review, ReviewWorkspace)
        review.presenter.open(args.replay)
    # Whoever asks for something at the start wants that, not a tour.
    main.tour_due = not (args.grab or args.measure or args.page or args.replay)
    main.connect_bench(partial(bench_of, args.bench, tuple(args.inject)))


def live_bench(settings: Path | None = None, disturbances: tuple[str, ...] = ()) -> Link:
    """Build the simulated bench with a first scene to look at (on the connecting thread).

    ``disturbances``: texts such as ``force_torque:stop@30``, in seconds of the bench clock.
    """
    # Imported here, on the connecting thread: the window is there meanwhile.
    from backend.assembly import SimulatedBenchChoice, simulated_session
    from backend.calibration.store import CalibrationStore
    from backend.learning.registry import Registry
    from backend.runs.requests import SceneChoice
    from backend.session import Keep
    from backend.simulation.release_mujoco import available

    session = simulated_session(
        SimulatedBenchChoice(file=settings, disturbances=disturbances),
        keep=Keep(data_folder() / "runs"),
        # Asked, it is loaded: while that goes on nothing else runs, for 70 to 130 ms, and at the
        # first release the window stood still that long.
        animate=available(),
        registry=Registry(models_folder()),
    )
    session.calibrations = CalibrationStore(calibrations_folder(), "simulated")
    session.prepare(SceneChoice())
    settle_memory()
    return session


def bench_of(file: Path | None, disturbances: tuple[str, ...] = ()) -> Link:
    """Build the bench of a file: a lab's devices, not yet connected, or a simulated bench.

    Raises ``InputError`` for ``disturbances`` of a lab's devices.
    """
    from backend.config.lab import is_lab_file

    if file is None or not is_lab_file(file):
        return live_bench(file, disturbances)
    if disturbances:
        raise InputError(
            "Only the simulated bench has faults on demand.",
            "--inject",
            "Leave it out; emulated devices take a fault plan.",
        )
    from backend.lab import LabChoice, lab_session
    from backend.learning.registry import Registry
    from backend.session import Keep

    session = lab_session(
        LabChoice(file), keep=Keep(data_folder() / "runs"), registry=Registry(models_folder())
    )
    settle_memory()
    return session


def settle_memory() -> None:
    """Take everything loaded so far out of the garbage collector's sight.

    Modules, widgets and models stay until the end. Each full collection walked all of them, and
    stopped window and bench for 100 ms, now and then in the middle of a decision.
    """
    gc.collect()
    gc.freeze()


class _Grab(QObject):
    """Starts a run once the bench is there and saves a picture after a while."""

    def __init__(self, main: TouchdownApp, args: argparse.Namespace) -> None:
        super().__init__(main)
        self._main, self._file = main, args.grab
        self._timer = QTimer(main)
        self._timer.timeout.connect(self._started)
        self._timer.start(100)
        self._wait_ms = int(1000 * args.after)
        self._replay, self._starts = args.replay is not None, args.page in (None, "stack")

    def _started(self) -> None:
        if self._main.link is None and not self._replay and not self._main.cards.codes:
            return
        self._timer.stop()
        if self._main.link is not None and not self._replay and self._starts:
            self._main.actions.action("stack.start").trigger()
        QTimer.singleShot(self._wait_ms, self._main, self._save)

    def _save(self) -> None:
        self._main.window.grab().save(str(self._file))
        self._main.quit_at_once()


def _print(figures: dict[str, float]) -> None:
    sys.stdout.write(json.dumps(figures) + "\n")
