"""Render pictures and film of README and guide from the simulated bench (``make pictures``).

The bench clock is advanced by the program, so that the pictures are the same on every machine
except for dates and free disk space. No data of this computer are used.
"""

import argparse
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

import cv2
import numpy as np
from PySide6.QtCore import QDeadlineTimer, QEventLoop
from PySide6.QtGui import QImage
from PySide6.QtWidgets import QApplication, QWidget

from tests.picture_files import PictureFiles, run_reporting
from touchdown.app.application import TouchdownApp
from touchdown.app.shell.errors import ErrorBox
from touchdown.backend.bench import Session, simulated_session
from touchdown.backend.cli.command_line import main as touchdown
from touchdown.backend.config.method import TrainingSettings
from touchdown.backend.learning.training_runs import RecordedTraining, TrainingRequest
from touchdown.backend.runs import RecordingOptions, RunState, SceneChoice

SIZE = (1280, 720)
PARTS = ("operate", "stack", "review", "collect", "train", "film")
RECORDING = Path(__file__).parent / "data/foreign/press.mcap"
PERSON = "Ann"
PROBES = 12
PRESSED_S = 1.6  # time after which a press has reached its full force
FILM_SIZE, FILM_QUALITY = (960, 540), 55
FILM_STEP_S, FRAME_MS, LAST_FRAME_MS = 0.5, 100, 3000  # five times the speed of the bench
STEPS = 100_000  # steps of the bench clock after which something has gone wrong


def pixels_of(widget: QWidget) -> Any:
    """Return a picture of a widget as (height, width, 3) bytes, BGR."""
    image = widget.grab().toImage().convertToFormat(QImage.Format.Format_BGR888)
    rows = np.frombuffer(image.constBits(), np.uint8).reshape(image.height(), -1)
    # A copy: the array does not keep the image alive.
    return rows[:, : 3 * image.width()].reshape(image.height(), image.width(), 3).copy()


class SteppedSession:
    """Session without a thread; the caller advances its time."""

    def __init__(self, session: Session) -> None:
        object.__setattr__(self, "session", session)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.session, name)

    def __setattr__(self, name: str, value: object) -> None:
        setattr(self.session, name, value)

    def open(self) -> None:
        """Start nothing."""


