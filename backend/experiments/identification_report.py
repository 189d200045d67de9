"""Identification of a dataset as a job, and its report page.

The page shows the decision, verdict, parameters and figures of each stage, and the replay.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.backend.annotations import CheckProgress, Dataset, no_progress
from touchdown.backend.config import TICK_S, SimulationSettings, parse_settings
from touchdown.backend.core import InputError, write_atomically
from touchdown.backend.experiments.document import (
    SIMULATED,
    PictureGallery,
    Report,
    ReportPicture,
    ReportSection,
    ReportTable,
    TableEntry,
    curves_chart,
    report_page,
)
from touchdown.backend.geometry import load_pieces
from touchdown.backend.identification import (
    GATE_CHANNELS,
    PHASES,
    PLANS,
    Estimate,
    Identification,
    identifiable,
    identify_bench,
    read_recordings,
    write_identification,
)
from touchdown.backend.jobs import JobContext, JobSpec

STAGES = {1: "Sensors at rest", 2: "Arm and grasp", 3: "Gel", 4: "Contact"}
BARS = "Vertical lines are 95 % intervals where these are larger than the point."
MEASURED = "Recordings of devices: these figures hold for this set-up"


def identify_dataset(
    spec: JobSpec, place: JobContext, tell: CheckProgress = no_progress
) -> Mapping[str, Any]:
    """Identify the bench of a dataset; write bench file, figures and page to the job's folder.

    The answer has the decision and the estimates, or ``refused`` with the parts of an
    ``InputError``. Finished stages stay in the folder ``stages`` of the parameters.
    """
    p, out = spec.params, place.folder / spec.params["name"]
    library = load_pieces(p["pieces"] and Path(p["pieces"]))
    nominal = parse_settings(SimulationSettings, p["bench"], "job")
    try:
        with Dataset.open(Path(p["dataset"]), write=False, progress=tell) as dataset:
            recordings = read_recordings(dataset, lambda done, of: tell("Reading", done, of))
        found = identify_bench(recordings, nominal, library, Path(p["stages"]), tell)
    except InputError as error:
        return {"refused": [error.what, error.where, error.fix]}
    report = identification_report(found, p["dataset"])
    write_atomically(out.with_suffix(".html"), report_page(report).encode())
    write_identification(found, out, p["dataset"], asdict(report))
    return {
        "accepted": found.gate.accepted, "reason": found.reason, "share": found.gate.share,
        "verdicts": [f"{k} {title}. {found.verdict(k)}" for k, title in STAGES.items()],
        "used": list(found.used), "use": {e.key: found.use(e) for e in found.estimates},
        "estimates": {e.key: [e.value, e.sigma, e.unit] for e in found.estimates},
        "names": {e.key: e.name for e in found.estimates},
    }  # fmt: skip


def identification_report(found: Identification, source: str) -> Report:
    """Return the report of an identification of the dataset ``source``."""
    about = (
        found.reason,
        f"{found.presses} presses in {found.grips} grippings of {source}. Mean square of the "
        f"residuals over their noise: {found.misfit:.2f}; uncertainties are scaled by it. Error of "
        f"the press model that is allowed for: {100 * found.discrepancy:.0f} % of the signals.",
        "The model is that of the simulated bench: what it does not contain is part of the values. "
        "A parameter is used if its standard uncertainty is below half of that of its prior range.",
    )
    banner = SIMULATED if found.simulated else MEASURED
    return Report("Identified bench", about, tuple(_sections(found)), banner)


def _sections(found: Identification) -> Iterator[ReportSection]:
    for stage, title in STAGES.items():
        rows = [e for e in found.estimates if e.stage == stage]
        parts: list[ReportTable | PictureGallery] = [_parameters(rows, found)] if rows else []
        if stage == 1 and found.facts:
            parts.append(ReportTable.of_texts("Further figures", ("figure", "value"), found.facts))
        draw = partial(curves_chart, log=stage == 1, points=stage > 1)
        own = [c for c in found.charts if c.stage == stage]
        charts = tuple(ReportPicture(draw(c.title, c.x, c.curves, c.units)) for c in own)
        parts += [PictureGallery("", charts, BARS if stage > 2 else "")] if charts else []
        yield ReportSection(f"{stage}. {title}", (found.verdict(stage),), tuple(parts))
    yield ReportSection(
        "Replay of held-out presses", (found.reason,), (_gate(found), _example(found))
    )
    yield ReportSection("Correlations", (), (_correlations(found),))
    plans = [(plan, ", ".join(identifiable(plan))) for plan in PLANS]
    missing = ("parameter", "recording that identifies it")
    tables = (
        ReportTable.of_texts("Missing", missing, found.missing),
        ReportTable.of_texts("Identifiable by each recording", ("recording", "parameters"), plans),
    )
    yield ReportSection("What was not identified", (), tables)


def _parameters(rows: list[Estimate], found: Identification) -> ReportTable:
    columns = (("value", "95 % interval"), ("standard uncertainty", "share of the prior's"),
               ("prior", ""), ("unit", ""), ("in the bench file", ""))  # fmt: skip
    entries = tuple(
        (f"{e.name} ({e.key})", (
            TableEntry(f"{e.value:.4g}", f"({e.low:.4g} to {e.high:.4g})"),
            TableEntry(f"{e.sigma:.2g}", f"{e.sharpness:.2f}"),
            TableEntry(f"{e.prior[0]:g} to {e.prior[1]:g}"),
            TableEntry(e.unit),
            TableEntry(found.use(e)),
        ))
        for e in rows
    )  # fmt: skip
    return ReportTable("Parameters", columns, entries, corner="parameter")


def _gate(found: Identification) -> ReportTable:
    gate = found.gate
    columns = tuple((name, "nominal, identified") for name in GATE_CHANNELS)
    rows = tuple(
        (phase, tuple(
            TableEntry(f"{gate.nominal[p, c]:.1f}", f"{gate.identified[p, c]:.1f}")
            for c in range(len(GATE_CHANNELS))
        ))
        for p, phase in enumerate(PHASES)
    )  # fmt: skip
    note = "Root mean square of predicted less measured, over the noise; 1 is noise alone."
    return ReportTable("Residuals of the replay", columns, rows, note, "phase")


def _example(found: Identification) -> PictureGallery:
    t_s = TICK_S * np.arange(1, found.gate.example.shape[1] + 1)
    pictures = []
    for channel, (name, unit) in enumerate((("Fz", "N"), ("shear of the left gel", "px"))):
        measured, nominal, identified = found.gate.example[:, :, channel]
        curves = {"measured": measured, "nominal": nominal, "identified": identified}
        pictures.append(ReportPicture(curves_chart(name, t_s, curves, ("s", unit))))
    return PictureGallery("One held-out press", tuple(pictures))


def _correlations(found: Identification) -> ReportTable:
    header = ("", *found.names)
    rows = [
        (name, *(f"{value:.2f}" for value in row))
        for name, row in zip(found.names, found.correlation, strict=True)
    ]
    return ReportTable.of_texts("Unknowns of the press model; means over grippings", header, rows)
