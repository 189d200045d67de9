"""Motion limits of the connection panel."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from pydantic import ValidationError
from PySide6.QtWidgets import QDoubleSpinBox, QGridLayout, QWidget

from touchdown.app.shell import BenchSheet, QuestionRow, carry_out, time_of_day
from touchdown.backend.bench import Session
from touchdown.backend.config import Limits
from touchdown.backend.core import account_name
from touchdown.backend.runs import changed_limits
from touchdown.widgets.base import label, push_button, rule, tr
from touchdown.widgets.forms import decimal_box, field_label, inset_spin_boxes
from touchdown.widgets.shell import FaultCards

WIDEST = 2000.0
COLUMNS = 2
FINE = "N\N{MIDDLE DOT}m"  # unit whose values have more decimals


@dataclass(frozen=True, slots=True)
class LimitRow:
    """One limit: name in the file, title, value, and unit as text after the value."""

    name: str
    title: str
    value: float
    unit: str


class LimitsSheet(BenchSheet):
    """Form of the limits.

    ``offer`` applies values by name and returns "" or the reason of refusal.
    """

    def __init__(self, parent: QWidget, offer: Callable[[Mapping[str, float]], str]) -> None:
        super().__init__(parent, "Limits")
        self._offer = offer
        self.source, self.said = label("", wrap=True), label("", wrap=True)
        self.said.setProperty("tone", "bad")
        self.question = QuestionRow()
        self._grid = QGridLayout()
        self._grid.setHorizontalSpacing(20)
        # The sheet must fit below the top bar of the smallest window.
        self._grid.setVerticalSpacing(2)
        self.boxes: dict[str, QDoubleSpinBox] = {}
        self._shown: dict[str, tuple[float, float]] = {}
        self.edit = push_button("Unlock", "Let the limits be changed", checkable=True)
        self.take = push_button("Change\N{HORIZONTAL ELLIPSIS}")
        self.edit.toggled.connect(self._unlock)
        self.take.clicked.connect(self._taken)
        head = label("Limits of motion and force", "head")
        self.arrange(
            head, self.source, rule(), self._grid, self.said, self.question, 1,
            foot=(self.edit, self.take), spacing=8,
        )  # fmt: skip
        self.give_width(50)

    def show_rows(self, rows: Sequence[LimitRow], source: str) -> None:
        """Show the present limits and their source; the form is locked."""
        if not self.boxes:
            self._build(rows)
        for row in rows:
            self.boxes[row.name].setValue(row.value)
            self._shown[row.name] = (row.value, self.boxes[row.name].value())
        self.source.setText(source)
        self.said.setText("")
        self.question.withdraw()
        self.edit.setChecked(False)
        self._unlock(False)

    # -- inside -----------------------------------------------------------------------------------

    def _build(self, rows: Sequence[LimitRow]) -> None:
        high = -(-len(rows) // COLUMNS)
        for index, row in enumerate(rows):
            decimals = 3 if row.unit.endswith(FINE) else 1
            box = self.boxes[row.name] = decimal_box(-WIDEST, WIDEST, decimals)
            box.setSuffix(row.unit)
            box.setAccessibleName(tr(row.title))
            box.setKeyboardTracking(False)
            inset_spin_boxes(box)
            box.setMinimumWidth(8 * self.fontMetrics().height())
            at, side = index % high, 2 * (index // high)
            self._grid.addWidget(field_label(row.title, box), at, side)
            self._grid.addWidget(box, at, side + 1)

    def _unlock(self, on: bool) -> None:
        for box in self.boxes.values():
            # Read-only instead of disabled: locked values keep full contrast.
            box.setReadOnly(not on)
        self.take.setEnabled(on)
        if not on:
            self.question.withdraw()

    def _taken(self) -> None:
        values = {name: box.value() for name, box in self.boxes.items()}
        # An unedited limit keeps the digits that its box does not show.
        kept = {n: value for n, (value, shown) in self._shown.items() if values[n] == shown}
        self.said.setText(self._offer(values | kept))


# All limits in the order of the sheet.
TITLES = {
    "reach_mm": "Reach about the bench's axis",
    "least_x_mm": "Box, least x",
    "most_x_mm": "Box, most x",
    "least_y_mm": "Box, least y",
    "most_y_mm": "Box, most y",
    "lowest_mm": "Lowest z",
    "highest_mm": "Highest z",
    "speed_mm_s": "Speed in air",
    "jog_mm_s": "Speed by hand",
    "contact_speed_mm_s": "Speed near contact",
    "recovery_mm_s": "Speed in recovery",
    "near_mm": "Near the surface below",
    "tilt_rad": "Lean of the hand",
    "turn_rad_s": "Speed of turning",
    "turn_clear_mm": "Room below to turn",
    "contact_n": "Counts as contact",
    "jog_guard_n": "Guard while jogging",
    "probe_n": "Nominal press of a probe",
    "trip_n": "Stops motion, force (two samples)",
    "trip_at_once_n": "Stops motion, force (one sample)",
    "trip_nm": "Stops motion, moment",
    "wrench_age_s": "Oldest wrench",
    "frame_age_s": "Oldest picture",
}
ANGLES = ("_rad", "_rad_s")  # name endings of values in radians, which are shown in degrees
BOUNDS = {"gt": "must be above", "ge": "must be at least", "le": "must be at most"}
UNITS = {
    "mm_s": "mm/s",
    "rad_s": "\N{DEGREE SIGN}/s",
    "rad": "\N{DEGREE SIGN}",
    "nm": "N\N{MIDDLE DOT}m",
    "mm": "mm",
    "n": "N",
    "s": "s",
}


class LimitsPresenter:
    """Edits the limits of a bench."""

    def __init__(self, bench: Session, window: QWidget, cards: FaultCards) -> None:
        self._bench, self._window, self._cards = bench, window, cards
        self._first = bench.interlock.limits
        self._said = ""
        self.sheet: LimitsSheet | None = None

    def open(self) -> None:
        """Show the present limits."""
        if self.sheet is None:
            self.sheet = LimitsSheet(self._window, self._offer)
        self._show()
        self.sheet.present()

    def _show(self) -> None:
        assert self.sheet is not None
        source = self._said or tr("From {}.", self._bench.limits_source)
        self.sheet.show_rows(limit_rows(self._bench.interlock.limits), source)

    def _offer(self, values: Mapping[str, float]) -> str:
        """Ask for confirmation of ``values``; return why they cannot be applied, "" if they can."""
        held = self._bench.interlock.limits.model_dump()
        try:
            wanted = Limits(**{n: entered_limit(n, v, held[n]) for n, v in values.items()})
        except ValidationError as error:
            return limit_problem(error)
        pairs = changed_limits(self._bench.interlock.limits, wanted)
        if not pairs:
            return tr("Nothing is changed.")
        told = "; ".join(
            f"{tr(TITLES[name])} {displayed_limit(name, old):g} \N{RIGHTWARDS ARROW} "
            f"{displayed_limit(name, new):g}{unit_suffix(limit_unit(name))}"
            for name, (old, new) in pairs.items()
        )
        assert self.sheet is not None
        self.sheet.question.ask(
            tr("Change {}? It applies until the program ends, and is logged.", told),
            "Keep", "Change", lambda: self._take(wanted),
        )  # fmt: skip
        return ""

    def _take(self, wanted: Limits) -> None:
        person, source = account_name(), self._bench.limits_source
        change = partial(self._bench.change_limits, wanted, person)
        if carry_out(change, self._cards, "LIMITS"):
            changed = tr("From {}, changed at {} by {}.", source, time_of_day(), person)
            self._said = "" if wanted == self._first else changed
        self._show()


def limit_rows(limits: Limits) -> list[LimitRow]:
    """Return all limits with units."""
    values = limits.model_dump()
    return [
        LimitRow(name, title, displayed_limit(name, values[name]), unit_suffix(limit_unit(name)))
        for name, title in TITLES.items()
    ]


def limit_problem(error: ValidationError) -> str:
    """Return the error of the first invalid limit, in the terms of the sheet."""
    first = error.errors()[0]
    name = str(first["loc"][0]) if first["loc"] else ""
    for bound, value in first.get("ctx", {}).items():
        if name in TITLES and bound in BOUNDS:
            limit = f"{displayed_limit(name, value):g}{unit_suffix(limit_unit(name))}"
            return f"{tr(TITLES[name])}: {tr(BOUNDS[bound])} {limit}."
    text = first["msg"].removeprefix("Value error, ")
    for known, title in TITLES.items():
        text = text.replace(f"'{known}'", f"'{tr(title)}'")
    return f"{text}."


def displayed_limit(name: str, value: float) -> float:
    """Return a limit in displayed units: angles in degrees, others unchanged."""
    return round(math.degrees(value), 9) if name.endswith(ANGLES) else value


def entered_limit(name: str, read: float, held: float) -> float:
    """Return the limit for an entered value; an unedited one stays ``held``."""
    if read == displayed_limit(name, held):
        return held
    return math.radians(read) if name.endswith(ANGLES) else read


def unit_suffix(unit: str) -> str:
    """Return a unit as it follows its number; degrees have no space."""
    return unit if unit.startswith("\N{DEGREE SIGN}") else f" {unit}"


def limit_unit(name: str) -> str:
    """Return the unit at the end of a limit's name."""
    return next(text for ending, text in UNITS.items() if name.endswith(f"_{ending}"))
