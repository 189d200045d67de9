"""The page of the sensitivity: one small chart per nuisance, and the figures behind them."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

from backend.experiments.charts import BLUE, FAINT, INK, ORANGE
from backend.experiments.nuisances import FACTORS
from backend.experiments.sensitivity import sensitivity_rows
from backend.experiments.tables_page import STYLE

Json = Mapping[str, Any]
WIDE, TALL, LEFT, BOTTOM, TOP = 260, 190, 34, 34, 30
LOW, HIGH = 0.3, 1.0
"""Range of the vertical axis."""
COLUMNS = ("", "0", "0.5", "2", "3", "stable right, 0", "1", "3")


def sensitivity_page(answer: Json) -> str:
    """Return the whole page."""
    charts = "".join(_chart(nuisance) for nuisance in answer["nuisances"] if nuisance["at"])
    head = "".join(f"<th>{word}</th>" for word in COLUMNS)
    lines = "".join(
        f"<tr><th>{row[0]}</th>" + "".join(f"<td>{cell}</td>" for cell in row[1:]) + "</tr>"
        for row in sensitivity_rows(dict(answer))
    )
    body = [
        "<h1>Touchdown: what each nuisance of the bench costs</h1>",
        '<p class="banner">SIMULATED BENCH: no robot moved for these figures</p>',
        f"<p>{html.escape(answer['piece'].title())} on {' and '.join(answer['bottoms'])}, "
        f"one model as it is, bench <code>{answer['bench_sha256'][:16]}</code>, program "
        f"{html.escape(answer['code'])}. Each nuisance alone is 0 to 3 times as large as on the "
        f'bench; all else, seeds included, stays. <b style="color:{BLUE}">Line with dots</b>: IoU '
        f'of single presses. <b style="color:{ORANGE}">Dashed line with squares</b>: stability '
        "right after one press, on as many stable as unstable places. Bars: 95 % intervals, each "
        "value for itself. Values of one chart share their presses, so that small changes mean "
        "more than the bars say: see the table.</p>",
        f'<div class="charts">{charts}</div>',
        "<h2>Change of the IoU in points, paired by group; stability right, %</h2>"
        f'<div class="wide"><table><tr>{head}</tr>{lines}</table></div>',
    ]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f"<title>Touchdown sensitivity</title><style>{STYLE}</style></head>"
        f"<body>{''.join(body)}</body></html>"
    )


def _chart(nuisance: Json) -> str:
    rows: Sequence[Json] = nuisance["at"]
    parts = [_axes()]
    for get, colour, square in ((_iou, BLUE, False), (_right, ORANGE, True)):
        at = [(row["factor"], get(row)) for row in rows if get(row)["value"] is not None]
        line = " ".join(f"{_x(f):.1f},{_y(e['value']):.1f}" for f, e in at)
        dash = ' stroke-dasharray="5 3"' if square else ""
        parts.append(f'<polyline points="{line}" fill="none" stroke="{colour}"{dash}/>')
        parts += [_mark(_x(factor), estimate, colour, square=square) for factor, estimate in at]
    limit = f"draws end at {nuisance['limit']}" if nuisance["limit"] else ""
    parts.append(_text(WIDE / 2, 14, nuisance["title"], 11))
    parts.append(_text(WIDE / 2, 25, limit, 8))
    title = html.escape(nuisance["title"])
    return (
        f'<svg viewBox="0 0 {WIDE} {TALL}" width="{WIDE}" height="{TALL}" role="img" '
        f'aria-label="{title}">{"".join(parts)}</svg>'
    )


def _axes() -> str:
    parts = []
    for share in (0.4, 0.6, 0.8, 1.0):
        y = _y(share)
        parts.append(f'<path d="M{LEFT} {y:.1f}H{WIDE - 10}" stroke="{FAINT}" stroke-width=".7"/>')
        parts.append(_text(LEFT - 12, y + 3, f"{100 * share:.0f}", 9))
    for factor in FACTORS:
        parts.append(_text(_x(factor), TALL - BOTTOM + 16, f"{factor:g}", 9))
    now = _x(1.0)
    parts.append(
        f'<path d="M{now:.1f} {TOP}V{TALL - BOTTOM}" stroke="{FAINT}" stroke-dasharray="2 3"/>'
    )
    parts.append(_text(WIDE / 2, TALL - 6, "times its size on the bench; %", 9))
    return "".join(parts)


def _mark(x: float, estimate: Json, colour: str, *, square: bool) -> str:
    y, low, high = (_y(estimate[key]) for key in ("value", "low", "high"))
    x += 2.0 if square else -2.0
    bar = f'<path d="M{x:.1f} {low:.1f}V{high:.1f}" stroke="{colour}" stroke-opacity=".45"/>'
    if square:
        return (
            bar
            + f'<rect x="{x - 2.5:.1f}" y="{y - 2.5:.1f}" width="5" height="5" fill="{colour}"/>'
        )
    return bar + f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.8" fill="{colour}"/>'


def _x(factor: float) -> float:
    return LEFT + 12 + (WIDE - LEFT - 34) * factor / FACTORS[-1]


def _y(share: float) -> float:
    within = min(max(share, LOW), HIGH)
    return TALL - BOTTOM - (TALL - BOTTOM - TOP) * (within - LOW) / (HIGH - LOW)


def _text(x: float, y: float, words: str, size: int) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" text-anchor="middle" '
        f'fill="{INK}">{html.escape(words)}</text>'
    )


def _iou(row: Json) -> Json:
    found: Json = row["iou"]
    return found


def _right(row: Json) -> Json:
    found: Json = row["stable_1"]["accuracy"]
    return found
