"""Child of the figures of failing workers: a window of which one worker fails or asks to quit.

``worker KIND WAY``: the process of a training, or the thread of the bench, fails that way; prints
one JSON object with the seconds until a card named it and until everything was closed. ``quit
THREAD``: that thread asks for the end; prints when it did, and the process ends.
"""

import json
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import psutil
from PySide6.QtCore import QEventLoop, QMetaObject, Qt
from PySide6.QtWidgets import QApplication

from tests.app.tiny_packs import write_tiny_packs
from touchdown.app.application import TouchdownApp
from touchdown.app.shell import ErrorBox, exit_after_timeout, install_error_hooks
from touchdown.app.train.workspace import TrainWorkspace
from touchdown.backend.bench import Session, simulated_session
from touchdown.backend.runs import RecordingOptions, SceneChoice

LIMIT_S = 180.0
# failure of a process; the first, second and last by ``HOOKS`` inside it
WAYS = {
    "raises": signal.SIGUSR1,
    "leaves": signal.SIGUSR2,
    "killed": signal.SIGKILL,
    "crashes": signal.SIGSEGV,
    "stopped": signal.SIGSTOP,
    "deadlock": signal.SIGRTMIN,
}
# sitecustomize.py, imported by every interpreter with its folder on the path
HOOKS = """
import os, signal, threading, time

def note():
    with open(os.path.join(os.path.dirname(__file__), str(os.getpid())), "w") as file:
        file.write(str(time.monotonic()))

def raises(number, frame):
    note()
    raise RuntimeError("as was wanted")

def deadlock(number, frame):
    note()
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()

signal.signal(signal.SIGUSR1, raises)
signal.signal(signal.SIGUSR2, lambda number, frame: os._exit(3))
signal.signal(signal.SIGRTMIN, deadlock)
"""
# threads of a window that may request its end
THREADS = ("connect", "bench", "training", "saving", "another")


class Watched:
    """A window in a folder of its own; ``pump`` lets it live."""

    def __init__(self, folder: Path) -> None:
        self.application = QApplication.instance() or QApplication([])
        self.folder, box = folder, ErrorBox()
        self.restore = install_error_hooks(box)
        self.main = TouchdownApp(self.application, box, folder / "window.json", folder / "runs")
        self.main.start()

    def pump(self, there: Callable[[], bool]) -> float:
        """Live until ``there``; return how long it took. Raises ``TimeoutError``."""
        begun_s = time.monotonic()
        while not there():
            self.application.processEvents(QEventLoop.ProcessEventsFlag.WaitForMoreEvents, 5)
            if time.monotonic() - begun_s > LIMIT_S:
                raise TimeoutError(f"nothing after {LIMIT_S:g} s; cards {self.main.cards.codes}")
        return time.monotonic() - begun_s

    def close(self) -> float:
        begun_s = time.monotonic()
        self.main.quit_at_once()
        self.main.close()
        took_s = time.monotonic() - begun_s
        self.restore()
        return took_s

    def train(self) -> TrainWorkspace:
        """Make an endless training ready to be started."""
        data = self.folder / "packs"
        data.mkdir()
        write_tiny_packs(data)
        self.main.go("train")
        train = self.main.workspaces["train"]
        assert isinstance(train, TrainWorkspace)
        train.take_folder(data)
        self.pump(lambda: train.page.form.start.isEnabled())
        for name, value in {"hidden": 8, "epochs": 100_000, "layers": 1}.items():
            getattr(train.page.form, name).setValue(value)
        self.pump(lambda: train._worker is not None and not train._worker.busy)
        return train

    def training(self) -> int:
        """Begin it; return the number of its process once it is at work."""
        return self.begin(self.train())

    def begin(self, train: TrainWorkspace) -> int:
        """Begin the training that is ready; return its process' number once it is at work."""
        presenter = train.presenter
        assert presenter is not None
        presenter.start()
        self.pump(lambda: len(presenter._epochs_s) >= 1)
        assert presenter.thread is not None
        assert presenter.thread._training is not None
        number = presenter.thread._training.pid
        assert number is not None
        return number

    def bench(self) -> Session:
        session = simulated_session(keep=RecordingOptions(self.folder / "runs"))
        session.prepare(SceneChoice())
        self.main.attach(session)
        self.pump(lambda: session.clock_s() > 0.3)
        return session


def failed_s(number: int, asked_s: float) -> float:
    """Return when the process ``number`` failed that was asked to at ``asked_s``."""
    for folder in os.environ.get("PYTHONPATH", "").split(os.pathsep):
        noted = Path(folder) / str(number)
        if noted.is_file() and noted.stat().st_size:
            return float(noted.read_text())
    return asked_s


def fail(window: Watched, kind: str, way: str) -> dict[str, object]:
    before = set(psutil.Process().children(recursive=True))
    codes = window.main.cards.codes
    number = window.training() if kind == "training" else os.getpid()
    session = window.bench() if kind == "bench" else None
    asked_s = time.monotonic()
    if session is None:
        os.kill(number, WAYS[way])
    else:
        _break_bench(session, way)
    window.pump(lambda: set(window.main.cards.codes) != set(codes))
    told_s = time.monotonic() - failed_s(number, asked_s)
    named = ", ".join(sorted(set(window.main.cards.codes) - set(codes)))
    closed_s = window.close()
    left = set(psutil.Process().children(recursive=True)) - before
    return {"told_s": told_s, "named": named, "closed_s": closed_s, "left": len(left)}


def _break_bench(session: Session, way: str) -> None:
    def fails() -> None:
        if way == "deadlock":
            threading.Event().wait()
        raise RuntimeError("as was wanted")

    session.advance = fails  # type: ignore[method-assign]


def ask(window: Watched, thread: str) -> None:
    """Let ``thread`` ask for the end, as soon as it is at work."""

    def leave() -> None:
        say(f"{time.monotonic()}")
        QMetaObject.invokeMethod(window.application, "quit", Qt.ConnectionType.QueuedConnection)

    if thread == "bench":
        session = window.bench()
        step = session.advance
        asked = threading.Event()

        def advance() -> None:
            step()
            if not asked.is_set():
                asked.set()
                leave()

        session.advance = advance  # type: ignore[method-assign]
    elif thread == "connect":

        def make() -> Session:
            session = simulated_session(keep=RecordingOptions(None))
            leave()
            return session

        window.main.connect_bench(make)
    elif thread in ("training", "saving"):
        _ask_in_train(window, thread, leave)
    else:
        threading.Thread(target=leave).start()
    window.application.exec()


def _ask_in_train(window: Watched, thread: str, leave: Callable[[], None]) -> None:
    train = window.train()
    assert train._worker is not None
    assert train.presenter is not None
    if thread == "saving":
        train._worker.submit(leave, _nothing, _nothing)
        return
    put, asked = train._worker.put, threading.Event()

    def hand_over(letter: Callable[[], None]) -> None:
        put(letter)
        if threading.current_thread().name == "training" and not asked.is_set():
            asked.set()
            leave()

    train._worker.put = hand_over  # type: ignore[method-assign]
    train.presenter.start()


def _nothing(*_: object) -> None:
    pass


def say(text: str) -> None:
    """Print a line for the process that began this one."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def main(words: list[str]) -> int:
    with tempfile.TemporaryDirectory() as name:
        window = Watched(Path(name))
        if words[0] == "worker":
            say(json.dumps(fail(window, *words[1:])))
        else:
            ask(window, words[1])
            window.close()
    exit_after_timeout()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
