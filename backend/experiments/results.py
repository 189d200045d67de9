"""Result files of the experiments: reading, checks, and reports beside the paper's numbers.

A file of another format and a damaged file raise ``InputError``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from touchdown.backend.core import InputError, parse_json, read_limited, write_atomically
from touchdown.backend.experiments import document
from touchdown.backend.experiments.comparison import comparison_report
from touchdown.backend.experiments.run_report import FILM_FILE
from touchdown.backend.experiments.tables import (
    BEYOND_READABLE,
    CALIBRATED,
    COUNTS,
    EVEN,
    TABLE_BOTTOMS,
    TABLES_FORMAT,
    TOWER,
    Recipe,
    table_results,
)
from touchdown.backend.geometry import TOO_CLOSE_MM
from touchdown.backend.jobs import JobStore

IDENTIFICATION_FORMAT = "touchdown-identification/1"
JsonMapping = Mapping[str, Any]
CELL_KEYS = ("piece", "bottom", "tower", "outline", "strategy")


def joined_comparison(answers: Sequence[JsonMapping]) -> Json:
    """Return several comparisons as one: the largest result of each cell, side by side."""
    return {
        **{
            name: [row for answer in answers for row in answer.get(name) or ()]
            for name in ("changes", "of_ceiling", "band")
        },
        "bench_sha256": answers[0]["bench_sha256"],
        "code": ", ".join(dict.fromkeys(answer["code"] for answer in answers)),
        "models": {p: m for answer in answers for p, m in answer.get("models", {}).items()},
        "cells": _largest(answers, "cells"),
        "pooled": _largest(answers, "pooled"),
    }


def _largest(parts: Iterable[JsonMapping], name: str) -> list[JsonMapping]:
    """Return the largest of the rows ``name`` of each cell, sorted by cell and strategy."""
    found: dict[tuple[str, ...], JsonMapping] = {}
    for row in (row for part in parts for row in part[name]):
        cell = tuple(str(row.get(key, "")) for key in CELL_KEYS)
        if cell not in found or row["placed"]["n"] > found[cell]["placed"]["n"]:
            found[cell] = row
    return [found[cell] for cell in sorted(found)]


def report_of(tables: JsonMapping) -> document.Report:
    """Return the report; raises one of ``CONTENT_ERRORS`` for other content."""
    if tables["format"] == IDENTIFICATION_FORMAT:
        report = TypeAdapter(document.Report).validate_python(tables["report"])
        for part in (part for section in report.sections for part in section.parts):
            for picture in part.pictures if isinstance(part, document.PictureGallery) else ():
                document.check_svg(picture.svg)
        return report
    facts = tables["bench_facts"]
    slipped = facts["slipped"]
    slip = "not measured" if slipped is None else f"{100 * slipped:.0f} %"
    answers = tables.get("beyond") or ()
    sections = [
        _table1(tables["table1"]),
        _table2(tables["table2"], BALANCED_SAMPLE),
        *_paper_protocol(tables.get("paper_protocol")),
        _table3(tables["table3"]),
        *(list(comparison_report(joined_comparison(answers)).sections) if answers else []),
        _reliability(facts["after_three_probes"]),
        _film_section((tables.get("figures") or {}).get("films") or ()),
    ]
    return document.Report(
        f"Touchdown: the paper's experiments, {tables['scale']}",
        (
            f"Preset {tables['bench']['preset']}, bench {tables['bench_sha256'][:16]}, program "
            f"{tables['code']}{_made(tables)}. A pad slipped by more than 0.02 mm in {slip} of the "
            "probes. In "
            "brackets: 95 % interval (rates: Wilson, exact at 0 and 100 %; means: over grippings). "
            "Below each value stands the paper's, of a real robot.",
            "Every cell names its job; the folder of that name under jobs/ holds its settings "
            "(spec.json), inputs and answer.",
        ),
        tuple(section for section in sections if section is not None),
    )


def _table1(rows: Sequence[JsonMapping]) -> document.ReportSection:
    grids = []
    for metric, title in (("iou", "IoU, %"), ("accuracy", "Face points right, %")):
        chosen = [row for row in rows if row["metric"] == metric]
        lines = tuple(
            (row["model"], (*(_cell(cell) for cell in row["cells"]), _mean(row))) for row in chosen
        )
        grids.append(document.ReportTable(title, _table_columns(chosen[0]["cells"], "mean"), lines))
    note = (
        "Against the label, which is the overlap at the commanded displacement, as data is "
        "labelled on a bench; against_truth in the JSON is against the real one."
    )
    return document.ReportSection("Table 1: contact patch from one probe", (note,), tuple(grids))


BALANCED_SAMPLE = "Right, %, on a sample with as many stable as unstable places"


def _made(tables: JsonMapping) -> str:
    """Return date and sources of a result; older files name none."""
    sources = tables.get("sources") or {}
    named = ", ".join(f"{kind} {digest}" for kind, digest in sources.items())
    return f", {tables['date']}, sources: {named}" if named else ""


def _paper_protocol(answer: JsonMapping | None) -> list[document.ReportSection]:
    """Return Tables 1 and 2 in the paper's protocol; older files have none."""
    if not answer:
        return []
    found = []
    what = (
        f"The piece is taken from a jig. {answer['mountings']} mountings of each bottom, "
        f"{answer['interactions']} presses in all, at random over the whole range; the paper had "
        "one mounting of each bottom. Intervals are by mounting."
    )
    for section in (
        _table1(answer["table1"]),
        _table2(answer["table2"], "Right, %, over the whole range; base: the larger class"),
    ):
        title = section.title.replace(":", ", paper's protocol:")
        found.append(document.ReportSection(title, (what, *section.text), section.parts))
    return found


