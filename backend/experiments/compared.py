"""The answer of ``touchdown experiment beyond``: counts, promises and gaps, and their tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from backend.experiments.beyond import Beyond
from backend.experiments.gap import gaps, quantity
from backend.experiments.promises import IOU_AFTER, RELIABLE_AFTER, Promises
from backend.experiments.scoring import FUSED
from backend.jobs.spec import JobSpec
from backend.jobs.store import JobStore

Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Sheet:
    """One table in words: ``rows`` as long as ``columns``."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class Compared:
    """Closed loops and, where ``said`` is given, what is said before a release."""

    loops: Beyond
    said: Promises | None = None

    def jobs(self) -> list[JobSpec]:
        """Return the jobs of both."""
        return [*self.loops.jobs(), *(self.said.jobs() if self.said else ())]

    def effort(self, spec: JobSpec) -> int:
        """Return how long a job takes compared with others."""
        return Beyond.effort(spec) if spec.kind == "beyond" else Promises.effort(spec)

    def answer(self, store: JobStore) -> Json:
        """Return all that is finished by now."""
        found = self.loops.table(store)
        answers = self.said.answers(store) if self.said else {}
        found["gaps"] = gaps(self.loops.trials_of(store), answers)
        if self.said is not None:
            found["statics"] = self.said.table(store)
        return found


def sheets(answer: Mapping[str, Any]) -> list[Sheet]:
    """Return the tables of an answer; without groups or a ceiling there are fewer."""
    found = [
        Sheet(
            "Closed loop, simulated; 95 % intervals",
            ("strategy", "trials", "placed %", "unsafe %", "outcomes", "probes", "spare"),
            tuple(_loop(cell) for cell in (*answer["cells"], *answer["pooled"])),
        )
    ]
    if "statics" in answer:
        statics = answer["statics"]
        found.append(
            Sheet(
                "Would it stand at the place of the first probe? Balanced, %",
                (
                    "strategy",
                    "groups",
                    *(f"n = {n}" for n in FUSED),
                    *(f"released, n = {n}" for n in FUSED),
                    "unsafe %, n = 3",
                ),
                tuple(_said(cell) for cell in (*statics["cells"], *statics["pooled"])),
            )
        )
        found.append(
            Sheet(
                "Do the maps keep their promise? Covered cells",
                (
                    "strategy",
                    *(f"ECE, n = {n}" for n in RELIABLE_AFTER),
                    f"IoU %, n = {IOU_AFTER}",
                ),
                tuple(_kept(cell) for cell in (*statics["cells"], *statics["pooled"])),
            )
        )
    if answer["gaps"]:
        found.append(gap_sheet(answer["gaps"]))
    return found


def markdown(found: Sequence[Sheet]) -> str:
    """Return tables as they stand in a document."""
    parts = []
    for sheet in found:
        lines = [sheet.columns, ("---",) * len(sheet.columns), *sheet.rows]
        parts.append(
            "\n".join([f"{sheet.title}:", "", *(f"| {' | '.join(row)} |" for row in lines)])
        )
    return "\n\n".join(parts) + "\n"


def gap_sheet(rows: Sequence[Json]) -> Sheet:
    """Return the table of the shares of the way to the ceiling."""
    return Sheet(
        "Share of the way from paper to ceiling, what all three did; 95 % intervals over seeds",
        ("strategy", "of", "n", "paper %", "own %", "ceiling %", "share %"),
        tuple(_gap(row) for row in rows),
    )


def _loop(cell: Json) -> tuple[str, ...]:
    outcomes = ", ".join(f"{w.replace('_', ' ')} {n}" for w, n in cell["outcomes"].items())
    left = cell.get("left_out", 0)
    return (
        _name(cell),
        str(cell["placed"]["n"]),
        _share(cell["placed"]),
        _share(cell["unsafe"]),
        outcomes + (f"; {left} left out" if left else ""),
        _number(cell["probes"]),
        _number(cell["excess_probes_median"]),
    )


def _said(cell: Json) -> tuple[str, ...]:
    kinds = cell["likely"], cell["released"]
    balanced = [_percent(by_n[str(n)]["balanced"]) for by_n in kinds for n in FUSED]
    return _name(cell), str(cell["groups"]), *balanced, _share(kinds[1]["3"]["unsafe"])


def _kept(cell: Json) -> tuple[str, ...]:
    charts = [cell["reliability"].get(str(n)) for n in RELIABLE_AFTER]
    ece = ["" if chart is None else f"{chart['ece']:.3f}" for chart in charts]
    return _name(cell), *ece, _share(cell["iou"])


def _gap(row: Json) -> tuple[str, ...]:
    shares = [_percent(row[key]) for key in ("paper", "own", "ceiling")]
    share = {
        key: row[f"share{end}"] for key, end in (("value", ""), ("low", "_low"), ("high", "_high"))
    }
    shown = _share(share) if share["low"] is not None else _percent(share["value"])
    return row["strategy"], quantity(row), str(row["n"]), *shares, shown


def _name(cell: Json) -> str:
    words: Sequence[str] = (cell["strategy"], cell.get("piece", "pooled"))
    over = cell.get("bottom") or {"one": "one bottom", "two": "two bottoms"}.get(
        cell.get("tower", ""), ""
    )
    return " ".join((*words, over)).strip()


def _share(estimate: Json) -> str:
    if estimate["value"] is None:
        return ""
    value, low, high = (100 * estimate[key] for key in ("value", "low", "high"))
    return f"{value:.1f} ({low:.1f} to {high:.1f})"


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.1f}"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"
