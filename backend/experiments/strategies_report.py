"""Tables 2 and 3 with a column for each strategy, from the answers that stand with the tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from backend.core.flow import Outcome
from backend.experiments.charts import reliability_chart
from backend.experiments.document import Entry, Gallery, Grid, Picture, Section
from backend.experiments.gap import quantity
from backend.experiments.statistics import rate
from backend.experiments.words import counts_of, entry_of, interval_of, percent

Json = Mapping[str, Any]
Cells = dict[tuple[str, str], dict[str, Json]]
"""By piece and bottom, then by strategy; of several answers to one the largest."""
PAPER = "paper"
TITLES = {
    PAPER: "Paper's",
    "fused": "Learned fusion",
    "zero-wrench": "Zero wrench",
    "ceiling": "Ceiling",
    "ceiling-diameter": "Ceiling, diameter unknown",
    "pick-and-place": "Pick and place",
}
"""Strategies as columns, in this order; those that are not named here come after them."""
ASKED_AFTER = "3"
"""Probes after which Table 2 is shown by strategy."""
UNSAFE = (Outcome.FELL.value, Outcome.KNOCKED_OVER.value)


def strategy_sections(tables: Json) -> list[Section]:
    """Return the sections on strategies; none where no comparison stands with the tables."""
    answers = tables.get("beyond") or ()
    if not answers:
        return []
    found = [
        _stacking(
            _stacked(tables, answers), tuple(_source(one) for one in answers if one["cells"])
        ),
        _asked(_said(tables, answers)),
        _gaps(tables["gaps"] if "gaps" in tables else _own_gaps(answers)),
        _kept(answers),
    ]
    return [section for section in found if section is not None]


def _stacked(tables: Json, answers: Iterable[Json]) -> Cells:
    cells: Cells = {}
    for row in tables["table3"]:
        for cell in row["cells"]:
            if row["strategy"] == PAPER and "outcomes" in cell:
                unsafe = rate(cell["unsafe_releases"], cell["n"]).as_json()
                same = {**cell, "placed": cell, "unsafe": unsafe, "jobs": (cell["job"],)}
                _keep_larger(cells, PAPER, same, cell["n"])
    for answer in answers:
        for cell in answer["cells"]:
            _keep_larger(cells, cell["strategy"], cell, cell["placed"]["n"])
    return cells


def _said(tables: Json, answers: Iterable[Json]) -> Cells:
    cells: Cells = {}
    rows = {row["method"]: row["cells"] for row in tables["table2"] if row["method"].isdigit()}
    for k, cell in enumerate(rows.get(ASKED_AFTER, ())):
        if "accuracy" in cell:
            by_n = {n: same[k] for n, same in rows.items() if "accuracy" in same[k]}
            own = {**cell, "likely": by_n, "released": by_n, "jobs": (cell["job"],)}
            _keep_larger(cells, PAPER, own, cell["accuracy"]["n"])
    for answer in answers:
        for cell in answer.get("statics", {}).get("cells", ()):
            _keep_larger(cells, cell["strategy"], cell, cell["groups"])
    return cells


def _keep_larger(cells: Cells, strategy: str, cell: Json, n: int) -> None:
    place = cells.setdefault((cell["piece"], cell["bottom"]), {})
    if n > place.get(strategy, {"count": 0})["count"]:
        place[strategy] = {**cell, "count": n}


def _names(cells: Cells) -> list[str]:
    found = {name for place in cells.values() for name in place}
    order = list(TITLES)
    return sorted(found, key=lambda name: (order.index(name) if name in order else 99, name))


def _stacking(cells: Cells, sources: Sequence[str]) -> Section:
    names = _names(cells)
    rows = [
        (_place(place), tuple(_loop(own[name]) if name in own else Entry("") for name in names))
        for place, own in cells.items()
    ]
    for title, tower in (("Pooled, one bottom", False), ("Pooled, two bottoms", True)):
        some = [own for (_, bottom), own in cells.items() if ("+" in bottom) is tower]
        if some:
            rows.append((title, tuple(_pooled_loop(some, name) for name in names)))
    text = (
        "Whole trials; every one counts. Unsafe: fell or knocked over. Counts: placed / fell / "
        "knocked over / gave up / aborted. Spare: probes beyond the least number, median.",
        "The seeds of a cell are the same for all strategies, from the first on; how many were "
        "run differs. Pooled over the cells that a strategy did; below it the paper's strategy in "
        "the same cells.",
        *sources,
    )
    grid = Grid("Placed, %", _columns(names), tuple(rows))
    return Section("Table 3 by strategy", text, (grid,))


def _source(answer: Json) -> str:
    """Say what an answer holds and which networks read the probes there."""
    names = dict.fromkeys(cell["strategy"] for cell in answer["cells"])
    models = "networks: " * bool(answer.get("models")) + ", ".join(
        f"{piece} {source[:8]}" for piece, source in answer.get("models", {}).items()
    )
    return f"Counts of {', '.join(names)}: program {answer['code']}; {models or 'no network'}."


def _loop(cell: Json) -> Entry:
    notes = [f"unsafe {percent(cell['unsafe']['value'])} {interval_of(cell['unsafe'])}"]
    notes.append(counts_of(cell["outcomes"]))
    if cell["probes"] is not None:
        spare = cell.get("excess_probes_median")
        more = "" if spare is None else f", {spare:.0f} spare"
        notes.append(f"{cell['probes']:.1f} probes{more}")
    shown = entry_of(cell["placed"], notes=tuple(notes))
    return Entry(
        shown.value, shown.interval, shown.notes, tuple(cell.get("jobs", ())), cell.get("seed")
    )


def _pooled_loop(places: Sequence[Mapping[str, Json]], name: str) -> Entry:
    own = [place for place in places if name in place]
    if not own:
        return Entry("")
    placed, unsafe = _shares([place[name] for place in own])
    notes = [f"unsafe {percent(unsafe['value'])} {interval_of(unsafe)}", f"{placed['n']} trials"]
    if name != PAPER and all(PAPER in place for place in own):
        theirs, fell = _shares([place[PAPER] for place in own])
        notes.append(f"paper's {percent(theirs['value'])}, unsafe {percent(fell['value'])}")
    return entry_of(placed, notes=tuple(notes))


def _shares(cells: Sequence[Json]) -> tuple[Json, Json]:
    """Return placed and unsafe over all trials of some cells."""
    ended = [cell["outcomes"] for cell in cells]
    trials = sum(sum(one.values()) for one in ended)
    placed = sum(one.get(Outcome.PLACED.value, 0) for one in ended)
    unsafe = sum(one.get(word, 0) for one in ended for word in UNSAFE)
    return rate(placed, trials).as_json(), rate(unsafe, trials).as_json()


def _asked(cells: Cells) -> Section | None:
    if not any(name != PAPER for place in cells.values() for name in place):
        return None
    names = _names(cells)
    rows = tuple(
        (_place(place), tuple(_verdict(own[name]) if name in own else Entry("") for name in names))
        for place, own in cells.items()
    )
    text = (
        f"Does it rather stand than fall at the place of the first probe, after {ASKED_AFTER}? "
        "Right, %; below it the balanced accuracy after 1, 2, 3 and 5 probes, and what would be "
        "released: how many of the places that stand, and of those that fall (unsafe).",
    )
    return Section("Table 2 by strategy", text, (Grid("Right, %", _columns(names), rows),))


def _verdict(cell: Json) -> Entry:
    likely, released = cell["likely"], cell["released"][ASKED_AFTER]
    balanced = ", ".join(percent(likely[n]["balanced"]) for n in sorted(likely, key=int))
    found, unsafe = released["found"]["value"], released["unsafe"]["value"]
    notes = (
        f"balanced {balanced}",
        f"released {percent(found)}, unsafe {percent(unsafe)}",
        f"{cell['count']} places",
    )
    shown = entry_of(likely[ASKED_AFTER]["accuracy"], notes=notes)
    return Entry(shown.value, shown.interval, notes, tuple(cell.get("jobs", ())), cell.get("seed"))


def _own_gaps(answers: Iterable[Json]) -> list[Json]:
    return [row for answer in answers for row in answer.get("gaps") or ()]


def _gaps(rows: Sequence[Json]) -> Section | None:
    if not rows:
        return None
    lines = tuple(
        (
            f"{TITLES.get(row['strategy'], row['strategy'])}, {quantity(row)}",
            (
                Entry(str(row["n"])),
                *(Entry(percent(row[key])) for key in ("paper", "own", "ceiling")),
                Entry(percent(row["share"]), _interval(row)),
            ),
        )
        for row in rows
    )
    columns = tuple((name, "") for name in ("n", "paper, %", "own, %", "ceiling, %", "share, %"))
    text = "From the paper's strategy to a ceiling, over what all three did."
    return Section("Share of the way to the ceiling", (text,), (Grid("", columns, lines),))


def _interval(row: Json) -> str:
    low, high = row.get("share_low"), row.get("share_high")
    return "" if low is None or high is None else f"({percent(low)}-{percent(high)})"


def _kept(answers: Iterable[Json]) -> Section | None:
    largest: dict[str, Json] = {}
    for answer in answers:
        for pooled in answer.get("statics", {}).get("pooled", ()):
            known = largest.get(pooled["strategy"])
            if pooled["reliability"] and (known is None or pooled["groups"] > known["groups"]):
                largest[pooled["strategy"]] = pooled
    drawn = tuple(
        Picture(
            reliability_chart(
                chart["promised"],
                chart["came"],
                TITLES.get(name, "other"),
                f"n = {n}, ECE {chart['ece']:.3f}",
            )
        )
        for name, pooled in largest.items()
        for n, chart in pooled["reliability"].items()
    )
    if not drawn:
        return None
    text = "Covered cells, 15 bins of equal mass. Along: promised. Up: came true."
    return Section("Promised and true, by strategy", (text,), (Gallery("", drawn),))


def _columns(names: Sequence[str]) -> tuple[tuple[str, str], ...]:
    return tuple((TITLES.get(name, name), "") for name in names)


def _place(place: tuple[str, str]) -> str:
    piece, bottom = place
    over = " on ".join(reversed(bottom.split("+")))
    return f"{piece.title()} on {over}"