def _table2(rows: Sequence[JsonMapping], title: str) -> document.ReportSection:
    names = {"Implicit": "Implicit"}
    for n in COUNTS:
        names |= {n: f"Ours, n = {n}", f"{CALIBRATED} {n}": f"Ours, calibrated, n = {n}"}
        names[f"{EVEN} {n}"] = f"Ours, judged at 0.5, n = {n}"
    lines = []
    for row in rows:
        cells = [_stability_cell(cell) for cell in row["cells"]]
        notes = [*_errors(row["pooled"])]
        notes += [_change_note(*change) for change in row.get("changes", {}).items()]
        pooled = document.rate_entry(row["pooled"]["accuracy"], notes=notes)
        lines.append((names[row["method"]], (*cells, pooled)))
    excluded = max(sum(cell.get("excluded", 0) for cell in row["cells"]) for row in rows)
    note = (
        f"{excluded} cases with a margin within {TOO_CLOSE_MM} mm are left out. Further probes are "
        "random ones of the same gripping; the question is always asked for the place of the "
        "first. By every interface; the top one alone in the JSON."
    )
    grid = document.ReportTable(
        title, _table_columns(rows[0]["cells"], "pooled"), tuple(lines), note
    )
    return document.ReportSection("Table 2: stability", (), (grid,))


def _change_note(name: str, change: JsonMapping) -> str:
    value, low, high = (100 * change[key] for key in ("change", "low", "high"))
    return f"{name} {value:+.1f} ({low:+.1f} to {high:+.1f}) points against the paper's fusion"


def _table3(rows: Sequence[JsonMapping]) -> document.ReportSection:
    titles = {"one": "One bottom", "two": "Two bottoms: Long stands on Short, off centre by 0-6 mm"}
    grids = []
    for tower, title in titles.items():
        chosen = [row for row in rows if row["tower"] == tower]
        lines = []
        for row in chosen:
            name = "Pick and place" if row["strategy"] == "pick-and-place" else "Ours"
            unsafe = row["unsafe"]
            fell = [f"fell {document.format_percent(unsafe['value'])} % of {unsafe['n']}"]
            total = document.rate_entry(
                row["pooled"], row["paper_pooled"], fell if unsafe["n"] else ()
            )
            lines.append((name, (*(_stacking_cell(cell) for cell in row["cells"]), total)))
        columns = _table_columns(chosen[0]["cells"], "pooled")
        grids.append(document.ReportTable(f"{title}: placed, %", columns, tuple(lines)))
    note = (
        "Every trial counts; every start is unstable; the exact judge of all interfaces decides. "
        "Counts: placed / fell / knocked over / gave up / aborted. Devices agree: trials repeated "
        "with devices, images and tracker that ended alike."
    )
    return document.ReportSection("Table 3: stacking", (note,), tuple(grids))


