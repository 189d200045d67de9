"""Identification of a bench from the recordings of a dataset, and its result as a bench file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.backend.config import SimulationSettings, parse_settings
from touchdown.backend.core import FloatArray, write_atomically
from touchdown.backend.geometry import PieceLibrary
from touchdown.backend.identification import sensors, stages
from touchdown.backend.identification.estimates import (
    CONTACT,
    DRAG,
    NOT_IMPORTED,
    OTHER_RECORDINGS,
    PARAMETERS,
    REST,
    Estimate,
    identifiable,
)
from touchdown.backend.identification.recordings import (
    CONTACT_STAGE,
    GEL_STAGES,
    Recordings,
    refuse_unusable,
    sample_presses,
)

# A parameter replaces the nominal one if its uncertainty is below this share of the prior's.
USEFUL_SHARPNESS = 0.5


@dataclass(frozen=True, slots=True)
class Identification:
    """Result of an identification.

    Attributes
    ----------
    settings : SimulationSettings
        The identified bench; the nominal one if the replay gate refused it.
    estimates : tuple of Estimate
        All identified parameters.
    used : tuple of str
        Keys of the estimates that are part of ``settings``.
    gate : Gate
        Comparison with the nominal bench on presses that were held out.
    names, correlation
        Names and correlation matrix of the unknowns of the press model.
    charts, facts
        Charts of the stages, and further figures at rest of name and text.
    missing : tuple of (str, str)
        What was not identified, and the recording that would identify it.
    misfit : float
        Mean square of the fitted residuals over their noise.
    converged : bool
        False if the fit still moved in its last round.
    discrepancy : float
        Error of the press model over the size of the signals, 0 if noise explains the residuals.

    """

    settings: SimulationSettings
    nominal: SimulationSettings
    estimates: tuple[Estimate, ...]
    used: tuple[str, ...]
    gate: stages.Gate
    names: tuple[str, ...]
    correlation: FloatArray
    charts: tuple[sensors.Chart, ...]
    facts: tuple[tuple[str, str], ...]
    missing: tuple[tuple[str, str], ...]
    misfit: float
    presses: int
    grips: int
    simulated: bool
    converged: bool
    discrepancy: float = 0.0

    @property
    def reason(self) -> str:
        """The decision of the replay gate, and a fit that did not converge."""
        gate = self.gate
        open_end = "" if self.converged else " The fit did not converge: its values are doubtful."
        return (
            f"{'Better' if gate.accepted else 'Refused, nothing was changed'}: on {gate.presses} "
            f"presses of {gate.grips} held-out grippings the error of the prediction is "
            f"{100 * gate.share:.0f} % of that of the nominal bench; smaller in {gate.better} of "
            f"{gate.grips} grippings.{open_end}"
        )

    def use(self, one: Estimate) -> str:
        """Return "yes" if an estimate goes into the bench file, else "no" with the reason."""
        if one.key in self.used:
            return "yes"
        if one.sharpness >= USEFUL_SHARPNESS:
            return "no, too uncertain"
        return "no, not a setting" if self.gate.accepted else "no, bench refused"

    def verdict(self, stage: int) -> str:
        """Return in one sentence what a stage adds to the bench file, and what it lacks."""
        rows = [e for e in self.estimates if e.stage == stage]
        keys = {key for key, row in PARAMETERS.items() if row[1] == stage}
        uses = [self.use(e) for e in rows]
        used = f"Identified: {uses.count('yes')} of {len(rows)} parameters enter the bench file"
        parts = [used if rows else "Not identified"]
        parts += [f"{reason}: {count}" for reason in ("not a setting", "bench refused")
                  if (count := uses.count(f"no, {reason}"))]  # fmt: skip
        vague = [e.name[0].lower() + e.name[1:] for e in rows if e.sharpness >= USEFUL_SHARPNESS]
        parts += [f"too uncertain: {', '.join(vague)}"] if vague else []
        parts += [f"record `touchdown {text.removeprefix('`')}" for names, text in self.missing
                  if text[0] == "`" and keys.intersection(names.split(", "))]  # fmt: skip
        return "; ".join(parts) + "."

    def ranges(self) -> dict[str, list[float]]:
        """Return the 95 % interval of each parameter in use, as ranges for randomisation."""
        return {e.key: [max(e.low, 0.0), e.high] for e in self.estimates if e.key in self.used}


def identify_bench(
    recordings: Recordings,
    nominal: SimulationSettings,
    library: PieceLibrary,
    folder: Path,
    tell: stages.Tell = lambda _stage, _done, _of: None,
) -> Identification:
    """Identify a bench.

    Parameters
    ----------
    recordings : Recordings
        From ``read_recordings``. No simulated truth is read.
    nominal : SimulationSettings
        Start of the fit, and the bench to be surpassed.
    library : PieceLibrary
        Pieces of the recordings.
    folder : Path
        Folder for the results of finished stages; an interrupted identification continues there.
    tell : callable
        Receives stage, finished and all steps.

    Returns
    -------
    Identification

    Raises
    ------
    InputError
        If the recordings are unusable, with what is missing and how to record it.

    """
    store = stages.StageStore(folder, stages.stage_key(recordings, nominal))
    gel = [p for p in recordings.of_stage(*GEL_STAGES) if p.accepted]
    refuse_unusable(gel, library, "recordings")
    rest, missing = _rest(recordings)
    drift = {e.key: e.value for e in rest.estimates}
    drifts = np.array([
        drift.get("wrist.drift_n_sqrt_min", nominal.wrist.drift_n_sqrt_min) / np.sqrt(60.0),
        drift.get("wrist.drift_nm_sqrt_min", nominal.wrist.drift_nm_sqrt_min) / np.sqrt(60.0),
        drift.get("tactile.drift_px_sqrt_s", nominal.tactile.drift_px_sqrt_s),
    ])  # fmt: skip
    tell("delays", 0, 1)
    found = store.get(
        "delays", lambda: {k: v.tolist() for k, v in sensors.estimate_delays(gel).items()}
    )
    series = {name: np.array(values, dtype=float) for name, values in found.items()}
    delayed, taken = sensors.delay_estimates(series)
    presses = sample_presses(gel, taken)
    fitted_rows, held_rows = stages.split_grips(presses)
    held = presses.take(held_rows)
    mechanics = stages.fit_mechanics(
        presses.take(fitted_rows), nominal, library, drifts, store, tell
    )
    slips = recordings.of_stage(CONTACT_STAGE)
    contact = presses.take(np.arange(0)) if not slips else sample_presses(slips, taken)
    drags = stages.dragged(contact)
    friction: dict[str, stages.Json] = {}
    slipped: list[Estimate] = []
    for key, plan, rows in (("mu_grip", CONTACT, ~drags), ("mu", DRAG, drags)):
        some = contact.take(np.flatnonzero(rows))
        fit = partial(stages.fit_friction, some, mechanics, nominal, library)
        one = store.get(f"friction {key}", fit) if len(some) else {"mu": [], "sigma": []}
        friction[key] = one
        rows_of = stages.friction_estimates(key, np.array(one["mu"]), np.array(one["sigma"]))
        slipped += rows_of
        if not rows_of:
            count = f": {len(one['mu'])} of {len(some)} presses slipped" if len(some) else ""
            missing.append((", ".join(identifiable(plan)), f"`{plan}`{count}"))
    gate = stages.replay_gate(held, mechanics, nominal, library, drifts)
    absent = NOT_IMPORTED if any(press.imported for press in presses.recordings) else {}
    pitch = nominal.tactile.pitch_mm
    decays = store.get("decays", partial(stages.finger_decays, mechanics, pitch))
    estimated = (
        *rest.estimates,
        *sensors.identify_air(presses, float(drifts[2]), rest=bool(rest.estimates)),
        *delayed, *sensors.arm_compliance(gel[:40]), *stages.mechanics_estimates(mechanics),
        stages.dilation_estimate(mechanics.presses, mechanics, pitch), *slipped,
        *(Estimate(**one) for one in decays["of"]),
    )  # fmt: skip
    estimates = tuple(one for one in estimated if one.key not in ", ".join(absent).split(", "))
    names, correlation = stages.correlations(mechanics)
    charts = (*rest.spectra, *_charts(series, mechanics, friction))
    settings, used = identified_settings(nominal, estimates) if gate.accepted else (nominal, ())
    more = "more of `{}`: its uncertainty is {:.0%} of the prior's"
    missing += [(e.key, more.format(PARAMETERS[e.key][2], e.sharpness))
                for e in estimates if e.sharpness >= USEFUL_SHARPNESS]  # fmt: skip
    return Identification(
        settings, nominal, estimates, used, gate, names, correlation, charts, rest.facts,
        (*missing, *absent.items(), *OTHER_RECORDINGS), mechanics.fit.misfit, len(presses),
        len(presses.grips), recordings.simulated, mechanics.converged, mechanics.discrepancy,
    )  # fmt: skip


def _charts(
    delays: dict[str, FloatArray], mechanics: stages.Mechanics, friction: dict[str, stages.Json]
) -> Iterator[sensors.Chart]:
    """Yield the charts of stages 2 to 4 that have values."""
    late = {k.replace("_", " to "): 1e3 * v for k, v in delays.items() if np.isfinite(v).any()}
    ends = np.array([[0.0], [-1.96], [1.96]])  # of errors of logarithms
    shear, errors = mechanics.of("shear")
    pads, faces = (np.array(friction[key]["mu"]) * np.exp(ends * np.array(friction[key]["sigma"]))
                   for key in ("mu_grip", "mu"))  # fmt: skip
    for stage, title, units, curves in (
        (2, "Delays", ("presses", "ms"), late),
        (3, "Shear stiffness", ("fitted grippings", "N/mm"), {"": shear * np.exp(ends * errors)}),
        (4, "Friction of the pads", ("presses that slipped", ""), {"": pads}),
        (4, "Friction of the faces", ("presses that slid", ""), {"": faces}),
    ):
        if count := max((v.shape[-1] for v in curves.values()), default=0):
            yield sensors.Chart(stage, title, units, 1.0 + np.arange(count), curves)


def _rest(recordings: Recordings) -> tuple[sensors.RestResult, list[tuple[str, str]]]:
    names = ", ".join(identifiable(REST))
    rest = recordings.rest
    if rest is None or rest.length_s < sensors.LEAST_REST_S:
        length = 0.0 if rest is None else rest.length_s
        text = f"`{REST}`: {length:.0f} s at rest, {sensors.LEAST_REST_S:.0f} s are needed"
        return sensors.RestResult((), (), ()), [(names, text)]
    found = sensors.identify_rest(rest)
    missing = []
    if rest.length_s < sensors.GOOD_REST_S:
        missing.append(("slow drift", f"`{REST}`: only {rest.length_s:.0f} s at rest"))
    return found, missing


def identified_settings(
    nominal: SimulationSettings, estimates: tuple[Estimate, ...]
) -> tuple[SimulationSettings, tuple[str, ...]]:
    """Return ``nominal`` with the usefully sharp estimates, and their keys."""
    content: dict[str, Any] = nominal.model_dump(mode="json")
    used = []
    for one in estimates:
        *groups, last = one.key.split(".")
        place: Any = content
        for name in groups:
            place = place.get(name) if isinstance(place, dict) else None
        if place is None or one.sharpness >= USEFUL_SHARPNESS or not np.isfinite(one.value):
            continue
        value = float(f"{max(one.value, 0.0):.6g}")
        if isinstance(place, list) and last.isdigit():
            place[int(last)] = value
        elif isinstance(place, dict) and last in place:
            place[last] = value
        else:
            continue
        used.append(one.key)
    share = next((e for e in estimates if e.key == "grasp.hysteresis_share"), None)
    if share is not None and "grasp.hysteresis_share" in used:
        content["grasp"]["hysteresis"] = bool(share.low > 0.0)
    face = content["face"]
    if used:  # whole cells err in the moments of the presses that this bench explains
        face["subcells"] = max(nominal.face.subcells, 3)
    if "face.foundation_n_mm3" in used and face.get("foundation_range_n_mm3"):
        # TOML has no null: without a value the preset of the bench file would bring its range back.
        face["foundation_range_n_mm3"] = 2 * [face["foundation_n_mm3"]]
    return parse_settings(SimulationSettings, content, "identified bench"), tuple(used)


def bench_file(found: Identification, source: str) -> str:
    """Return the text of the bench file; ``source`` names the dataset."""
    content = found.settings.model_dump(mode="json", exclude_none=True)
    lines = [f"# Bench identified from {source}: {found.reason}"]
    lines += [f"{key} = {json.dumps(v)}" for key, v in content.items() if not isinstance(v, dict)]
    by_key = {e.key: e for e in found.estimates if e.key in found.used}
    for group, values in content.items():
        if not isinstance(values, dict):
            continue
        lines += ["", f"[{group}]"]
        for key, value in values.items():
            one = by_key.get(f"{group}.{key}")
            note = "" if one is None else f"  # ± {one.sigma:.2g}"
            lines.append(f"{key} = {json.dumps(value)}{note}")
    return "\n".join(lines) + "\n"


def write_identification(found: Identification, out: Path, source: str, report: Any = None) -> Path:
    """Write all figures as JSON, then the bench file beside them, if the gate accepted it.

    ``report``: content of the report. Returns the path of the JSON file.
    """
    data = {
        "format": "touchdown-identification/1",
        "source": source,
        "accepted": found.gate.accepted,
        "reason": found.reason,
        "verdicts": {stage: found.verdict(stage) for stage in range(1, 5)},
        "estimates": [asdict(one) for one in found.estimates],
        "used": list(found.used),
        "randomisation": found.ranges(),
        "correlation": {"names": list(found.names), "matrix": found.correlation.tolist()},
        "gate": {
            "share": found.gate.share, "better": found.gate.better, "grips": found.gate.grips,
            "nominal": found.gate.nominal.tolist(), "identified": found.gate.identified.tolist(),
        },
        "misfit": found.misfit,
        "discrepancy": found.discrepancy,
        "converged": found.converged,
        "missing": [list(pair) for pair in found.missing],
        "report": report,
    }  # fmt: skip
    path = out.with_suffix(".json")
    write_atomically(path, json.dumps(data, indent=1).encode() + b"\n")
    if found.gate.accepted:
        write_atomically(out, bench_file(found, source).encode())
    return path
