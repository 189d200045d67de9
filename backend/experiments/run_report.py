"""Report page of a set of runs: belief maps, wrench traces and decisions, probe by probe.

``belief_film`` stores a simulated trial as a strip of belief maps.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.backend import core
from touchdown.backend.experiments import document
from touchdown.backend.experiments.trials import BatchTrialResult
from touchdown.backend.geometry import rings_of

WIDTH_PX = 230
BAR_MM = 7.0  # width of the colour bar beside a belief map of 40 mm
ARROW_GAIN = 3  # drawn length of a displacement of a marker over the real one


def _base64(image: NDArray[np.uint8]) -> str:
    return base64.b64encode(image.tobytes()).decode("ascii")


def belief_svg(
    updated: core.BeliefUpdated,
    judged: core.StabilityJudged,
    chosen: core.ActionChosen,
    true_outline_mm: core.FloatArray | None,
    view_mm: float = 20.0,
) -> str:
    """Return one panel: map, hull, centre of mass, planned step, and the true support if known.

    A bar of the colours of p (support) stands at the right.

    The view is ``2 view_mm`` wide around the centre of the map; y points up.
    """
    belief = updated.belief
    grey = np.round(255 * belief.probability[::-1]).astype(np.uint8)
    _, png = cv2.imencode(".png", cv2.applyColorMap(grey, cv2.COLORMAP_CIVIDIS))
    ny, nx = belief.log_odds.shape
    half = 0.5 * belief.pitch_mm
    left, bottom = belief.origin_mm[0] - half, belief.origin_mm[1] - half
    cx = left + 0.5 * nx * belief.pitch_mm
    cy = bottom + 0.5 * ny * belief.pitch_mm
    wide_mm, right = 2 * view_mm + BAR_MM, cx + view_mm
    parts = [
        f'<svg viewBox="{cx - view_mm} {-cy - view_mm} {wide_mm} {2 * view_mm}" '
        f'width="{WIDTH_PX}" height="{2 * view_mm * WIDTH_PX / wide_mm:.0f}" role="img" '
        f'aria-label="Belief map after probe {updated.probe}">',
        f'<image x="{left}" y="{-(bottom + ny * belief.pitch_mm)}" '
        f'width="{nx * belief.pitch_mm}" height="{ny * belief.pitch_mm}" '
        'preserveAspectRatio="none" style="image-rendering:pixelated" '
        f'href="data:image/png;base64,{_base64(png)}"/>',
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
        parts.append(f'<path d="M{cx - view_mm + 2} {view_mm - cy - 2}h10" {style}/>')
    place = f'x="{cx - view_mm + 13}" y="{view_mm - cy - 1.2}"'
    parts.append(f'<text {place} font-size="2.4" fill="#ffffff">10 mm</text>')
    ramp = np.arange(255, -1, -5, dtype=np.uint8)[:, None]
    _, png = cv2.imencode(".png", cv2.applyColorMap(ramp, cv2.COLORMAP_CIVIDIS))
    parts.append(
        f'<rect x="{right}" y="{-cy - view_mm}" width="{BAR_MM}" height="{2 * view_mm}" '
        f'fill="#ffffff"/><image x="{right + 1}" y="{-cy - 12}" width="1.8" height="24" '
        f'preserveAspectRatio="none" href="data:image/png;base64,{_base64(png)}"/>'
    )
    for text, y in (("p", -14.0), ("1", -10.2), ("0.5", 0.9), ("0", 12.0)):
        label = f'x="{right + 3.2}" y="{y - cy}" font-size="2.2" fill="{document.INK}"'
        parts.append(f"<text {label}>{text}</text>")
    parts.append("</svg>")
    return "".join(parts)


def _polygon(points_mm: core.FloatArray, colour: str, width: float, dash: str = "") -> str:
    rings = [" ".join(f"{x:.2f},{-y:.2f}" for x, y in ring) for ring in rings_of(points_mm)]
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    style = f'fill="none" stroke="{colour}" stroke-width="{width}"{dashes}'
    return "".join(f'<polygon points="{text}" {style}/>' for text in rings)


def wrench_svg(episode: core.Episode) -> str:
    """Return the 10 Hz forces of one probe in N over the 2 s after contact."""
    force = episode.observation[:, 252:255].astype(np.float64)
    top = max(1.0, float(np.nanmax(np.abs(force))))
    texts = [(0, 8, "start", document.INK, "F (N) over time after contact (s)")]
    rows = (17, f"+{top:.1f}"), (37, "0"), (57, f"\N{MINUS SIGN}{top:.1f}")
    texts += [(24, y, "end", document.INK, text) for y, text in rows]
    texts += [(26 + 88 * t_s, 69, "middle", document.INK, f"{t_s}") for t_s in range(3)]
    lines = [f'<path d="M26 14v40h176M26 34h176" stroke="{document.FAINT}" fill="none"/>']
    for axis, colour in enumerate((document.BLUE, document.ORANGE, document.VIOLET)):
        texts.append((164 + 15 * axis, 8, "start", colour, f"F{'xyz'[axis]}"))
        points = " ".join(
            f"{26 + 8.8 * (k + 1):.1f},{34 - 20 * v / top:.1f}"
            for k, v in enumerate(force[:, axis])
        )
        lines.append(f'<polyline points="{points}" fill="none" stroke="{colour}"/>')
    words = (f'<text x="{x}" y="{y}" font-size="9" text-anchor="{anchor}" fill="{colour}">{text}'
             "</text>" for x, y, anchor, colour, text in texts)  # fmt: skip
    return (
        f'<svg viewBox="0 0 210 72" width="{WIDTH_PX}" height="79" role="img" '
        f'aria-label="Forces of the probe">{"".join((*lines, *words))}</svg>'
    )


def tactile_png(episode: core.Episode) -> str:
    """Return the last images of both fingers side by side as an ``img`` tag; "" without images."""
    if episode.recording is None:
        return ""
    last = {frame.finger: frame.image for frame in episode.recording.frames}
    if set(last) != {"left", "right"}:
        return ""
    for markers in {one.finger: one for one in episode.recording.fields}.values():
        last[markers.finger] = _with_arrows(last[markers.finger], markers)
    both = cv2.hconcat([last["left"], last["right"]])
    small = cv2.resize(both, (WIDTH_PX * 2, WIDTH_PX * 3 // 4), interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 85])
    return (
        f'<img alt="Tactile images, left and right finger" width="{WIDTH_PX}" '
        f'src="data:image/jpeg;base64,{_base64(jpeg)}"/>'
    )


def _with_arrows(image: NDArray[np.uint8], markers: core.MarkerField) -> NDArray[np.uint8]:
    drawn = image.copy()
    by_px = markers.displacement_px
    rest_px = markers.position_px - by_px
    arrows_px = np.stack([rest_px, rest_px + ARROW_GAIN * by_px], axis=1)
    known = np.isfinite(arrows_px).all(axis=(1, 2))
    for start, tip in np.rint(arrows_px[known] * image.shape[1] / 320).astype(int).tolist():
        cv2.arrowedLine(drawn, start, tip, (0, 200, 249), 2, cv2.LINE_AA, tipLength=0.35)
    return drawn


FILM_FILE = "film.json"  # file of a job with the strips of its trials


def belief_film(end: BatchTrialResult, outline_mm: core.FloatArray) -> Mapping[str, Any]:
    """Return the strip for JSON; ``outline_mm`` (k, 2): true support in true places.

    The map is in commanded places, which differ from the true ones by the errors of grasp and
    print. The outline is shifted by the difference at the last probe.
    """
    probes = []
    last = end.steps[-1].offset_mm if end.steps else (0.0, 0.0)
    true = end.true_mm or last
    shift = (last[0] - true[0], last[1] - true[1])
    for number, step in enumerate(end.steps, start=1):
        picture = belief_svg(
            core.BeliefUpdated(0.0, step.map, number),
            core.StabilityJudged(0.0, step.stability, number),
            core.ActionChosen(0.0, step.action, number, 0.0),
            outline_mm + shift,
        )
        probes.append({"svg": picture, "why": step.action.reason})
    word = end.outcome.value.replace("_", " ")
    return {"end": f"Seed {end.seed}: {word}. {end.reason}", "probes": probes}


_LEGEND = (
    f"{document.FILM_LEGEND} Below: forces of the press, and both tactile images at its end; "
    f"arrows: displacements of the markers, {ARROW_GAIN} times enlarged."
)


_AnyEvent = TypeVar("_AnyEvent", bound=core.Event)


@dataclass
class _TrialRecord:
    started: core.TrialStarted
    events: list[core.Event] = field(default_factory=list)

    def of(self, kind: type[_AnyEvent]) -> list[_AnyEvent]:
        return [event for event in self.events if isinstance(event, kind)]

    @property
    def finished(self) -> core.TrialFinished | None:
        return next(iter(self.of(core.TrialFinished)), None)


def write_run_report(
    path: Path, runs: Sequence[Iterable[core.Event]], outlines_mm: Mapping[str, core.FloatArray]
) -> None:
    """Write the report page of some runs atomically.

    Parameters
    ----------
    path : Path
        HTML file to write; an existing file is replaced.
    runs : sequence of iterables of Event
        Events of each run in order. Panels with signals need ``EpisodeRecorded.episode``.
    outlines_mm : mapping of str to (k, 2) array
        True outline of each bottom in mm, in the frame of the belief map (y up), drawn dashed.
        Leave a bottom out if its truth is unknown.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    galleries, rows, about, placed = [], [], [written_text(), _LEGEND], 0
    for events in runs:
        head, trials = _split_trials(events)
        if head is None:
            continue
        about.append(run_text(head))
        outline = outlines_mm.get(head.bottom.split("+")[-1]) if head.simulated else None
        for trial in trials:
            title = f"{head.piece} on {head.bottom}, seed {trial.started.seed}"
            galleries.append(_gallery(title, trial, outline))
            rows.append((title, *_result(trial)))
            end = trial.finished
            placed += end is not None and end.outcome is core.Outcome.PLACED
    table = document.ReportTable.of_texts("", ("trial", "outcome", "probes", "true margin"), rows)
    report = document.Report(
        f"Touchdown: {placed} of {len(rows)} placed",
        tuple(about),
        (document.ReportSection("", (), (table, *galleries)),),
    )
    core.write_atomically(path, document.report_page(report).encode())


