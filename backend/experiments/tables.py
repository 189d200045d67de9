"""Tables 1 to 3 from the answers of finished jobs, as plain JSON with all that traces them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from backend.core.flow import Outcome
from backend.experiments import paper
from backend.experiments.formats import TABLES_FORMAT
from backend.experiments.recipes import BOTTOMS, MODELS, PIECES, TWO, Recipe
from backend.experiments.statistics import Binary, mean, rate
from backend.jobs.spec import JobSpec
from backend.jobs.store import JobStore
from backend.objects.tower import TOO_CLOSE_MM

PATCH_MODELS = tuple(name for name, _, head in MODELS if head == "patch")
OURS = "FT+Tac"
UNSAFE = (Outcome.FELL.value, Outcome.KNOCKED_OVER.value)
Json = dict[str, Any]


def tables(recipe: Recipe, store: JobStore) -> Json:
    """Return everything that is finished; a cell whose job is missing is null."""
    return {
        "format": TABLES_FORMAT,
        "scale": recipe.scale.name,
        "code": recipe.code,
        "bench": recipe.bench.model_dump(mode="json"),
        "bench_sha256": recipe.bench_id(),
        "simulated": True,
        "table1": _table1(recipe, store),
        "table2": _table2(recipe, store),
        "table3": _table3(recipe, store),
        "bench_facts": _bench_facts(recipe, store),
    }


def _cells(recipe: Recipe) -> Iterable[tuple[str, str]]:
    return ((piece, bottom) for piece in recipe.pieces for bottom in BOTTOMS)


def _answer(spec: JobSpec | None, store: JobStore) -> Json | None:
    return store.result(spec.id) if spec is not None and store.has(spec.id) else None


def _table1(recipe: Recipe, store: JobStore) -> list[Json]:
    """One row per model and metric; interval from the spread between grippings."""
    rows = []
    for metric, printed in (("iou", paper.IOU), ("accuracy", paper.POINTS)):
        for model in PATCH_MODELS:
            cells = []
            for piece, bottom in _cells(recipe):
                spec = recipe.static(piece, bottom)
                scores = ((_answer(spec, store) or {}).get("models") or {}).get(model)
                cell = _cell(piece, bottom, spec, 0.01 * printed[model][piece, bottom])
                if scores:
                    cell |= mean(scores["patch"][metric]).as_json()
                    cell["against_truth"] = mean(scores["patch"][metric + "_true"]).value
                    cell["weights_sha256"] = scores["weights_sha256"]
                cells.append(cell)
            rows.append({"metric": metric, "model": model, "cells": cells, **_means(cells)})
    return rows


def _table2(recipe: Recipe, store: JobStore) -> list[Json]:
    """One row per method; each cell both ways: top interface alone, and every interface."""
    rows = []
    for method in ("Implicit", "1", "2", "3", "5"):
        model = "Implicit" if method == "Implicit" else OURS
        n = "1" if method == "Implicit" else method
        cells = []
        pooled = Binary(0, 0, 0, 0)
        for piece, bottom in _cells(recipe):
            spec = recipe.static(piece, bottom)
            answer = _answer(spec, store)
            printed = paper.STABILITY.get(method, {}).get((piece, bottom))
            cell = _cell(piece, bottom, spec, None if printed is None else 0.01 * printed)
            says = ((answer or {}).get("models") or {}).get(model, {}).get("says", {}).get(n)
            if answer and says:
                every, cell["excluded"] = scored(says, answer["margin_mm"], interface=1)
                top, _ = scored(says, answer["margin_mm"], interface=0)
                cell |= {**every.as_json(), "top_interface": top.as_json()}
                pooled += every
            cells.append(cell)
        rows.append({"method": method, "cells": cells, "pooled": pooled.as_json()})
    return rows


def scored(
    says: Sequence[bool], margins_mm: Sequence[Sequence[float | None]], interface: int
) -> tuple[Binary, int]:
    """Count answers against margins; cases within the band that is too close are left out.

    A margin of None means no support at all. Returns the counts and how many were left out.
    """
    kept = [
        (said, margin[interface])
        for said, margin in zip(says, margins_mm, strict=True)
        if margin[interface] is None or abs(margin[interface] or 0.0) >= TOO_CLOSE_MM
    ]
    stands = [margin is not None and margin > 0.0 for _, margin in kept]
    return Binary.of([said for said, _ in kept], stands), len(says) - len(kept)


def _table3(recipe: Recipe, store: JobStore) -> list[Json]:
    """One row per tower and strategy. Every trial counts."""
    rows = []
    kinds: tuple[tuple[str, str, str], ...] = (
        ("pick-and-place", "one", "pick-and-place"),
        ("one", "one", "paper"),
        ("two", "two", "paper"),
    )
    for printed, tower, strategy in kinds:
        cells = []
        for piece, bottom in _cells(recipe):
            if tower == "two" and bottom != TWO[-1]:
                continue
            bottoms = TWO if tower == "two" else (bottom,)
            spec = recipe.stacking(piece, bottoms, strategy)
            answer = _answer(spec, store)
            share = paper.STACKING[printed][piece, bottom] / paper.RUNS
            cell = _cell(piece, "+".join(bottoms), spec, share)
            if answer:
                cell |= stacking_cell(answer["trials"]) | {"left_out": answer["left_out"]}
                if strategy == "paper":
                    again = _answer(recipe.devices(piece, bottoms), store)
                    cell["devices"] = again and agreement(answer["trials"], again["trials"])
            cells.append(cell)
        done = [cell for cell in cells if "outcomes" in cell]
        placed = sum(cell["outcomes"].get(Outcome.PLACED.value, 0) for cell in done)
        unsafe = sum(cell["unsafe_releases"] for cell in done)
        trials = sum(cell["n"] for cell in done)
        rows.append(
            {
                "tower": tower,
                "strategy": strategy,
                "cells": cells,
                "pooled": rate(placed, trials).as_json(),
                "unsafe": rate(unsafe, trials).as_json(),
                "paper_pooled": 0.1 * sum(paper.STACKING[printed].values()) / len(paper.CELLS),
            }
        )
    return rows


def stacking_cell(trials: Sequence[Mapping[str, Any]]) -> Json:
    """Count how the trials of one cell ended, by every interface and by the top one alone."""
    counts: dict[str, int] = {}
    for trial in trials:
        counts[trial["outcome"]] = counts.get(trial["outcome"], 0) + 1
    placed = counts.get(Outcome.PLACED.value, 0)
    top = sum(bool(t["margins_mm"]) and (t["margins_mm"][-1] or -1.0) > 0.0 for t in trials)
    probes = [t["probes"] for t in trials if t["outcome"] == Outcome.PLACED.value]
    return {
        **rate(placed, len(trials)).as_json(),
        "outcomes": counts,
        "unsafe_releases": sum(counts.get(word, 0) for word in UNSAFE),
        "top_interface": rate(top, len(trials)).as_json(),
        "probes": sum(probes) / len(probes) if probes else None,
    }


def agreement(batch: Sequence[Mapping[str, Any]], devices: Sequence[Mapping[str, Any]]) -> Json:
    """Compare the trials that were run both ways, by seed."""
    mine = {trial["seed"]: trial for trial in batch}
    pairs = [(mine[trial["seed"]], trial) for trial in devices]
    placed = [
        sum(t["outcome"] == Outcome.PLACED.value for t in side) for side in zip(*pairs, strict=True)
    ]
    return {
        "trials": len(pairs),
        "same_outcome": sum(a["outcome"] == b["outcome"] for a, b in pairs),
        "placed_batch": placed[0],
        "placed_devices": placed[1],
        "probes_apart": sum(abs(a["probes"] - b["probes"]) for a, b in pairs) / len(pairs),
    }


def _bench_facts(recipe: Recipe, store: JobStore) -> Json:
    """How hard the bench was: slip, stable share, reliability and map IoU after three probes."""
    slipped, rejected, count = [], 0, 0
    charts = []
    for piece, bottom in _cells(recipe):
        answer = _answer(recipe.static(piece, bottom), store)
        if answer is None:
            continue
        slipped.append(answer["slipped"])
        rejected += answer["rejected"]
        count += len(answer["margin_mm"])
        ours = answer["models"].get(OURS)
        if ours and "reliability" in ours:
            facts = {"piece": piece, "bottom": bottom, "map_iou": mean(ours["map_iou"]).as_json()}
            charts.append({**facts, **ours["reliability"]})
    return {
        "slipped": sum(slipped) / len(slipped) if slipped else None,
        "rejected": rejected,
        "groups": count,
        "after_three_probes": charts,
    }


def _cell(piece: str, bottom: str, spec: JobSpec | None, printed: float | None) -> Json:
    """Return what every cell carries: where it belongs, its job, and the paper's number."""
    trace = {} if spec is None else {"job": spec.id, "seed": spec.seed}
    return {"piece": piece, "bottom": bottom, "paper": printed, **trace}


def _means(cells: Sequence[Json]) -> Json:
    values = [cell["value"] for cell in cells if cell.get("value") is not None]
    printed = [cell["paper"] for cell in cells]
    return {
        "mean": sum(values) / len(values) if len(values) == len(cells) else None,
        "paper_mean": sum(printed) / len(printed),
    }


def pieces_of(text: str) -> tuple[str, ...]:
    """Return the pieces named by a text with commas, in the order of the tables."""
    wanted = set(filter(None, text.split(",")))
    return tuple(piece for piece in PIECES if piece in wanted)
