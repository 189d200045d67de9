"""Presenter of the calibration panel."""

from __future__ import annotations

import getpass
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime

from PySide6.QtWidgets import QWidget

from touchdown.app.calibrate.sheet import CalibrateSheet, CalibrationView, PlaceForm
from touchdown.app.shell import arm_position_mm, carry_out, is_run_active, start_obstacle
from touchdown.backend.bench import Session
from touchdown.backend.calibration import (
    CALIBRATION_KINDS,
    CALIBRATION_NAMES,
    CalibrationName,
    CalibrationStatus,
    format_residual,
    format_value,
    quantity_name,
)
from touchdown.backend.core import (
    FINGERS,
    CalibrationMeasured,
    Event,
    HandOverAwaited,
    Progress,
    RunFinished,
    RunStarted,
)
from touchdown.backend.runs import (
    CalibrateRequest,
    accept_calibration,
    device_names,
    hand_over_message,
)
from touchdown.widgets.base import Age, Theme
from touchdown.widgets.shell import FaultCards

STEPS: dict[CalibrationName, tuple[str, ...]] = {
    "payload": (
        "Empty the gripper and leave 60 mm of free height above it.",
        "The hand rises, leans 14° in six poses and is weighed in each.",
        "It levels again. Compare mass and centre with the data sheet, then accept.",
    ),
    "wrist": (
        "Empty the gripper and leave 60 mm of free height above it.",
        "The hand leans in six poses: gravity shows how the sensor is turned.",
        "Beyond 2° the settings are wrong: correct ft.rotation, then repeat.",
    ),
    "board": (
        "Fix the bottom. The piece waits in its jig, or is handed over.",
        "The piece touches the bottom in five places and feels each edge twice.",
        "It goes back. The residual shows if anything moved meanwhile.",
    ),
    "tool": (
        "Fix a bottom whose place is known and give it as the origin.",
        "The piece feels its four edges; three grips.",
        "It goes back. The residual is the spread of the grips.",
    ),
    "camera": (
        "Fix the bottom. The piece waits in its jig, or is handed over.",
        "The piece is pressed at the rim on four sides: it leans, the dots follow.",
        "Exchanged fingers and mirrored pictures are put right from the next start on.",
    ),
}

# Message after accepting a result that needs another step.
AFTER: dict[CalibrationName, str] = {
    "camera": ". The pictures stay as they are until the bench is started again: close the window "
    "and open it again."
}

# Figure of the residuals that the limit applies to.
COUNTS: dict[CalibrationName, str] = {
    "payload": "largest",
    "wrist": "largest",
    "board": "rms",
    "tool": "rms",
    "camera": "rms",
}


def validity_text(days_left: float) -> str:
    """Return the remaining validity of a calibration as text."""
    days = int(days_left)
    return "less than a day" if days < 1 else "1 day" if days == 1 else f"{days} days"


PERIOD_S = 0.1
STANDINGS_S = 5.0
FRESH_S = 0.5
NO_STORE = "This bench keeps no calibrations"