def written_text() -> str:
    """Return the date of a report that is written now, and the program."""
    return f"Written on {datetime.now():%Y-%m-%d at %H:%M} by touchdown {core.program_version()}."


def run_text(head: core.RunStarted) -> str:
    """Return pieces, strategy, model and seed of a run as one line."""
    told = f"Run {head.run_id}: {head.piece} on {head.bottom}, strategy {head.strategy}"
    return f"{told}, {_model_text(head)}seed {head.seed}."


def _model_text(head: core.RunStarted) -> str:
    """Return the model or network of a run; "" if its settings name none."""
    record = json.loads(head.settings)
    method = record.get("method", {})
    if method.get("strategy", head.strategy) == "fused":
        weights = method.get("fused", {}).get("weights")
        return f"network {weights}, " if weights else "the shipped network, "
    model = record.get("model") or {}
    return f"model of {model['piece']} {model['weights_sha256'][:16]}, " if model else ""


def _split_trials(facts: Iterable[core.Event]) -> tuple[core.RunStarted | None, list[_TrialRecord]]:
    head: core.RunStarted | None = None
    trials: list[_TrialRecord] = []
    for fact in facts:
        if isinstance(fact, core.RunStarted):
            head = fact
        elif isinstance(fact, core.TrialStarted):
            trials.append(_TrialRecord(fact))
        elif trials:
            trials[-1].events.append(fact)
    return head, trials