class Day:
    """One window on one bench, brought into the states of the pictures."""

    def __init__(self, application: QApplication, folder: Path, files: PictureFiles) -> None:
        self._folder, self._files = folder, files
        runs = folder / "runs"
        self.session = simulated_session(keep=RecordingOptions(runs))
        self.session.prepare(SceneChoice())
        self.main = TouchdownApp(application, ErrorBox(), folder / "window.json", runs)
        self.main.look.show("dark", 1.0)
        self.main.window.show()
        self.main.window.resize(*SIZE)
        self.main.attach(SteppedSession(self.session))  # type: ignore[arg-type]
        # Judge the age of data by the bench clock: rendering takes long.
        live = [getattr(workspace, "live", None) for workspace in self.main.workspaces.values()]
        for follower in (self.main._chips, *filter(None, live)):
            follower._now_s = self.session.clock_s

    def until(self, there: Callable[[], bool]) -> None:
        for count in range(STEPS):
            self.session.engine.tick()
            self.session.advance()
            if count % 10 == 0:
                self.main.pump.tick()
                QApplication.processEvents()
                if there():
                    return
        raise RuntimeError(f"The bench did not get there: {self.session.status()}")

    def wait(self, there: Callable[[], bool]) -> None:
        until = QDeadlineTimer(300_000)
        while not there():
            if until.hasExpired():
                raise RuntimeError("The window did not get there.")
            QApplication.processEvents(QEventLoop.ProcessEventsFlag.WaitForMoreEvents, 20)
            self.main.pump.tick()

    def idle(self) -> bool:
        return self.session.status().state is RunState.IDLE

    def go_on(self) -> None:
        until_s = self.session.clock_s() + PRESSED_S
        self.until(lambda: self.session.clock_s() > until_s)

    def press(self, probe: int) -> None:
        """Advance to the full force of the press of this probe."""
        status = self.session.status
        self.until(lambda: (status().probe, status().phase) == (probe, "press"))
        self.go_on()

    def grab(self, name: str, theme: str = "dark", widget: QWidget | None = None) -> None:
        self.main.look.show(theme, 1.0)
        for _ in range(20):
            self.main.pump.tick()
            QApplication.processEvents()
        # The lowest bit is camera noise and takes a sixth of the file.
        pixels = pixels_of(widget or self.main.window) & 0xFE
        _, png = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        self._files.keep(f"{name}.png", png.tobytes())
        self.main.look.show("dark", 1.0)

    def stack(self) -> None:
        main, workspace = self.main, self.main.workspaces["stack"]
        main.go("stack")
        self.until(lambda: main.bar.pill.state.word == "READY")
        workspace.page.run._trials.setValue(1)
        main.actions.action("stack.start").trigger()
        self.press(3)
        self.grab("stack-light", "light")
        self.until(lambda: workspace.presenter.story.ended is not None)
        self.go_on()

    def film(self) -> None:
        """Record a stacking run of one trial as an animation."""
        main, workspace = self.main, self.main.workspaces["stack"]
        main.go("stack")
        self.until(lambda: main.bar.pill.state.word == "READY")
        workspace.page.run._trials.setValue(1)
        main.actions.action("stack.start").trigger()
        story, frames = workspace.presenter.story, list[Any]()
        self.until(lambda: story.head is not None and story.ended is None)
        while story.ended is None:
            next_s = self.session.clock_s() + FILM_STEP_S
            self.until(
                lambda at_s=next_s: (
                    self.session.clock_s() > at_s or workspace.presenter.story.ended is not None
                )
            )
            frames.append(
                cv2.resize(pixels_of(self.main.window), FILM_SIZE, interpolation=cv2.INTER_AREA)
            )
        self.go_on()
        frames.append(
            cv2.resize(pixels_of(self.main.window), FILM_SIZE, interpolation=cv2.INTER_AREA)
        )
        film = cv2.Animation()
        film.frames = frames
        film.durations = [FRAME_MS] * (len(frames) - 1) + [LAST_FRAME_MS]
        quality = [cv2.IMWRITE_WEBP_QUALITY, FILM_QUALITY]
        _, webp = cv2.imencodeanimation(".webp", film, quality)
        self._files.keep("stack-run.webp", webp.tobytes())

    def operate(self) -> None:
        self.main.go("operate")
        self.until(lambda: self.main.bar.pill.state.word == "READY")
        self.main.actions.action("operate.probe").trigger()
        self.press(1)
        self.until(lambda: self.session.status().phase == "lift")
        self.grab("operate")
        self.until(self.idle)

    def collect(self) -> None:
        """Collect a small campaign, then open its first probe for labelling."""
        main, workspace = self.main, self.main.workspaces["collect"]
        main.go("collect")
        self.until(lambda: main.bar.pill.state.word == "READY")
        workspace.label.be(PERSON)
        self.wait(lambda: workspace.presenter.dataset is not None)
        target = workspace.collect_page.target
        target.count.setValue(PROBES)
        target.ask.setChecked(False)
        main.actions.action("collect.start").trigger()
        dataset = workspace.presenter.dataset
        self.until(lambda: self.idle() and len(dataset.episodes()) == PROBES)
        self.wait(lambda: not workspace.reader.busy)
        self.grab("collect")
        main.actions.action("collect.import").trigger()
        sheet = workspace.recordings
        sheet.take(RECORDING)
        self.wait(sheet.preview.isEnabled)
        sheet.read()
        self.wait(sheet.preview.isEnabled)
        self.grab("import", widget=sheet)
        sheet.close()
        workspace.page.show_half("label")
        label = workspace.label
        self.wait(lambda: label.presenter is not None and label.presenter.walk.begun)
        self.wait(lambda: not label.label_page.nothing.isVisible() and not label.worker.busy)
        self.grab("label")
        workspace.page.show_half("collect")

    def train(self) -> None:
        packs = self._folder / "packs"
        plan = "--piece pot --episodes 300 --probes-per-grip 10 --grips-per-mounting 1 --workers 1"
        if touchdown(["simulate", *plan.split(), "--out", str(packs)]):
            raise RuntimeError("No packs could be simulated.")
        for modality in ("FT", "FT+Tac"):
            settings = TrainingSettings(modality=modality, hidden=48, layers=1, epochs=10, seed=1)
            for _ in RecordedTraining(TrainingRequest(packs, "pot", settings)).reports():
                QApplication.processEvents()
        workspace = self.main.workspaces["train"]
        self.main.go("train")
        self.go_on()
        workspace.take_folder(packs)
        self.wait(lambda: bool(workspace.presenter.runs) and not workspace._worker.busy)
        self.wait(lambda: workspace.page.form.start.isEnabled() and not workspace._worker.busy)
        self.grab("train")

    def review(self) -> None:
        self.main.go("review")
        workspace = self.main.workspaces["review"]
        self.wait(lambda: not workspace.presenter.recordings.describing)
        workspace.page.runs.setCurrentIndex(workspace.page.runs.model().index(0, 0))
        self.wait(lambda: not workspace.presenter.reading and not workspace.reader.busy)
        self.grab("review")

    def close(self) -> None:
        self.main.quit_at_once()
        self.main.close()


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.pictures", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/img"))
    parser.add_argument("--only", nargs="*", default=list(PARTS), choices=PARTS,
                        help="these alone; review shows what stack leaves")  # fmt: skip
    args = parser.parse_args(argv)
    return run_reporting(lambda: draw(args.out, args.only))


def draw(out: Path, parts: Sequence[str]) -> int:
    """Render these parts of the day; writes all of their pictures to ``out`` or none."""
    files = PictureFiles(out)
    with tempfile.TemporaryDirectory() as folder:
        for name in ("TOUCHDOWN_DATA", "TOUCHDOWN_CONFIG"):
            os.environ[name] = folder
        os.environ["USER"] = os.environ["LOGNAME"] = PERSON
        day = Day(QApplication([]), Path(folder), files)
        try:
            for part in parts:
                getattr(day, part)()
            files.put()
        finally:
            day.close()
            files.drop()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