def _table_columns(cells: Sequence[JsonMapping], last: str) -> tuple[tuple[str, str], ...]:
    return (*((cell["piece"].title(), cell["bottom"]) for cell in cells), (last, ""))


def _cell(
    cell: JsonMapping, estimate: JsonMapping | None = None, notes: tuple[str, ...] = ()
) -> document.TableEntry:
    """Return an entry with the common parts of a cell; ``estimate``: its value."""
    return document.rate_entry(cell if estimate is None else estimate, cell["paper"], notes, cell)


def _stability_cell(cell: JsonMapping) -> document.TableEntry:
    if "accuracy" not in cell:
        return _cell(cell)
    base = f"base {document.format_percent(cell['base_rate'])}"
    return _cell(cell, cell["accuracy"], (base, *_errors(cell)))


def _stacking_cell(cell: JsonMapping) -> document.TableEntry:
    counts = cell.get("outcomes")
    if counts is None:
        return _cell(cell)
    notes = [document.format_outcomes(counts)]
    again = cell.get("devices")
    if again:
        notes.append(f"devices agree {again['same_outcome']} of {again['trials']}")
    if cell["probes"] is not None:
        notes.append(f"{cell['probes']:.1f} probes")
    return _cell(cell, notes=tuple(notes))


def _errors(binary: JsonMapping) -> tuple[str, ...]:
    if binary["accuracy"]["value"] is None:
        return ()
    found, unsafe = binary["found"]["value"], binary["unsafe"]["value"]
    return (
        f"balanced {document.format_percent(binary['balanced'])}",
        f"found {document.format_percent(found)}, unsafe {document.format_percent(unsafe)}",
    )


def _mean(row: JsonMapping) -> document.TableEntry:
    return document.TableEntry(
        document.format_percent(row["mean"]),
        "",
        (f"paper {document.format_percent(row['paper_mean'])}",),
    )


def _reliability(charts: Sequence[JsonMapping]) -> document.ReportSection | None:
    if not charts:
        return None
    drawn = [
        document.reliability_chart(
            chart["promised"],
            chart["came"],
            f"{chart['piece'].title()} on {chart['bottom']}",
            f"ECE {chart['ece']:.3f}, IoU {document.format_percent(chart['map_iou']['value'])}",
        )
        for chart in charts
    ]
    gallery = document.PictureGallery("", tuple(map(document.ReportPicture, drawn)))
    text = (
        "Belief after three probes against the true support, over all covered cells, 15 bins of "
        "equal mass. Horizontal: predicted. Vertical: observed."
    )
    return document.ReportSection("Calibration of the probabilities", (text,), (gallery,))


def _film_section(films: Sequence[JsonMapping]) -> document.ReportSection | None:
    if not films:
        return None
    strips = []
    for film in films:
        probes = tuple(
            document.ReportPicture(
                document.check_svg(probe["svg"]), f"Probe {number}", probe["why"]
            )
            for number, probe in enumerate(film["probes"], 1)
        )
        strips.append(document.PictureGallery(film["title"], probes, end=film["end"]))
    return document.ReportSection("Belief maps by probe", (document.FILM_LEGEND,), tuple(strips))


MAX_BYTES = 64 * 2**20  # a full report has about 1 MB
Json = dict[str, Any]
# raised by content of another shape
CONTENT_ERRORS = (KeyError, TypeError, ValueError, AttributeError, IndexError)


def read_report(file: Path) -> tuple[Json, document.Report]:
    """Return the content of the file of a report and the report; raises ``InputError``."""
    fix = "Name a tables.json of `touchdown experiment tables`, or the .json of `identify`."
    found = _read(file, (IDENTIFICATION_FORMAT, TABLES_FORMAT), fix)
    with _checked_content(file, fix):
        return found, report_of(found)