def _result(trial: _TrialRecord) -> tuple[str, str, str]:
    end = trial.finished
    if end is None:
        return "interrupted", "", ""
    margin = "" if end.margin_mm is None else f"{end.margin_mm:+.2f} mm"
    return end.outcome.value.replace("_", " "), str(end.probes), margin


def _gallery(
    title: str, trial: _TrialRecord, outline_mm: core.FloatArray | None
) -> document.PictureGallery:
    pictures = []
    episodes = {recorded.probe: recorded for recorded in trial.of(core.EpisodeRecorded)}
    panels = (
        trial.of(core.BeliefUpdated),
        trial.of(core.StabilityJudged),
        trial.of(core.ActionChosen),
    )
    for updated, judged, chosen in zip(*panels, strict=False):
        drawing = belief_svg(updated, judged, chosen, outline_mm)
        if recorded := episodes.get(updated.probe):
            drawing += wrench_svg(recorded.episode) + tactile_png(recorded.episode)
        pictures.append(
            document.ReportPicture(drawing, f"Probe {updated.probe}", chosen.action.reason)
        )
    reason = "Interrupted." if trial.finished is None else trial.finished.reason
    end = " ".join([*(event.fault.what for event in trial.of(core.FaultRaised)), reason])
    return document.PictureGallery(title, tuple(pictures), end=end)
