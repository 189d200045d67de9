"""The page of the experiments: tables beside the paper's numbers, and the figures behind them."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from backend.dataset.rows import patch_bits
from backend.experiments.charts import patch_picture, reliability_chart, scatter, twin_traces
from backend.objects.tower import TOO_CLOSE_MM

Json = Mapping[str, Any]
STYLE = """
body{font:15px/1.45 'DejaVu Sans',system-ui,sans-serif;color:#1B2127;background:#F2F4F6;
margin:2em auto;max-width:1180px;padding:0 1em}
h1{font-size:1.5em}h2{font-size:1.2em;margin:2em 0 .3em}h3{font-size:1em;margin:1.2em 0 .2em}
.banner{background:#F9C800;color:#14181C;padding:.35em .8em;display:inline-block;font-weight:600}
.wide{overflow-x:auto}.strip,.charts{display:flex;gap:14px;flex-wrap:wrap}
.charts svg{background:#fff;border:1px solid #C9D0D7}
.probe{background:#fff;border:1px solid #C9D0D7;padding:10px;width:232px}
.probe p{margin:.4em 0;font-size:.85em}.end{font-weight:600}
table{border-collapse:collapse;background:#fff}
th{text-align:left;font-weight:600;white-space:nowrap}td{text-align:right;white-space:nowrap}
td,th{padding:.35em .7em;border-bottom:1px solid #C9D0D7;vertical-align:top}
small{color:#55606B;display:block;font-size:.8em}code{font-size:.85em;overflow-wrap:anywhere}
"""


def tables_page(
    tables: Json, twins: Json | None, films: Sequence[tuple[str, str]], beyond: str = ""
) -> str:
    """Return the whole page; ``films``: title and strip of each shown trial.

    ``beyond``: the part on strategies beyond the paper, where they were compared.
    """
    facts = tables["bench_facts"]
    slipped = facts["slipped"]
    slip = "not measured" if slipped is None else f"{100 * slipped:.0f} %"
    body = [
        f"<h1>Touchdown: the paper's experiments, {tables['scale']}</h1>",
        '<p class="banner">SIMULATED BENCH: no robot moved for these figures</p>',
        f"<p>Preset <b>{tables['bench']['preset']}</b>, bench "
        f"<code>{tables['bench_sha256'][:16]}</code>, program {html.escape(tables['code'])}. "
        f"A pad slipped by more than 0.02 mm in {slip} of the probes. In brackets: 95 % interval "
        "(Wilson for rates; over grippings for means). Below each value stands the paper's, of a "
        "real robot. Hover over a cell for the job and the seed that it comes from.</p>",
        _table1(tables["table1"]),
        _table2(tables["table2"]),
        _table3(tables["table3"]),
        beyond,
        _reliability(facts["after_three_probes"]),
        "" if twins is None else _distribution(twins),
        _films(films),
        "<h2>Traces</h2><p>Every cell names its job in <code>tables.json</code>; the folder of "
        "that name under <code>jobs/</code> holds its settings (<code>spec.json</code>), inputs "
        "and answer.</p>",
    ]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>Touchdown experiments</title><style>{STYLE}</style></head>"
        f"<body>{''.join(body)}</body></html>"
    )


def _table1(rows: Sequence[Json]) -> str:
    parts = ["<h2>Table 1: contact patch from one probe</h2>"]
    words = {"iou": "IoU, %", "accuracy": "Face points right, %"}
    for metric, title in words.items():
        chosen = [row for row in rows if row["metric"] == metric]
        lines = [
            (row["model"], [_cell(cell) for cell in row["cells"]], _mean(row)) for row in chosen
        ]
        parts.append(f"<h3>{title}</h3>{_grid(chosen[0]['cells'], lines)}")
    parts.append(
        "<p><small>Against the label, which is the overlap at the commanded displacement, as data "
        "is labelled on a bench; <code>against_truth</code> in the JSON is against the real "
        "one.</small></p>"
    )
    return "".join(parts)


def _table2(rows: Sequence[Json]) -> str:
    names = {"Implicit": "Implicit", **{n: f"Ours, n = {n}" for n in ("1", "2", "3", "5")}}
    lines = []
    for row in rows:
        cells = [_stability_cell(cell) for cell in row["cells"]]
        lines.append((names[row["method"]], cells, _pooled(row["pooled"])))
    cells = rows[0]["cells"]
    excluded = max(sum(cell.get("excluded", 0) for cell in row["cells"]) for row in rows)
    return (
        "<h2>Table 2: would it stand?</h2><h3>Right, %, on a sample with as many stable as "
        f"unstable places</h3>{_grid(cells, lines, 'pooled')}"
        f"<p><small>{excluded} cases with a margin within {TOO_CLOSE_MM} mm are left out. Further "
        "probes are random ones of the same gripping; the question is always asked for the place "
        "of the first. By every interface; the top one alone in the JSON.</small></p>"
    )


def _table3(rows: Sequence[Json]) -> str:
    parts = ["<h2>Table 3: stacking</h2>"]
    titles = {"one": "One bottom", "two": "Two bottoms: Long stands on Short, off centre by 0-6 mm"}
    for tower, title in titles.items():
        chosen = [row for row in rows if row["tower"] == tower]
        lines = []
        for row in chosen:
            name = "Pick and place" if row["strategy"] == "pick-and-place" else "Ours"
            cells = [_stacking_cell(cell) for cell in row["cells"]]
            unsafe = row["unsafe"]
            total = _value(row["pooled"], row["paper_pooled"])
            if unsafe["n"]:
                total += f"<small>fell {_percent(unsafe['value'])} % of {unsafe['n']}</small>"
            lines.append((name, cells, total))
        parts.append(f"<h3>{title}: placed, %</h3>{_grid(chosen[0]['cells'], lines, 'pooled')}")
    parts.append(
        "<p><small>Every trial counts; every start is unstable; the exact judge of all interfaces "
        "decides. Counts: placed / fell / knocked over / gave up / aborted. <i>Devices agree</i>: "
        "trials repeated with devices, images and tracker that ended alike.</small></p>"
    )
    return "".join(parts)


def _grid(
    cells: Sequence[Json], lines: Sequence[tuple[str, Sequence[str], str]], last: str = "mean"
) -> str:
    head = "".join(f"<th>{c['piece'].title()}<small>{c['bottom']}</small></th>" for c in cells)
    rows = [
        f"<tr><th>{html.escape(name)}</th>{''.join(values)}<td>{total}</td></tr>"
        for name, values, total in lines
    ]
    return (
        f'<div class="wide"><table><tr><th></th>{head}<th>{last}</th></tr>'
        f"{''.join(rows)}</table></div>"
    )


def _cell(cell: Json, more: str = "") -> str:
    trace = f"job {cell.get('job', 'none')}, seed {cell.get('seed', 'none')}"
    return f'<td title="{trace}">{_value(cell, cell["paper"])}{more}</td>'


def _stability_cell(cell: Json) -> str:
    if "accuracy" not in cell:
        return _cell(cell)
    found, unsafe = cell["found"]["value"], cell["unsafe"]["value"]
    more = (
        f"<small>base {_percent(cell['base_rate'])}, balanced {_percent(cell['balanced'])}<br>"
        f"found {_percent(found)}, unsafe {_percent(unsafe)}</small>"
    )
    return _cell({**cell, **cell["accuracy"]}, more)


def _stacking_cell(cell: Json) -> str:
    counts = cell.get("outcomes")
    if counts is None:
        return _cell(cell)
    order = ("placed", "fell", "knocked_over", "gave_up", "aborted")
    more = "<small>" + " / ".join(str(counts.get(word, 0)) for word in order) + "</small>"
    again = cell.get("devices")
    if again:
        more += f"<small>devices agree {again['same_outcome']} of {again['trials']}</small>"
    if cell["probes"] is not None:
        more += f"<small>{cell['probes']:.1f} probes</small>"
    return _cell(cell, more)


def _pooled(pooled: Json) -> str:
    if pooled["accuracy"]["value"] is None:
        return "-"
    return _value(pooled["accuracy"], None) + (
        f"<small>balanced {_percent(pooled['balanced'])}<br>found "
        f"{_percent(pooled['found']['value'])}, unsafe {_percent(pooled['unsafe']['value'])}"
        "</small>"
    )


def _mean(row: Json) -> str:
    return f"{_percent(row['mean'])}<small>paper {_percent(row['paper_mean'])}</small>"


def _value(estimate: Json, printed: float | None) -> str:
    value = estimate.get("value")
    text = "-"
    if value is not None:
        text = f"{_percent(value)} <small>({_percent(estimate['low'])}-"
        text += f"{_percent(estimate['high'])})</small>"
    return text + ("" if printed is None else f"<small>paper {_percent(printed)}</small>")


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f}"


def _reliability(charts: Sequence[Json]) -> str:
    if not charts:
        return ""
    drawn = "".join(
        reliability_chart(
            chart["promised"],
            chart["came"],
            f"{chart['piece'].title()} on {chart['bottom']}",
            f"ECE {chart['ece']:.3f}, IoU {_percent(chart['map_iou']['value'])}",
        )
        for chart in charts
    )
    return (
        "<h2>Do the probabilities keep their promise?</h2><p>Belief after three probes against the "
        "true support, over all covered cells, 15 bins of equal mass. Along: promised. Up: came "
        f'true.</p><div class="charts">{drawn}</div>'
    )


def _distribution(twins: Json) -> str:
    offset = np.array(twins["offset_mm"])
    reach = float(np.abs(offset).max())
    moment = np.array(twins["moment_nm"])
    maps = [
        scatter(offset, np.array(twins["marker_px"]), "Largest marker displacement", "px", reach),
        scatter(offset, moment[:, 0], "Tx at the end of the press", "N m", reach),
        scatter(offset, moment[:, 1], "Ty at the end of the press", "N m", reach),
    ]
    title = f"{twins['piece'].title()} on {twins['bottom']}"
    pairs = "".join(_pair(number, pair, twins) for number, pair in enumerate(twins["pairs"], 1))
    return (
        f"<h2>What the data look like ({title})</h2><p>Over the commanded displacement. Tilt of "
        "the board, errors of the grasp and slip make them uneven about the middle.</p>"
        f'<div class="charts">{"".join(maps)}</div><h3>Presses that feel alike and are not</h3>'
        f"<p>Nearest signals among all pairs whose patches hardly overlap.</p>{pairs}"
    )


def _pair(number: int, pair: Json, twins: Json) -> str:
    points = np.array(twins["points_mm"])
    pictures = []
    for name, text, at in zip("AB", pair["patch"], pair["offset_mm"], strict=True):
        patch = patch_bits(text, len(points))
        note = f"at {at[0]:+.1f}, {at[1]:+.1f} mm"
        pictures.append(patch_picture(points, patch, f"Patch {name}", note))
    words = (
        f"Pair {number}: overlap of the patches {100 * pair['patch_iou']:.0f} %; signals differ by "
        f"{pair['marker_rms_px']:.2f} px, {pair['force_rms_n']:.2f} N, "
        f"{1e3 * pair['moment_rms_nm']:.1f} N mm (rms); nearer are {100 * pair['rank']:.2f} % of "
        "all pairs of presses."
    )
    traces = "".join(
        twin_traces(np.array(pair[key][0]), np.array(pair[key][1]), title, unit)
        for key, title, unit in (
            ("force_n", "Force, A full, B dashed", "N"),
            ("moment_nm", "Moment, A full, B dashed", "N m"),
        )
    )
    return f'<p>{words}</p><div class="charts">{"".join(pictures)}{traces}</div>'


def _films(films: Sequence[tuple[str, str]]) -> str:
    if not films:
        return ""
    legend = (
        "<p>Belief maps, 40 mm wide: yellow is support, blue is none, grey is unknown. Double "
        "line: hull of support above 90 %. Cross: centre of mass and planned step. Dashed: the "
        "true support, drawn after the fact.</p>"
    )
    strips = "".join(f"<h3>{html.escape(title)}</h3>{strip}" for title, strip in films)
    return f"<h2>How the belief grew</h2>{legend}{strips}"
