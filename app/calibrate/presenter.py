"""Presenter of the calibration panel."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from PySide6.QtWidgets import QWidget

from touchdown.app import shell
from touchdown.app.calibrate.identify import IdentifySheet
from touchdown.app.calibrate.sheet import CalibrateSheet, CalibrationView, PlaceForm
from touchdown.backend import core, runs
from touchdown.backend.bench import Session
from touchdown.backend.calibration import (
    MEASUREMENT_NAMES,
    CalibrationName,
    CalibrationStatus,
    DayCheck,
)
from touchdown.widgets.base import Age, Theme, count_noun, tr, true_minus
from touchdown.widgets.shell import FaultCards

# Message after accepting a result that needs another step.
AFTER: dict[CalibrationName, str] = {
    "camera": ". The pictures stay as they are until the bench is started again: close the window "
    "and open it again."
}


PERIOD_S = 0.1
STANDINGS_S = 5.0
FRESH_S = 0.5
NO_STORE = "This bench keeps no calibrations"


class CalibratePresenter:
    """Keeps one calibration sheet per bench. A run started elsewhere is waited for."""

    def __init__(self, bench: Session, theme: Theme, window: QWidget, cards: FaultCards) -> None:
        self._bench, self._theme, self._window, self._cards = bench, theme, window, cards
        self.sheet: CalibrateSheet | None = None
        self.identify: IdentifySheet | None = None
        self.open_bench: Callable[[Path], None] = lambda file: None
        self._chosen: CalibrationName = MEASUREMENT_NAMES[0]
        self._running: CalibrationName | None = None
        self._progress = core.Progress(0.0, 0, 1, "")
        self._measured: dict[CalibrationName, core.CalibrationMeasured] = {}
        self._said: dict[CalibrationName, str] = {}
        self._standings: dict[CalibrationName, CalibrationStatus] = {}
        self._history: tuple[DayCheck, ...] = ()
        self._drawn_s = self._read_s = float("-inf")

    def open(self, what: CalibrationName | None = None) -> None:
        """Show the calibration sheet, with ``what`` selected."""
        self._chosen = what or self._chosen
        if self.sheet is None:
            catalogue = self._bench.catalogue
            form = PlaceForm(catalogue.tops, catalogue.bottoms, self._usual())
            self.sheet = CalibrateSheet(self._window, self._theme, form)
            self.sheet.group.idClicked.connect(self._choose)
            self.sheet.measure.clicked.connect(self._measure)
            ask = self.sheet.question.ask
            self.sheet.open_it.clicked.connect(
                lambda: shell.open_gripper(self._bench, self._cards, ask)
            )
            for button in (self.sheet.cancel, self.sheet.question.no):
                button.clicked.connect(lambda: self._bench.engine.cancel())
            self.sheet.accept_it.clicked.connect(self._accept)
            self.sheet.identify.clicked.connect(self._identify)
        self._read_s = float("-inf")
        self.draw(at_once=True)
        self.sheet.present()

    def _usual(self) -> runs.CalibrateRequest:
        usual, on_bench = runs.CalibrateRequest("board"), self._bench.usual
        if self._bench.simulated:
            return usual
        return replace(usual, piece=on_bench.piece, bottom=on_bench.bottoms[-1])

    def take(self, event: core.Event) -> None:
        """Follow calibration runs, also those started elsewhere."""
        if isinstance(event, core.RunStarted):
            known = {str(what): what for what in MEASUREMENT_NAMES}
            self._running = known.get(event.strategy) if event.activity == "calibrate" else None
            self._progress = core.Progress(event.t_s, 0, 1, "")
            return
        if self._running is None:
            return
        if isinstance(event, core.Progress):
            self._progress = event
        elif isinstance(event, core.CalibrationMeasured):
            if self._running != "day":  # which is stored at once
                self._measured[self._running] = event
            self._read_s = float("-inf")
            self._said.pop(self._running, None)
        elif isinstance(event, core.HandOverAwaited) and self.sheet is not None:
            answer = self._bench.answer
            self.sheet.question.ask(
                runs.hand_over_message(event), "End the run", "Done", lambda: answer(True)
            )
        elif isinstance(event, core.RunFinished):
            if event.ending != "finished":
                self._said[self._running] = event.reason
            self._running = None
            if self.sheet is not None:
                self.sheet.question.withdraw()

    def draw(self, *, at_once: bool = False) -> None:
        """Update the sheet ten times a second while it is open."""
        sheet, now_s = self.sheet, time.monotonic()
        if sheet is None or not (at_once or sheet.isVisible()):
            return
        if not at_once and now_s - self._drawn_s < PERIOD_S:
            return
        self._drawn_s = now_s
        if now_s - self._read_s >= STANDINGS_S:
            self._read_standings()
        sheet.show_look(self._look())
        if self._chosen == "camera":
            self._draw_fingers(sheet)

    # -- orders -----------------------------------------------------------------------------------

    def _choose(self, index: int) -> None:
        self._chosen = MEASUREMENT_NAMES[index]
        self.draw(at_once=True)

    def _measure(self) -> None:
        if self.sheet is None:
            return
        request = self.sheet.form.request(self._chosen)
        if shell.carry_out(lambda: self._bench.start(request), self._cards, "CALIBRATE"):
            self._measured.pop(self._chosen, None)
            self._said.pop(self._chosen, None)
            self.draw(at_once=True)

    def _accept(self) -> None:
        found, store = self._measured.get(self._chosen), self._bench.calibrations
        if found is None or store is None:
            return

        def accept() -> None:
            path = runs.accept_calibration(store, found, self._bench.devices, core.account_name())
            del self._measured[self._chosen]
            after = tr(AFTER.get(self._chosen, ""))
            self._said[self._chosen] = f"{tr('Accepted: {}', path.name)}{after}"
            self._read_standings()

        if shell.carry_out(accept, self._cards, "CALIBRATE"):
            self.draw(at_once=True)

    def _identify(self) -> None:
        if self.identify is None:
            self.identify = IdentifySheet(self._window, self._theme)
            self.identify.written.connect(lambda file: self.open_bench(file))
        self.identify.present()

    # -- showing ----------------------------------------------------------------------------------

    def _read_standings(self) -> None:
        self._read_s, store = time.monotonic(), self._bench.calibrations
        if store is not None:
            names = runs.device_names(self._bench.devices)
            try:
                self._history = tuple(self._bench.day_checks.read()[0])
            except core.InputError as error:
                self._history, self._said["day"] = (), f"{error.what} {error.where}"
            self._standings = {what: store.status(what, names) for what in MEASUREMENT_NAMES}

    def _look(self) -> CalibrationView:
        what, active = self._chosen, shell.is_run_active(self._bench)
        mine = self._running == what
        why = NO_STORE if self._bench.calibrations is None else shell.start_obstacle(self._bench)
        hand, gripper = self._bench.hand, shell.gripper_of(self._bench)
        holds = gripper is not None and gripper.status().holding and not active
        opens = holds and hand is not None and not why
        # A simulated bench sets a new scene for each run.
        simulated = self._bench.connection is None
        if holds and not simulated:
            why = why or tr("The gripper holds a piece: support it, then press Open gripper")
        return CalibrationView(
            rows=tuple(self._row(each) for each in MEASUREMENT_NAMES),
            what=what,
            found=None if mine else self._measured.get(what),
            progress=self._progress if mine else None,
            live=self._live(),
            empty=self._empty(what),
            said=self._said.get(what, ""),
            busy=active,
            why=tr("A run is going on") if active else why,
            held=holds and simulated and what not in self._measured,
            opens=opens,
            history=self._history if what == "day" else (),
        )

    def _empty(self, what: CalibrationName) -> str:
        """Return the text shown in place of residuals: the stored result and its date."""
        standing = self._standings.get(what)
        if standing is None or standing.record is None:
            return tr("Measure first.")
        file = standing.record.file
        said = tr("Last measured {:%Y-%m-%d %H:%M}", file.date.astimezone())
        said = tr("{} by {}", said, file.person) if file.person else said
        return f"{said}: {file.residual:.2g} {file.unit}."

    def _row(self, what: CalibrationName) -> tuple[str, str]:
        if what == "day":
            for last in self._history[-1:]:
                out = tr("Out of limits on {}", last.day)
                return (out, "bad") if last.findings else (tr("Passed on {}", last.day), "good")
            return tr("Never checked on this bench"), ""
        standing = self._standings.get(what)
        if standing is None:
            return NO_STORE, ""
        if standing.condition != "valid" or standing.record is None:
            # Calibrations are required on hardware only.
            needed = standing.condition != "missing" or self._bench.description.mode == "hardware"
            return standing.why[:1].upper() + standing.why[1:], "bad" if needed else ""
        file = standing.record.file
        days = int(standing.record.days_left(datetime.now(UTC)))
        left = tr("less than a day") if days < 1 else count_noun(days, "day")
        also = f"; {standing.notice}" if standing.notice else ""
        said = tr("{:.2g} of {:g} {}, holds {}", file.residual, file.limit, file.unit, left)
        return f"{said}{also}", "good"

    def _live(self) -> str:
        now_s = self._bench.clock_s()
        window = self._bench.wrench.window(now_s - 0.1, now_s)
        if not len(window.t_s):
            return tr("The wrist sensor is silent.")
        force, moment = window.values[:, :3].mean(axis=0), window.values[:, 3:].mean(axis=0)
        text = "F " + "  ".join(f"{v:+z.2f}" for v in force) + " N     T "
        text += "  ".join(f"{v:+z.3f}" for v in moment) + " N\N{MIDDLE DOT}m"
        at = shell.arm_position_mm(self._bench, 1.0)
        if at is not None:
            text += f"     {tr('hand at {} mm', '  '.join(f'{v:z.1f}' for v in at))}"
        return true_minus(text)

    def _draw_fingers(self, sheet: CalibrateSheet) -> None:
        now_s = self._bench.clock_s()
        for finger in core.FINGERS:
            frame, view = self._bench.frames[finger].newest(), sheet.fingers[finger]
            if frame is None:
                continue
            age_s = now_s - frame.t_s
            view.show_age(Age.FRESH if age_s < FRESH_S else Age.STALE, age_s, "No new picture.")
            view.show_frame(frame, self._bench.fields[finger].newest())
