"""Start of the window: bench, style, error hooks, application."""

from __future__ import annotations

import argparse
import gc
import os
import sys
from functools import partial
from pathlib import Path

from PySide6.QtCore import QObject, QTimer
from PySide6.QtWidgets import QApplication

from touchdown.app.application import TouchdownApp, call_glibc
from touchdown.app.review import ReviewWorkspace
from touchdown.app.shell import ErrorBox, exit_after_timeout, install_error_hooks, log_to
from touchdown.app.splash import Splash
from touchdown.backend.bench import Session
from touchdown.backend.core import CommandNotifier, InputError, config_folder, data_folder
from touchdown.backend.runs import calibrations_folder, models_folder

# Switch interval of the interpreter. A decision makes hundreds of short library calls, each of
# which waits for the interpreter lock. On two busy cores 2 ms gave a median of 20 ms per decision
# and 40 ms of lag (p99), 0.5 ms gave 13 ms and 23 ms.
THREAD_SWITCH_S = 0.0005
ARENAS, M_ARENA_MAX = 2, -8  # an arena of glibc for each thread held 34 MB more, unused
# A block from this size on, such as a tactile frame of 230 kB, goes back to the system when freed.
# Otherwise glibc raises the limit, and frames of former runs leave up to 170 MB unused in the heap.
MAPPED_BYTES, M_MMAP_THRESHOLD = 200_000, -3
NOTIFY_S = 3.0  # a command that calls a person may take so long while the window closes


def run(args: argparse.Namespace, application: QApplication, splash: Splash) -> int:
    """Run the window until it is closed."""
    tune_interpreter()
    splash.tell("Building the window")
    box = ErrorBox()
    restore = install_error_hooks(box)
    writable = log_to(data_folder() / "log") is not None
    path = config_folder() / "window.json"
    if args.reset_layout:
        path.unlink(missing_ok=True)
    notifier = CommandNotifier(args.notify) if args.notify else None
    main = TouchdownApp(application, box, path, data_folder() / "runs", notifier)
    if not writable:
        main.warn_unwritable(data_folder())
    try:
        _show(main, args)
        splash.close()
        if args.grab is not None:
            _WindowGrab(main, args)
        status = application.exec()
    finally:
        main.close()
        if notifier is not None:
            notifier.close(NOTIFY_S)
        # Threads that still hang hold no labels and move nothing.
        exit_after_timeout()
        restore()
    if main.next_bench is not None:
        sys.stdout.flush()
        os.execv(sys.executable, command_with_bench(main.next_bench, args))  # noqa: S606 - the same program
    return status


def command_with_bench(file: Path, args: argparse.Namespace) -> list[str]:
    """Return the command that opens the window on another bench, otherwise with ``args``."""
    kept = (("bench", file.absolute()), *((k, getattr(args, k)) for k in ("notify", "live")))
    options = [f"--{name}={value}" for name, value in kept if value]
    return [sys.executable, "-m", "touchdown", "app", *options]


def tune_interpreter() -> None:
    """Pass the interpreter lock on more often, and let ``malloc`` keep less unused memory."""
    sys.setswitchinterval(THREAD_SWITCH_S)
    call_glibc("mallopt", M_ARENA_MAX, ARENAS)
    call_glibc("mallopt", M_MMAP_THRESHOLD, MAPPED_BYTES)


def _show(main: TouchdownApp, args: argparse.Namespace) -> None:
    if args.theme is not None:
        main.look.show(args.theme, main.theme.scale)
    main.start()
    if args.size is not None:
        main.window.resize(*args.size)
    if args.page is not None:
        main.go(args.page)
    elif args.grab is not None:
        main.go("stack")
    if args.replay is not None:
        main.go("review")
        review = main.workspaces["review"]
        assert isinstance(review, ReviewWorkspace)
        review.presenter.open(args.replay)
    # No tour if the command line asks for something else.
    main.tour_due = not (args.grab or args.page or args.replay)
    main.connect_bench(partial(_open_bench, args), args.bench)


def _open_bench(args: argparse.Namespace) -> Session:
    session = open_bench(args.bench, tuple(args.inject))
    if args.live:
        from touchdown.backend.bench import serve_live

        try:
            sys.stderr.write(f"{serve_live(session, args.live)}\n")
        except InputError:
            session.close()
            raise
    return session


def open_simulated_bench(
    settings: Path | None = None, disturbances: tuple[str, ...] = ()
) -> Session:
    """Build the simulated bench with a first scene. Called on the connecting thread.

    ``disturbances``: texts such as ``force_torque:stop@30``, in seconds of the bench clock.
    """
    # Imported on the connecting thread, so that the window appears first.
    from touchdown.backend.bench import SimulatedBenchChoice, simulated_session
    from touchdown.backend.calibration import CalibrationStore
    from touchdown.backend.learning import ModelRegistry
    from touchdown.backend.runs import RecordingOptions, SceneChoice
    from touchdown.backend.simulation import mujoco_available

    session = simulated_session(
        SimulatedBenchChoice(file=settings, disturbances=disturbances),
        keep=RecordingOptions(data_folder() / "runs"),
        # The check loads MuJoCo, which takes 70 to 130 ms. Later, at the first release, that would
        # stop the window.
        animate=mujoco_available(),
        registry=ModelRegistry(models_folder()),
    )
    session.calibrations = CalibrationStore(calibrations_folder(), "simulated", where=None)
    session.prepare(SceneChoice())
    freeze_garbage()
    return session


def open_bench(file: Path | None, disturbances: tuple[str, ...] = ()) -> Session:
    """Build the bench of a file: the devices of a lab, not yet connected, or a simulated bench.

    Raises ``InputError`` for ``disturbances`` of real devices.
    """
    from touchdown.backend.config import is_lab_file

    if file is None or not is_lab_file(file):
        return open_simulated_bench(file, disturbances)
    if disturbances:
        fix = "Leave it out; emulated devices take a fault plan."
        raise InputError("Only the simulated bench has faults on demand.", "--inject", fix)
    from touchdown.backend.bench import LabChoice, lab_session
    from touchdown.backend.learning import ModelRegistry
    from touchdown.backend.runs import RecordingOptions

    session = lab_session(
        LabChoice(file, window=True),
        keep=RecordingOptions(data_folder() / "runs"),
        registry=ModelRegistry(models_folder()),
    )
    freeze_garbage()
    return session


def freeze_garbage() -> None:
    """Exclude all objects created so far from garbage collection.

    Modules, widgets and models live until the end. Each full collection visited all of them and
    stopped window and bench for 100 ms, sometimes during a decision.
    """
    gc.collect()
    gc.freeze()


class _WindowGrab(QObject):
    """Starts a run once the bench is attached and saves a picture after a while."""

    def __init__(self, main: TouchdownApp, args: argparse.Namespace) -> None:
        super().__init__(main)
        self._main, self._file = main, args.grab
        self._timer = QTimer(main)
        self._timer.timeout.connect(self._started)
        self._timer.start(100)
        self._wait_ms = int(1000 * args.after)
        self._replay, self._starts = args.replay is not None, args.page in (None, "stack")

    def _started(self) -> None:
        if self._main.bench is None and not self._replay and not self._main.cards.codes:
            return
        self._timer.stop()
        if self._main.bench is not None and not self._replay and self._starts:
            self._main.actions.action("stack.start").trigger()
        QTimer.singleShot(self._wait_ms, self._main, self._save)

    def _save(self) -> None:
        self._main.window.grab().save(str(self._file))
        self._main.quit_at_once()
