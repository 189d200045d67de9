"""The report of the experiments from the content of ``tables.json``: tables beside the paper's
numbers, and the figures behind them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from backend.dataset.rows import patch_bits
from backend.experiments.charts import patch_picture, reliability_chart, scatter, twin_traces
from backend.experiments.document import Entry, Gallery, Grid, Picture, Report, Section
from backend.experiments.drawing import harmless
from backend.experiments.strategies_report import strategy_sections
from backend.experiments.words import counts_of, entry_of, percent
from backend.objects.tower import TOO_CLOSE_MM

Json = Mapping[str, Any]
SIMULATED = "SIMULATED BENCH: no robot moved for these figures"


def report_of(tables: Json) -> Report:
    """Return the report; raises KeyError, TypeError, ValueError and the like for other content."""
    facts = tables["bench_facts"]
    slipped = facts["slipped"]
    slip = "not measured" if slipped is None else f"{100 * slipped:.0f} %"
    figures = tables.get("figures") or {}
    sections = [
        _table1(tables["table1"]),
        _table2(tables["table2"]),
        _table3(tables["table3"]),
        *strategy_sections(tables),
        _reliability(facts["after_three_probes"]),
        _distribution(figures.get("twins")),
        _films(figures.get("films") or ()),
    ]
    return Report(
        f"Touchdown: the paper's experiments, {tables['scale']}",
        SIMULATED,
        (
            f"Preset {tables['bench']['preset']}, bench {tables['bench_sha256'][:16]}, program "
            f"{tables['code']}. A pad slipped by more than 0.02 mm in {slip} of the probes. In "
            "brackets: 95 % interval (Wilson for rates; over grippings for means). Below each "
            "value stands the paper's, of a real robot.",
            "Every cell names its job; the folder of that name under jobs/ holds its settings "
            "(spec.json), inputs and answer.",
        ),
        tuple(section for section in sections if section is not None),
    )


def _table1(rows: Sequence[Json]) -> Section:
    grids = []
    for metric, title in (("iou", "IoU, %"), ("accuracy", "Face points right, %")):
        chosen = [row for row in rows if row["metric"] == metric]
        lines = tuple(
            (row["model"], (*(_cell(cell) for cell in row["cells"]), _mean(row))) for row in chosen
        )
        grids.append(Grid(title, _columns(chosen[0]["cells"], "mean"), lines))
    note = (
        "Against the label, which is the overlap at the commanded displacement, as data is "
        "labelled on a bench; against_truth in the JSON is against the real one."
    )
    return Section("Table 1: contact patch from one probe", (note,), tuple(grids))


def _table2(rows: Sequence[Json]) -> Section:
    names = {"Implicit": "Implicit", **{n: f"Ours, n = {n}" for n in ("1", "2", "3", "5")}}
    lines = []
    for row in rows:
        cells = [_stability_cell(cell) for cell in row["cells"]]
        pooled = entry_of(row["pooled"]["accuracy"], notes=_errors(row["pooled"]))
        lines.append((names[row["method"]], (*cells, pooled)))
    excluded = max(sum(cell.get("excluded", 0) for cell in row["cells"]) for row in rows)
    note = (
        f"{excluded} cases with a margin within {TOO_CLOSE_MM} mm are left out. Further probes are "
        "random ones of the same gripping; the question is always asked for the place of the "
        "first. By every interface; the top one alone in the JSON."
    )
    title = "Right, %, on a sample with as many stable as unstable places"
    grid = Grid(title, _columns(rows[0]["cells"], "pooled"), tuple(lines), note)
    return Section("Table 2: would it stand?", (), (grid,))


def _table3(rows: Sequence[Json]) -> Section:
    titles = {"one": "One bottom", "two": "Two bottoms: Long stands on Short, off centre by 0-6 mm"}
    grids = []
    for tower, title in titles.items():
        chosen = [row for row in rows if row["tower"] == tower]
        lines = []
        for row in chosen:
            name = "Pick and place" if row["strategy"] == "pick-and-place" else "Ours"
            unsafe = row["unsafe"]
            fell = (f"fell {percent(unsafe['value'])} % of {unsafe['n']}",) if unsafe["n"] else ()
            total = entry_of(row["pooled"], row["paper_pooled"], fell)
            lines.append((name, (*(_stacking_cell(cell) for cell in row["cells"]), total)))
        columns = _columns(chosen[0]["cells"], "pooled")
        grids.append(Grid(f"{title}: placed, %", columns, tuple(lines)))
    note = (
        "Every trial counts; every start is unstable; the exact judge of all interfaces decides. "
        "Counts: placed / fell / knocked over / gave up / aborted. Devices agree: trials repeated "
        "with devices, images and tracker that ended alike."
    )
    return Section("Table 3: stacking", (note,), tuple(grids))


def _columns(cells: Sequence[Json], last: str) -> tuple[tuple[str, str], ...]:
    return (*((cell["piece"].title(), cell["bottom"]) for cell in cells), (last, ""))


def _cell(cell: Json, estimate: Json | None = None, notes: tuple[str, ...] = ()) -> Entry:
    """Return what every cell shows; ``estimate``: its value, where that is a part of it."""
    entry = entry_of(cell if estimate is None else estimate, cell["paper"], notes)
    jobs = (cell["job"],) if "job" in cell else ()
    return Entry(entry.value, entry.interval, entry.notes, jobs, cell.get("seed"))


def _stability_cell(cell: Json) -> Entry:
    if "accuracy" not in cell:
        return _cell(cell)
    base = f"base {percent(cell['base_rate'])}"
    return _cell(cell, cell["accuracy"], (base, *_errors(cell)))


def _stacking_cell(cell: Json) -> Entry:
    counts = cell.get("outcomes")
    if counts is None:
        return _cell(cell)
    notes = [counts_of(counts)]
    again = cell.get("devices")
    if again:
        notes.append(f"devices agree {again['same_outcome']} of {again['trials']}")
    if cell["probes"] is not None:
        notes.append(f"{cell['probes']:.1f} probes")
    return _cell(cell, notes=tuple(notes))


def _errors(binary: Json) -> tuple[str, ...]:
    if binary["accuracy"]["value"] is None:
        return ()
    found, unsafe = binary["found"]["value"], binary["unsafe"]["value"]
    return (
        f"balanced {percent(binary['balanced'])}",
        f"found {percent(found)}, unsafe {percent(unsafe)}",
    )


def _mean(row: Json) -> Entry:
    return Entry(percent(row["mean"]), "", (f"paper {percent(row['paper_mean'])}",))


def _reliability(charts: Sequence[Json]) -> Section | None:
    if not charts:
        return None
    drawn = tuple(
        Picture(
            reliability_chart(
                chart["promised"],
                chart["came"],
                f"{chart['piece'].title()} on {chart['bottom']}",
                f"ECE {chart['ece']:.3f}, IoU {percent(chart['map_iou']['value'])}",
            )
        )
        for chart in charts
    )
    text = (
        "Belief after three probes against the true support, over all covered cells, 15 bins of "
        "equal mass. Along: promised. Up: came true."
    )
    return Section("Do the probabilities keep their promise?", (text,), (Gallery("", drawn),))


def _distribution(twins: Json | None) -> Section | None:
    if not twins:
        return None
    offset = np.array(twins["offset_mm"])
    reach = float(np.abs(offset).max())
    moment = np.array(twins["moment_nm"])
    maps = tuple(
        Picture(scatter(offset, values, title, unit, reach))
        for values, title, unit in (
            (np.array(twins["marker_px"]), "Largest marker displacement", "px"),
            (moment[:, 0], "Tx at the end of the press", "N m"),
            (moment[:, 1], "Ty at the end of the press", "N m"),
        )
    )
    pairs = (_pair(number, pair, twins) for number, pair in enumerate(twins["pairs"], 1))
    alike = (
        "Pairs below: presses that feel alike and are not, the nearest signals among all pairs "
        "whose patches hardly overlap."
    )
    text = (
        "Over the commanded displacement. Tilt of the board, errors of the grasp and slip make "
        "them uneven about the middle."
    )
    title = f"What the data look like ({twins['piece'].title()} on {twins['bottom']})"
    return Section(title, (text, alike), (Gallery("Signals", maps), *pairs))


def _pair(number: int, pair: Json, twins: Json) -> Gallery:
    points = np.array(twins["points_mm"])
    pictures = []
    for name, text, at in zip("AB", pair["patch"], pair["offset_mm"], strict=True):
        patch = patch_bits(text, len(points))
        note = f"at {at[0]:+.1f}, {at[1]:+.1f} mm"
        pictures.append(Picture(patch_picture(points, patch, f"Patch {name}", note)))
    words = (
        f"Overlap of the patches {100 * pair['patch_iou']:.0f} %; signals differ by "
        f"{pair['marker_rms_px']:.2f} px, {pair['force_rms_n']:.2f} N, "
        f"{1e3 * pair['moment_rms_nm']:.1f} N mm (rms); nearer are {100 * pair['rank']:.2f} % of "
        "all pairs of presses."
    )
    for key, title, unit in (
        ("force_n", "Force, A full, B dashed", "N"),
        ("moment_nm", "Moment, A full, B dashed", "N m"),
    ):
        a, b = (np.array(values) for values in pair[key])
        pictures.append(Picture(twin_traces(a, b, title, unit)))
    return Gallery(f"Pair {number}", tuple(pictures), words)


def _films(films: Sequence[Json]) -> Section | None:
    if not films:
        return None
    legend = (
        "Belief maps, 40 mm wide: yellow is support, blue is none, grey is unknown. Double line: "
        "hull of support above 90 %. Cross: centre of mass and planned step. Dashed: the true "
        "support, drawn after the fact."
    )
    strips = []
    for film in films:
        probes = tuple(
            Picture(harmless(probe["svg"]), f"Probe {number}", probe["why"])
            for number, probe in enumerate(film["probes"], 1)
        )
        strips.append(Gallery(film["title"], probes, end=film["end"]))
    return Section("How the belief grew", (legend,), tuple(strips))
