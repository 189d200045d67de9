"""Pictures of a run as SVG text: belief maps with what was decided on them, and wrench traces."""

from __future__ import annotations

import base64

import cv2
import numpy as np

from backend.core.facts import ActionChosen, BeliefUpdated, StabilityJudged
from backend.core.flow import BeliefMap, Episode, FloatArray

WIDTH_PX = 230
AXIS_COLOURS = ("#005FCC", "#C04A00", "#3A0D3F")


def _map_png(belief: BeliefMap) -> str:
    grey = np.round(255 * belief.probability[::-1]).astype(np.uint8)
    ok, png = cv2.imencode(".png", cv2.applyColorMap(grey, cv2.COLORMAP_CIVIDIS))
    assert ok
    return base64.b64encode(png.tobytes()).decode("ascii")


def belief_svg(
    updated: BeliefUpdated,
    judged: StabilityJudged,
    chosen: ActionChosen,
    true_outline_mm: FloatArray | None,
    view_mm: float = 20.0,
) -> str:
    """Return one panel: map, hull, centre of mass, planned step, and the true support if known.

    The view is ``2 view_mm`` wide around the centre of the map; y points up.
    """
    belief = updated.belief
    ny, nx = belief.log_odds.shape
    half = 0.5 * belief.pitch_mm
    left, bottom = belief.origin_mm[0] - half, belief.origin_mm[1] - half
    cx = left + 0.5 * nx * belief.pitch_mm
    cy = bottom + 0.5 * ny * belief.pitch_mm
    parts = [
        f'<svg viewBox="{cx - view_mm} {-cy - view_mm} {2 * view_mm} {2 * view_mm}" '
        f'width="{WIDTH_PX}" height="{WIDTH_PX}" role="img" '
        f'aria-label="Belief map after probe {updated.probe}">',
        f'<image x="{left}" y="{-(bottom + ny * belief.pitch_mm)}" '
        f'width="{nx * belief.pitch_mm}" height="{ny * belief.pitch_mm}" '
        'preserveAspectRatio="none" style="image-rendering:pixelated" '
        f'href="data:image/png;base64,{_map_png(belief)}"/>',
    ]
    if true_outline_mm is not None:
        parts.append(_polygon(true_outline_mm, "#ffffff", 0.25, dash="0.8 0.8"))
    hull = judged.stability.hull_mm
    if len(hull) >= 2:
        parts += [_polygon(hull, "#000000", 0.6), _polygon(hull, "#ffffff", 0.3)]
    x, y = judged.stability.centre_mm
    step = chosen.action.step_mm
    for colour, width in (("#000000", 0.9), ("#ffffff", 0.4)):
        style = f'stroke="{colour}" stroke-width="{width}"'
        parts.append(f'<path d="M{x - 1.4} {-y}h2.8M{x} {-y - 1.4}v2.8" {style}/>')
        parts.append(f'<path d="M{x} {-y}l{step[0]} {-step[1]}" {style}/>')
    parts.append("</svg>")
    return "".join(parts)


def _polygon(points_mm: FloatArray, colour: str, width: float, dash: str = "") -> str:
    text = " ".join(f"{x:.2f},{-y:.2f}" for x, y in points_mm)
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    return (
        f'<polygon points="{text}" fill="none" stroke="{colour}" stroke-width="{width}"{dashes}/>'
    )


def wrench_svg(episode: Episode) -> str:
    """Return the 10 Hz forces of one probe, N over the 2 s after contact."""
    force = episode.observation[:, 252:255].astype(np.float64)
    top = max(1.0, float(np.nanmax(np.abs(force))))
    lines = []
    for axis, colour in enumerate(AXIS_COLOURS):
        points = " ".join(
            f"{10 * (k + 1):.1f},{30 - 26 * v / top:.1f}" for k, v in enumerate(force[:, axis])
        )
        lines.append(f'<polyline points="{points}" fill="none" stroke="{colour}"/>')
    return (
        f'<svg viewBox="0 0 210 64" width="{WIDTH_PX}" height="70" role="img" '
        f'aria-label="Forces of the probe">'
        '<path d="M10 30h195" stroke="#76818C" stroke-width="0.5"/>'
        + "".join(lines)
        + '<text x="10" y="62" font-size="9" fill="#55606B">'
        + f"Fx Fy Fz, ±{top:.1f} N, 2 s</text></svg>"
    )


def tactile_png(episode: Episode) -> str:
    """Return both fingers' last images of a probe side by side as an ``img`` tag, or ""."""
    if episode.recording is None:
        return ""
    last = {frame.finger: frame.image for frame in episode.recording.frames}
    if set(last) != {"left", "right"}:
        return ""
    both = cv2.hconcat([last["left"], last["right"]])
    small = cv2.resize(both, (WIDTH_PX * 2, WIDTH_PX * 3 // 4), interpolation=cv2.INTER_AREA)
    ok, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 85])
    assert ok
    data = base64.b64encode(jpeg.tobytes()).decode("ascii")
    return (
        f'<img alt="Tactile images, left and right finger" width="{WIDTH_PX}" '
        f'src="data:image/jpeg;base64,{data}"/>'
    )
