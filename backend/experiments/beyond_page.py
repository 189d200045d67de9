"""Strategies beyond the paper on a page: their columns, reliability, and the way to the ceiling."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

from backend.experiments.charts import reliability_chart
from backend.experiments.compared import Sheet, sheets
from backend.experiments.tables_page import STYLE


def beyond_section(answer: Mapping[str, Any]) -> str:
    """Return the part of a page that shows an answer of ``touchdown experiment beyond``."""
    tables = "".join(_table(sheet) for sheet in sheets(answer))
    return (
        "<h2>Beyond the paper</h2><p>Closed loops count every trial, whatever its outcome; "
        "<i>unsafe</i>: fell or knocked over; <i>spare</i>: probes beyond the least number, "
        "median. Towers: the upper bottom stands off the lower one by 0 to 6 mm; those on which "
        f"the piece has no stable place are left out.</p>{tables}{_charts(answer)}"
    )


def beyond_page(answer: Mapping[str, Any]) -> str:
    """Return that part as a page of its own."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>Touchdown: beyond the paper</title><style>{STYLE}</style></head><body>"
        "<h1>Touchdown: strategies beyond the paper</h1>"
        '<p class="banner">SIMULATED BENCH: no robot moved for these figures</p>'
        f"<p>Bench <code>{answer['bench_sha256'][:16]}</code>, program "
        f"{html.escape(answer['code'])}.</p>{beyond_section(answer)}</body></html>"
    )


def _table(sheet: Sheet) -> str:
    if not sheet.rows:
        return ""
    head = "".join(f"<th>{html.escape(word)}</th>" for word in sheet.columns)
    rows = "".join(
        f"<tr><th>{html.escape(row[0])}</th>"
        + "".join(f"<td>{html.escape(value)}</td>" for value in row[1:])
        + "</tr>"
        for row in sheet.rows
    )
    return (
        f"<h3>{html.escape(sheet.title)}</h3>"
        f'<div class="wide"><table><tr>{head}</tr>{rows}</table></div>'
    )


def _charts(answer: Mapping[str, Any]) -> str:
    drawn = [
        reliability_chart(
            chart["promised"],
            chart["came"],
            pooled["strategy"],
            f"n = {n}, ECE {chart['ece']:.3f}",
        )
        for pooled in answer.get("statics", {}).get("pooled", ())
        for n, chart in pooled["reliability"].items()
    ]
    if not drawn:
        return ""
    return (
        "<h3>Promised and true</h3><p>Covered cells, 15 bins of equal mass. Along: promised. Up: "
        f'came true.</p><div class="charts">{"".join(drawn)}</div>'
    )