class CalibratePresenter:
    """Keeps one calibration sheet per bench. A run started elsewhere is waited for."""

    def __init__(
        self,
        bench: Session,
        theme: Theme,
        window: QWidget,
        cards: FaultCards,
        person: Callable[[], str] = getpass.getuser,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._bench, self._theme, self._window, self._cards = bench, theme, window, cards
        self._person, self._now_s = person, now_s
        self.sheet: CalibrateSheet | None = None
        self._chosen: CalibrationName = CALIBRATION_NAMES[0]
        self._running: CalibrationName | None = None
        self._progress = Progress(0.0, 0, 1, "")
        self._measured: dict[CalibrationName, CalibrationMeasured] = {}
        self._said: dict[CalibrationName, str] = {}
        self._standings: dict[CalibrationName, CalibrationStatus] = {}
        self._drawn_s = self._read_s = float("-inf")

    def open(self) -> None:
        """Show the calibration sheet."""
        if self.sheet is None:
            catalogue = self._bench.catalogue
            self.sheet = CalibrateSheet(
                self._window,
                self._theme,
                [CALIBRATION_KINDS[what].title for what in CALIBRATION_NAMES],
                PlaceForm(catalogue.tops, catalogue.bottoms, self._usual()),
            )
            self.sheet.calibration_chosen.connect(self._choose)
            self.sheet.measure_requested.connect(self._measure)
            self.sheet.cancel_requested.connect(lambda: self._bench.engine.cancel())
            self.sheet.accept_requested.connect(self._accept)
        self._read_s = float("-inf")
        self.draw(at_once=True)
        self.sheet.present()

    def _usual(self) -> CalibrateRequest:
        """Return the request that the form starts with."""
        usual, on_bench = CalibrateRequest("board"), self._bench.usual
        if self._bench.simulated:
            return usual
        return replace(usual, piece=on_bench.piece, bottom=on_bench.bottoms[-1])

    def take(self, event: Event) -> None:
        """Follow calibration runs, also those started elsewhere."""
        if isinstance(event, RunStarted):
            known = {str(what): what for what in CALIBRATION_NAMES}
            self._running = known.get(event.strategy) if event.activity == "calibrate" else None
            self._progress = Progress(event.t_s, 0, 1, "")
            return
        if self._running is None:
            return
        if isinstance(event, Progress):
            self._progress = event
        elif isinstance(event, CalibrationMeasured):
            self._measured[self._running] = event
            self._said.pop(self._running, None)
        elif isinstance(event, HandOverAwaited) and self.sheet is not None:
            answer = self._bench.answer
            self.sheet.question.ask(
                hand_over_message(event), "End the run", "Done", lambda: answer(True)
            )
        elif isinstance(event, RunFinished):
            if event.ending != "finished":
                self._said[self._running] = event.reason
            self._running = None
            if self.sheet is not None:
                self.sheet.question.withdraw()

    def draw(self, *, at_once: bool = False) -> None:
        """Update the sheet ten times a second while it is open."""
        sheet, now_s = self.sheet, self._now_s()
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
        self._chosen = CALIBRATION_NAMES[index]
        self.draw(at_once=True)

    def _measure(self) -> None:
        if self.sheet is None:
            return
        request = self.sheet.form.request(self._chosen)
        if carry_out(lambda: self._bench.start(request), self._cards, "CALIBRATE"):
            self._measured.pop(self._chosen, None)
            self._said.pop(self._chosen, None)
            self.draw(at_once=True)

    def _accept(self) -> None:
        found, store = self._measured.get(self._chosen), self._bench.calibrations
        if found is None or store is None:
            return

        def accept() -> None:
            path = accept_calibration(store, found, self._bench.devices, self._person())
            del self._measured[self._chosen]
            self._said[self._chosen] = f"Accepted: {path.name}{AFTER.get(self._chosen, '')}"
            self._read_standings()

        if carry_out(accept, self._cards, "CALIBRATE"):
            self.draw(at_once=True)

    # -- showing ----------------------------------------------------------------------------------

    def _read_standings(self) -> None:
        self._read_s, store = self._now_s(), self._bench.calibrations
        if store is not None:
            names = device_names(self._bench.devices)
            self._standings = {what: store.status(what, names) for what in CALIBRATION_NAMES}

    def _look(self) -> CalibrationView:
        what, active = self._chosen, is_run_active(self._bench)
        found = None if self._running == what else self._measured.get(what)
        mine = self._running == what
        note = self._said.get(what, "")
        if found is not None:
            note = " ".join(text for text in (found.obstacle, found.note) if text)
        residual = "" if found is None else format_residual(found.residual, found.limit, found.unit)
        why = NO_STORE if self._bench.calibrations is None else start_obstacle(self._bench)
        return CalibrationView(
            rows=tuple(self._row(each) for each in CALIBRATION_NAMES),
            chosen=CALIBRATION_NAMES.index(what),
            title=CALIBRATION_KINDS[what].title,
            steps=STEPS[what],
            step=1 if mine else 2 if found is not None else 0,
            takes_piece=self.sheet is not None and self.sheet.form.request(what).takes_piece,
            shows_fingers=what == "camera",
            live=self._live(),
            done=self._progress.done if mine else 0,
            total=self._progress.total if mine else 1,
            progress=self._progress.text if mine else "",
            values=() if found is None else tuple(
                (quantity_name(name), format_value(name, value, sigma, unit))
                for name, value, sigma, unit in zip(
                    found.names, found.values, found.sigmas, found.units, strict=True
                )
            ),
            residuals=() if found is None else found.residuals,
            limit=1.0 if found is None else found.limit,
            unit="" if found is None else found.unit,
            kind=COUNTS[what],
            figure="" if found is None else f"Residual {residual}.",
            empty=self._empty(what),
            within=None if found is None else found.residual <= found.limit,
            note=note,
            note_bad=found is not None and bool(found.obstacle),
            running=mine,
            busy=active,
            can_accept=found is not None and found.acceptable and not active,
            why="A run is going on" if active else why,
        )  # fmt: skip

    def _empty(self, what: CalibrationName) -> str:
        """Return the text shown in place of residuals: the stored result and its date."""
        standing = self._standings.get(what)
        if standing is None or standing.record is None:
            return "Measure first."
        file = standing.record.file
        by = f" by {file.person}" if file.person else ""
        when = file.date.astimezone()
        return f"Last measured {when:%Y-%m-%d %H:%M}{by}: {file.residual:.2g} {file.unit}."

    def _row(self, what: CalibrationName) -> tuple[str, str]:
        standing = self._standings.get(what)
        if standing is None:
            return NO_STORE, ""
        if standing.condition != "valid" or standing.record is None:
            # Calibrations are required on hardware only.
            needed = standing.condition != "missing" or self._bench.description.mode == "hardware"
            return standing.why[:1].upper() + standing.why[1:], "bad" if needed else ""
        file = standing.record.file
        left = validity_text(standing.record.days_left(datetime.now(UTC)))
        also = f"; {standing.notice}" if standing.notice else ""
        return f"{file.residual:.2g} of {file.limit:g} {file.unit}, holds {left}{also}", "good"

    def _live(self) -> str:
        now_s = self._bench.clock_s()
        window = self._bench.wrench.window(now_s - 0.1, now_s)
        if not len(window.t_s):
            return "The wrist sensor is silent."
        force, moment = window.values[:, :3].mean(axis=0), window.values[:, 3:].mean(axis=0)
        text = "F " + "  ".join(f"{v:+.2f}" for v in force) + " N     T "
        text += "  ".join(f"{v:+.3f}" for v in moment) + " N\N{MIDDLE DOT}m"
        at = arm_position_mm(self._bench, 1.0)
        if at is not None:
            text += "     hand at " + "  ".join(f"{v:.1f}" for v in at) + " mm"
        return text.replace("-", "\N{MINUS SIGN}")

    def _draw_fingers(self, sheet: CalibrateSheet) -> None:
        now_s = self._bench.clock_s()
        for finger in FINGERS:
            frame, view = self._bench.frames[finger].newest(), sheet.fingers[finger]
            if frame is None:
                continue
            age_s = now_s - frame.t_s
            view.show_age(Age.FRESH if age_s < FRESH_S else Age.STALE, age_s, "No new picture.")
            view.show_frame(frame, self._bench.fields[finger].newest())
