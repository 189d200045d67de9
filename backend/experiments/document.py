"""Reports of sections, tables and pictures, rendered as one HTML page.

All report pages of the experiments use ``Report`` and ``report_page``; the Review workspace shows
the same values. Charts are SVG text. SVG from a file is checked: one element without scripts and
external references.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from types import MappingProxyType
from typing import Any
from xml.etree import ElementTree

import numpy as np

from touchdown.backend.core import FloatArray, Outcome

Json = Mapping[str, Any]
SIMULATED = "SIMULATED BENCH: no robot moved for these figures"


@dataclass(frozen=True, slots=True)
class TableEntry:
    """A table cell: value, 95 % interval, lines below, and origin.

    ``jobs``: folders below ``jobs/`` with the underlying results, none for a derived cell;
    ``seed``: seed of the first one.
    """

    value: str
    interval: str = ""
    notes: tuple[str, ...] = ()
    jobs: tuple[str, ...] = ()
    seed: int | None = None

    @property
    def trace(self) -> str:
        """Origin of the cell as text; "" for a derived cell."""
        if not self.jobs:
            return ""
        more = "" if len(self.jobs) == 1 else f" and {len(self.jobs) - 1} more"
        return f"job {self.jobs[0]}{more}" + ("" if self.seed is None else f", seed {self.seed}")


@dataclass(frozen=True, slots=True)
class ReportTable:
    """A table of a report or of the command line.

    ``columns``: name and subtitle; ``rows``: name, and one entry per column. ``corner`` is the
    heading of the row names, ``note`` the text below the table.
    """

    title: str
    columns: tuple[tuple[str, str], ...]
    rows: tuple[tuple[str, tuple[TableEntry, ...]], ...]
    note: str = ""
    corner: str = ""

    @classmethod
    def of_texts(
        cls, title: str, header: Sequence[str], rows: Iterable[Sequence[str | TableEntry]]
    ) -> ReportTable:
        """Return a table of texts or entries; the first column holds the row names."""
        columns = tuple((name, "") for name in header[1:])
        lines = [
            [text if isinstance(text, TableEntry) else TableEntry(text) for text in row]
            for row in rows
        ]
        entries = tuple((name.value, tuple(line)) for name, *line in lines)
        return cls(title, columns, entries, corner=header[0])

    def texts(self) -> list[tuple[str, ...]]:
        """Return the header and the rows as plain texts, without intervals and notes."""
        rows = [(name, *(entry.value for entry in entries)) for name, entries in self.rows]
        return [(self.corner, *(name for name, _ in self.columns)), *rows]


@dataclass(frozen=True, slots=True)
class ReportPicture:
    """A picture: one self-contained ``svg`` element, with ``title`` and ``note``."""

    svg: str
    title: str = ""
    note: str = ""


@dataclass(frozen=True, slots=True)
class PictureGallery:
    """Pictures side by side, with a line below."""

    title: str
    pictures: tuple[ReportPicture, ...]
    end: str = ""


@dataclass(frozen=True, slots=True)
class ReportSection:
    """One part of a report: title, paragraphs, then tables and galleries in order.

    Without a title it continues the section before it.
    """

    title: str
    text: tuple[str, ...]
    parts: tuple[ReportTable | PictureGallery, ...]


@dataclass(frozen=True, slots=True)
class Report:
    """A report. ``about``: paragraphs before the sections; ``banner``: highlighted line above."""

    title: str
    about: tuple[str, ...]
    sections: tuple[ReportSection, ...]
    banner: str = SIMULATED


def rate_entry(
    estimate: Json,
    printed: float | None = None,
    notes: Iterable[str] = (),
    cell: Json = MappingProxyType({}),
) -> TableEntry:
    """Return a rate of 0..1 in % with its interval.

    ``printed``: the paper's value, shown below. ``cell``: names the jobs and their seed.
    """
    paper = () if printed is None else (f"paper {format_percent(printed)}",)
    jobs = tuple(cell.get("jobs", ())) or ((cell["job"],) if "job" in cell else ())
    return TableEntry(
        format_percent(estimate.get("value")),
        format_interval(estimate),
        (*paper, *notes),
        jobs,
        cell.get("seed"),
    )


def format_interval(estimate: Json) -> str:
    """Format the 95 % interval in %; "" without a value."""
    if estimate.get("value") is None:
        return ""
    return f"({format_percent(estimate['low'])}-{format_percent(estimate['high'])})"


def format_estimate(estimate: Json) -> str:
    """Format an estimate in % with its 95 % interval if it is known."""
    value, *ends = (estimate[key] for key in ("value", "low", "high"))
    if None in ends:
        return format_percent(value)
    return f"{format_percent(value)} ({' to '.join(map(format_percent, ends))})"


def format_percent(share: float | None) -> str:
    """Format a share in %; "-" for None."""
    return "-" if share is None else f"{100 * share:.1f}"


def format_outcomes(outcomes: Mapping[str, int]) -> str:
    """Format the counts as placed / fell / knocked over / gave up / aborted, then those asked."""
    asked = outcomes.get(Outcome.ASKED.value, 0)
    columns = (outcome for outcome in Outcome if outcome is not Outcome.ASKED)
    counts = " / ".join(str(outcomes.get(outcome.value, 0)) for outcome in columns)
    return f"{counts}, {asked} asked" if asked else counts


SVG_ELEMENTS = frozenset(
    ("svg", "g", "image", "polygon", "polyline", "path", "rect", "circle", "line", "text")
)
DATA_URL_PREFIX = "data:image/png;base64,"


def check_svg(svg: str) -> str:
    """Return ``svg`` if it is one element without scripts and references; raises ValueError."""
    if "<!" in svg or "<?" in svg:
        raise ValueError("a drawing contains a declaration")
    try:
        root = ElementTree.fromstring(svg)  # noqa: S314 - without declarations nothing can swell
    except ElementTree.ParseError as error:
        raise ValueError(f"a drawing is damaged: {error}") from error
    if root.tag != "svg":
        raise ValueError("a drawing is not an svg element")
    for element in root.iter():
        if element.tag not in SVG_ELEMENTS:
            raise ValueError(f"a drawing contains '{element.tag}'")
        for name, value in element.attrib.items():
            loads = name.endswith("href") and not value.startswith(DATA_URL_PREFIX)
            if name.startswith("on") or loads or "url(" in value:
                raise ValueError(f"a drawing has a forbidden attribute '{name}'")
    return svg


SIDE = 220
PAD = 34
INK, FAINT = "#1B2127", "#C9D0D7"
# lines and marks; x, y, z where there are three
BLUE, ORANGE, VIOLET = "#005FCC", "#C04A00", "#3A0D3F"


def reliability_chart(
    promised: Sequence[float], came: Sequence[float], title: str, note: str
) -> str:
    """Return a reliability diagram; a calibrated model lies on the diagonal."""
    points = [(_unit(p), _unit(1.0 - c)) for p, c in zip(promised, came, strict=True)]
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dots = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="{BLUE}"/>' for x, y in points)
    box = (
        f'<rect x="{PAD}" y="{PAD}" width="{SIDE - 2 * PAD}" height="{SIDE - 2 * PAD}" '
        f'fill="none" stroke="{FAINT}"/><path d="M{PAD} {SIDE - PAD}L{SIDE - PAD} {PAD}" '
        f'stroke="{ORANGE}" stroke-dasharray="4 3"/>'
        f'<polyline points="{line}" fill="none" stroke="{BLUE}"/>'
    )
    ticks = _text(PAD - 8, SIDE - PAD + 4, "0") + _text(PAD - 8, PAD + 4, "1")
    ticks += _text(SIDE - PAD, SIDE - PAD + 14, "1") + _text(PAD + 20, PAD - 5, "observed")
    ticks += _text(SIDE / 2, SIDE - PAD + 14, "predicted")
    return _frame(title, box + dots + ticks + _text(SIDE / 2, SIDE - 6, note))


FILM_LEGEND = (
    "Belief maps, 40 mm wide: yellow is support, blue is none, grey is unknown. Double line: "
    "hull of support above 90 %. Cross: centre of mass and planned step. Dashed: the true "
    "support, drawn after the fact."
)


def curves_chart(
    title: str,
    x: FloatArray,
    curves: Mapping[str, FloatArray],
    units: tuple[str, str],
    *,
    log: bool = False,
    points: bool = False,
) -> str:
    """Return named ``curves`` (n,) over ``x`` (n,), on logarithmic axes if ``log``.

    With ``points`` no lines join the values, and curves (3, n) have the ends of intervals. Lines
    mark zero on linear axes. Colours go by their order: blue, orange, violet. ``units``: of ``x``
    and of the curves.
    """

    def scaled(values: FloatArray) -> FloatArray:
        return np.log10(np.maximum(values, 1e-30)) if log else values

    across = scaled(x)
    heights = {name: scaled(np.asarray(values)) for name, values in curves.items()}
    low = min(float(np.nanmin(h)) for h in heights.values())
    high = max(float(np.nanmax(h)) for h in heights.values())
    width, height = max(float(np.ptp(across)), 1e-12), max(high - low, 1e-12)
    top = PAD + 11 * (len(heights) - 1)  # below the names

    def at(value: float) -> float:
        return SIDE - PAD - (min(max(value, low), high) - low) / height * (SIDE - PAD - top)

    lines = []
    places = [_unit((a - across[0]) / width) for a in across]
    looks = ((BLUE, "none"), (ORANGE, "5 3"), (VIOLET, "2 3"))
    for k, ((name, values), (colour, dash)) in enumerate(zip(heights.items(), looks, strict=False)):
        wide = np.broadcast_to(values, (3, len(places))).T
        known = [(a, *map(at, v)) for a, v in zip(places, wide, strict=True) if v[0] == v[0]]
        path = " ".join(f"{a:.1f},{v:.1f}" for a, v, *_ in known)
        stroke = "none" if points else colour
        lines += [
            f'<path d="M{a:.1f} {b:.1f}V{c:.1f}" stroke="{colour}"/>'
            f'<circle cx="{a:.1f}" cy="{v:.1f}" r="2" fill="{colour}"/>'
            for a, v, b, c in known if points
        ]  # fmt: skip
        lines.append(
            f'<polyline points="{path}" fill="none" stroke="{stroke}" stroke-dasharray="{dash}"/>'
            f'<text x="{PAD}" y="{28 + 11 * k}" font-size="9" fill="{colour}">{escape(name)}</text>'
        )
    ways = f"M{PAD} {top}V{SIDE - PAD}H{SIDE - PAD}"
    if low < 0.0 < high and not log:
        ways += f"M{PAD} {at(0.0):.1f}H{SIDE - PAD}"
    if across[0] < 0.0 < across[-1] and not log:
        ways += f"M{_unit(-across[0] / width):.1f} {top}V{SIDE - PAD}"
    axis = f'<path d="{ways}" stroke="{FAINT}" fill="none"/>'
    ends = [10.0**v if log else v for v in (across[0], across[-1], low, high)]
    spans = [
        f"{letter}: {a:.3g} to {b:.3g} {unit}"
        for letter, a, b, unit in zip("xy", ends[::2], ends[1::2], units, strict=True)
    ]
    note = _text(SIDE / 2, SIDE - 20, spans[0]) + _text(SIDE / 2, SIDE - 7, spans[1])
    return _frame(title, axis + "".join(lines) + note)


def _unit(share: float) -> float:
    return PAD + share * (SIDE - 2 * PAD)


def _text(x: float, y: float, text: str) -> str:
    return (
        f'<text x="{x:.0f}" y="{y:.0f}" font-size="10" text-anchor="middle" '
        f'fill="{INK}">{escape(text)}</text>'
    )


def _frame(title: str, inside: str) -> str:
    return (
        f'<svg viewBox="0 0 {SIDE} {SIDE}" width="{SIDE}" height="{SIDE}" role="img" '
        f'aria-label="{escape(title)}">{_text(SIDE / 2, 16, title)}{inside}</svg>'
    )


def report_page(report: Report) -> str:
    """Return a report as one HTML page; hovering over a cell shows its job and seed."""
    style = files("touchdown.resources").joinpath("report.css").read_text(encoding="utf-8")
    sections = []
    for section in report.sections:
        parts = "".join(
            _table(part) if isinstance(part, ReportTable) else _gallery(part)
            for part in section.parts
        )
        sections.append(_tag("h2", section.title) + _paragraphs(section.text) + parts)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"{_tag('title', report.title)}<style>\n{style}</style></head><body>"
        + _tag("h1", report.title)
        + (f'<p class="banner">{escape(report.banner)}</p>' if report.banner else "")
        + f"{_paragraphs(report.about)}{''.join(sections)}</body></html>"
    )


def _table(table: ReportTable) -> str:
    head = "".join(
        f"<th>{escape(name)}{_tag('small', below)}</th>" for name, below in table.columns
    )
    rows = "".join(
        f"<tr><th>{escape(name)}</th>{''.join(map(_cell, entries))}</tr>"
        for name, entries in table.rows
    )
    note = f"<p>{_tag('small', table.note)}</p>" if table.note else ""
    return (
        f'{_tag("h3", table.title)}<div class="wide"><table><tr><th>{escape(table.corner)}</th>'
        f"{head}</tr>{rows}</table></div>{note}"
    )


def _cell(entry: TableEntry) -> str:
    trace = f' title="{escape(entry.trace)}"' if entry.jobs else ""
    small = "".join(_tag("small", text) for text in (entry.interval, *entry.notes))
    return f"<td{trace}>{escape(entry.value)}{small}</td>"


def _gallery(gallery: PictureGallery) -> str:
    captions = any(picture.title or picture.note for picture in gallery.pictures)
    pictures = "".join(
        f'<div class="probe"><b>{escape(picture.title)}</b>{picture.svg}'
        f"<p>{escape(picture.note)}</p></div>"
        if captions
        else picture.svg
        for picture in gallery.pictures
    )
    end = f'<p class="end">{escape(gallery.end)}</p>' if gallery.end else ""
    return (
        f"{_tag('h3', gallery.title)}"
        f'<div class="{"strip" if captions else "charts"}">{pictures}</div>{end}'
    )


def _paragraphs(texts: Iterable[str]) -> str:
    return "".join(_tag("p", text) for text in texts)


def _tag(name: str, text: str) -> str:
    return f"<{name}>{escape(text)}</{name}>" if text else ""
