"""Small charts as SVG text, drawn from numbers alone."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray

SIDE = 220
PAD = 34
INK, FAINT = "#1B2127", "#C9D0D7"
BLUE, ORANGE, VIOLET = "#005FCC", "#C04A00", "#3A0D3F"
"""Of lines and marks: x, y, z where there are three."""


def scatter(
    points_mm: FloatArray, values: FloatArray, title: str, unit: str, reach_mm: float
) -> str:
    """Return a map of ``values`` (n,) at ``points_mm`` (n, 2): colour is value, centre is zero.

    The scale ends at the 98th percentile of the magnitude, so that single presses do not flatten
    the rest; signs share one scale.
    """
    top = float(np.percentile(np.abs(values), 98)) or 1.0
    signed = bool((values < 0).any())
    low = -top if signed else 0.0
    shade = np.clip((values - low) / (top - low), 0.0, 1.0)
    colours = _colours(shade, diverging=signed)
    dots = [
        f'<circle cx="{_x(x, reach_mm):.1f}" cy="{_x(-y, reach_mm):.1f}" r="1.8" fill="{colour}"/>'
        for (x, y), colour in zip(points_mm, colours, strict=True)
    ]
    cross = (
        f'<path d="M{PAD} {SIDE / 2}H{SIDE - PAD}M{SIDE / 2} {PAD}V{SIDE - PAD}" '
        f'stroke="{FAINT}" stroke-width="0.7"/>'
    )
    words = f"{low:.3g} to {top:.3g} {unit}; ±{reach_mm:.0f} mm"
    return _frame(title, cross + "".join(dots) + _text(SIDE / 2, SIDE - 8, words))


def reliability_chart(
    promised: Sequence[float], came: Sequence[float], title: str, note: str
) -> str:
    """Return promise against outcome; an honest model lies on the diagonal."""
    place = [(_unit(p), _unit(1.0 - c)) for p, c in zip(promised, came, strict=True)]
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in place)
    dots = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="{BLUE}"/>' for x, y in place)
    box = (
        f'<rect x="{PAD}" y="{PAD}" width="{SIDE - 2 * PAD}" height="{SIDE - 2 * PAD}" '
        f'fill="none" stroke="{FAINT}"/><path d="M{PAD} {SIDE - PAD}L{SIDE - PAD} {PAD}" '
        f'stroke="{ORANGE}" stroke-dasharray="4 3"/>'
        f'<polyline points="{line}" fill="none" stroke="{BLUE}"/>'
    )
    ticks = _text(PAD - 8, SIDE - PAD + 4, "0") + _text(PAD - 8, PAD + 4, "1")
    ticks += _text(SIDE - PAD, SIDE - PAD + 14, "1")
    return _frame(title, box + dots + ticks + _text(SIDE / 2, SIDE - 6, note))


def patch_picture(points_mm: FloatArray, patch: NDArray[np.bool_], title: str, note: str) -> str:
    """Return the face with the points that touch."""
    reach = float(np.abs(points_mm).max()) + 1.0
    cell = (SIDE - 2 * PAD) / (2.0 * reach)
    cells = [
        f'<rect x="{_x(x, reach) - cell / 2:.1f}" y="{_x(-y, reach) - cell / 2:.1f}" '
        f'width="{cell:.1f}" height="{cell:.1f}" fill="{ORANGE if on else FAINT}"/>'
        for (x, y), on in zip(points_mm, patch, strict=True)
    ]
    return _frame(title, "".join(cells) + _text(SIDE / 2, SIDE - 8, note))


def twin_traces(first: FloatArray, second: FloatArray, title: str, unit: str) -> str:
    """Return three channels of two presses (20, 3) over the 2 s: full and dashed."""
    top = max(float(np.abs(first).max()), float(np.abs(second).max()), 1e-9)
    lines = []
    for values, dash in ((first, ""), (second, ' stroke-dasharray="3 3"')):
        for axis, colour in enumerate((BLUE, ORANGE, VIOLET)):
            points = " ".join(
                f"{_unit(k / (len(values) - 1)):.1f},{_unit(0.5 - 0.5 * v / top):.1f}"
                for k, v in enumerate(values[:, axis])
            )
            lines.append(f'<polyline points="{points}" fill="none" stroke="{colour}"{dash}/>')
    axis_line = f'<path d="M{PAD} {SIDE / 2}H{SIDE - PAD}" stroke="{FAINT}"/>'
    note = _text(SIDE / 2, SIDE - 8, f"x y z, ±{top:.3g} {unit}, 2 s")
    return _frame(title, axis_line + "".join(lines) + note)


def _x(mm: float, reach_mm: float) -> float:
    return _unit(0.5 + 0.5 * mm / reach_mm)


def _unit(share: float) -> float:
    return PAD + share * (SIDE - 2 * PAD)


def _text(x: float, y: float, words: str) -> str:
    return (
        f'<text x="{x:.0f}" y="{y:.0f}" font-size="10" text-anchor="middle" '
        f'fill="{INK}">{escape(words)}</text>'
    )


def _frame(title: str, inside: str) -> str:
    return (
        f'<svg viewBox="0 0 {SIDE} {SIDE}" width="{SIDE}" height="{SIDE}" role="img" '
        f'aria-label="{escape(title)}">{_text(SIDE / 2, 16, title)}{inside}</svg>'
    )


def _colours(shade: FloatArray, *, diverging: bool) -> list[str]:
    table = cv2.COLORMAP_TWILIGHT_SHIFTED if diverging else cv2.COLORMAP_CIVIDIS
    grey = np.round(255 * shade).astype(np.uint8)[:, None]
    return [f"#{r:02x}{g:02x}{b:02x}" for b, g, r in cv2.applyColorMap(grey, table)[:, 0]]