def read_beyond(file: Path) -> Json:
    """Return the content of a ``beyond.json``; raises ``InputError``."""
    fix = "Name a beyond.json, as `touchdown experiment beyond` writes it."
    found = _read(file, BEYOND_READABLE, fix)
    with _checked_content(file, fix):
        comparison_report(found)
        str(found["bench_sha256"])
    return found


def _read(file: Path, wanted: tuple[str, ...], fix: str) -> Json:
    content = read_limited(file, MAX_BYTES, fix)
    try:
        found = parse_json(content)
    except ValueError as error:
        raise InputError("It is not JSON, or damaged.", str(file), fix) from error
    file_format = found.get("format") if isinstance(found, dict) else None
    if file_format not in wanted:
        what = (
            f"Its format is '{file_format}' and not '{wanted[-1]}'."
            if file_format
            else "It is not a report."
        )
        raise InputError(what, str(file), fix)
    return dict(found)


@contextmanager
def _checked_content(file: Path, fix: str) -> Iterator[None]:
    try:
        yield
    except CONTENT_ERRORS as error:
        what = f"Its content is damaged ({type(error).__name__}: {error})."
        raise InputError(what, str(file), fix) from error


PAGE, DATA = "tables.html", "tables.json"
BEYOND_PAGE, BEYOND_DATA = "beyond.html", "beyond.json"


def write_tables(out: Path, recipe: Recipe, store: JobStore) -> tuple[Path, Json]:
    """Write the finished results of Tables 1 to 3 as ``tables.json`` and ``tables.html``.

    Parameters
    ----------
    out : Path
        Existing folder.
    recipe : Recipe
        Jobs of the tables.
    store : JobStore
        Store with the results of finished jobs; missing cells are null.

    Returns
    -------
    page : Path
        Path of the page.
    content : dict
        Content of ``tables.json``.
    """
    found = table_results(recipe, store)
    found["figures"] = {"films": _stored_films(recipe, store)}
    return _written(out / DATA, found), found


def rewrite_tables(file: Path, compared: Sequence[Path]) -> Path:
    """Replace the comparisons of a ``tables.json`` and render its page; return the path of the
    page.

    Without ``compared`` the comparisons stay. Raises ``InputError`` for a file of another format,
    or a comparison on another bench.
    """
    found = dict(read_report(file)[0])
    answers = list(map(read_beyond, compared))
    for path, answer in zip(compared, answers, strict=True):
        if answer["bench_sha256"] != found.get("bench_sha256"):
            raise InputError("It belongs to another bench.", str(path), f"Leave it out of {file}.")
    if answers:
        found["beyond"] = answers
    return _written(file, found)


def _written(file: Path, found: Json) -> Path:
    """Write the page beside ``file``, then the file; return the path of the page."""
    page = file.with_suffix(".html")
    write_atomically(page, document.report_page(report_of(found)).encode())
    write_atomically(file, _json_bytes(found))
    return page


def _json_bytes(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, indent=1, sort_keys=True).encode() + b"\n"


def write_comparison(out: Path, answer: Mapping[str, Any]) -> Path:
    """Write a comparison of strategies; return the path of its file."""
    write_atomically(out / BEYOND_DATA, _json_bytes(answer))
    write_atomically(out / BEYOND_PAGE, document.report_page(comparison_report(answer)).encode())
    return out / BEYOND_DATA


def _stored_films(recipe: Recipe, store: JobStore) -> list[Json]:
    """Return the recorded trials of each piece on one bottom and on two."""
    films = []
    for k, piece in enumerate(recipe.pieces):
        for bottoms in ((TABLE_BOTTOMS[k % len(TABLE_BOTTOMS)],), TOWER):
            spec = recipe.stacking(piece, bottoms, "paper")
            if spec is None or not store.has(spec.id):
                continue
            path = store.folder(spec.id) / FILM_FILE
            if path.is_file():
                title = f"{piece.title()} on {' + '.join(bottoms)}"
                films += [{"title": title, **film} for film in parse_json(path.read_bytes())]
    return films
