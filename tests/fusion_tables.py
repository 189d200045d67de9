"""Render the tables of results in the documents: ``python -m tests.fusion_tables``.

Each table is between ``<!-- NAME -->`` and ``<!-- end -->`` and shows ``docs/results/NAME.json``.
The table of calibrations shows the cards of the shipped models.
"""

import json
import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from tests.guard_study import guard_table
from touchdown.backend.experiments.comparison import comparison_tables
from touchdown.backend.experiments.document import ReportTable
from touchdown.backend.experiments.statistics import estimate_rate

DOCS = Path(__file__).parents[1] / "docs"
PAGE_NAMES = ("learned-fusion", "experiments", "method-choices", "bench-v2")
PAGES = tuple(DOCS / f"{name}.md" for name in PAGE_NAMES)
MODELS = DOCS.parent / "resources" / "models"
CALIBRATIONS = "calibrations"
WORDS = ("placed", "fell", "knocked_over", "gave_up", "aborted")
TITLES = {
    "short": "Short",
    "long": "Long",
    "hex20": "hexagon",
    "rect12x28": "long rectangle",
    "short+long": "Long on Short",
    "short+hex20": "hexagon on Short",
    "short+rect12x28": "long rectangle on Short",
}
KINDS = {", rather stable than not": "likely", ", sure enough to release": "released"}
Json = dict[str, Any]


def markdown(tables: list[ReportTable]) -> str:
    """Return tables as Markdown."""
    parts = []
    for table in tables:
        header, *rows = table.texts()
        lines = [header, ("---",) * len(header), *rows]
        parts += [f"{table.title}:", "\n".join(f"| {' | '.join(row)} |" for row in lines)]
    return "\n\n".join(parts)


def loops(answer: Json) -> str:
    """Return the counts of trials: a row for each cell, each piece, and all of them."""
    cells = [cell for cell in answer["cells"] if cell["strategy"] == "fused"]
    pieces = sorted({cell["piece"] for cell in cells}, reverse=True)
    lines = [
        "| | trials | placed, % | unsafe, % | placed / fell / knocked over / gave up or asked / "
        "aborted | probes of the placed |",
        "|---|---|---|---|---|---|",
    ]
    for piece in pieces:
        own = [cell for cell in cells if cell["piece"] == piece]
        lines += [_loop(f"{piece} on {TITLES[cell['bottom']]}", [cell]) for cell in own]
        lines.append(_loop(f"**{piece}**", own))
    return "\n".join([*lines, _loop("**all**", cells)])


def _loop(name: str, cells: list[Json]) -> str:
    outcomes: Counter[str] = Counter()
    for cell in cells:
        outcomes.update(cell["outcomes"])
    trials, placed = outcomes.total(), outcomes["placed"]
    outcomes["gave_up"] += outcomes["asked"]
    unsafe = outcomes["fell"] + outcomes["knocked_over"]
    spent = sum(c["probes"] * c["outcomes"]["placed"] for c in cells if c["probes"])
    probes = f"{spent / placed:.1f}" if placed else "-"
    counts = " / ".join(str(outcomes[word]) for word in WORDS)
    shares = f"{_share(placed, trials)} | {_share(unsafe, trials)}"
    return f"| {name} | {trials} | {shares} | {counts} | {probes} |"


def _share(hits: int, trials: int) -> str:
    found = estimate_rate(hits, trials).as_json()
    value, low, high = (100 * found[key] for key in ("value", "low", "high"))
    return f"{value:.0f} ({low:.0f} to {high:.0f})"


def statics(answer: Json) -> str:
    """Return what was said of the first place before any release, by strategy."""
    lines = ["| | n = 1 | 2 | 3 | 5 |", "|---|---|---|---|---|"]
    for pooled in answer["statics"]["pooled"]:
        name = pooled["strategy"]
        kinds = {"": "released"} if name == "paper" else KINDS
        for words, kind in kinds.items():
            said = " | ".join(_said(pooled[kind][n]) for n in ("1", "2", "3", "5"))
            lines.append(f"| `{name}`{words} | {said} |")
    lines += ["", "| | groups | IoU after 3, % | ECE after 1 | after 3 |", "|---|---|---|---|---|"]
    for pooled in answer["statics"]["pooled"]:
        iou, kept = pooled["iou"], pooled["reliability"]
        area = " ".join(
            (
                f"{100 * iou['value']:.0f}",
                f"({100 * iou['low']:.0f} to",
                f"{100 * iou['high']:.0f})",
            )
        )
        ece = " | ".join(f"{kept[n]['ece']:.3f}" for n in ("1", "3"))
        lines.append(f"| `{pooled['strategy']}` | {pooled['groups']} | {area} | {ece} |")
    return "\n".join(lines)


def _said(answers: Json) -> str:
    found, unsafe = (100 * answers[key]["value"] for key in ("found", "unsafe"))
    return f"{100 * answers['balanced']:.1f}; {found:.0f}, {unsafe:.0f}"


def compared(answer: Json) -> str:
    """Return the counts of each strategy over all its cells, and the changes on common seeds."""
    names = list(dict.fromkeys(cell["strategy"] for cell in answer["cells"]))
    lines = [
        "| strategy | trials | placed, % | unsafe, % | placed / fell / knocked over / gave up / "
        "aborted | probes of the placed |",
        "|---|---|---|---|---|---|",
    ]
    for name in names:
        lines.append(_loop(f"`{name}`", [c for c in answer["cells"] if c["strategy"] == name]))
    if answer["changes"]:
        lines += ["", "| change, points | from | of | | only before | only after | p |"]
        lines.append("|---|---|---|---|---|---|---|")
    for row in answer["changes"]:
        if "only_own" in row:
            counts = f"{row['only_paper']} | {row['only_own']} | {row['p']:.2g}"
            names_of = f"`{row['strategy']}` | `{row['reference']}` | {row['what']}"
            lines.append(f"| {names_of} | {_points(row)} | {counts} |")
    for row in answer.get("of_ceiling", ()):
        value, low, high = (100 * row[key] for key in ("value", "low", "high"))
        share = f"{value:.1f} % ({low:.1f} to {high:.1f})"
        lines += ["", f"`{row['strategy']}` places {share} of what `{row['ceiling']}` places."]
    if "band" in answer:
        around = [t for t in comparison_tables(answer) if "benches around" in t.title]
        lines += ["", markdown(around).strip()]
    return "\n".join([*lines, "", _provenance(answer)])


def _points(row: Json) -> str:
    change, low, high = (100 * row[key] for key in ("change", "low", "high"))
    return f"{change:+.1f} ({low:+.1f} to {high:+.1f})"


def _provenance(answer: Json) -> str:
    sources = ", ".join(f"{kind} `{digest}`" for kind, digest in answer["sources"].items())
    return f"Computed on {answer['date']}; sources of the jobs: {sources}."


FUSIONS = {"": "`paper`", "calibrated ": "`paper-calibrated`", "even ": "`paper`, judged at 0.5"}
NUMBERS = ("1", "2", "3", "5")


def stability(answer: Json) -> str:
    """Return Table 2 in both protocols, and the cells of three probes in that of the paper."""
    lines = []
    protocols = {"Paper's protocol": answer["paper_protocol"], "Balanced sample": answer}
    for title, tables in protocols.items():
        rows = {row["method"]: row for row in tables["table2"]}
        lines += [f"| {title} | n = 1 | 2 | 3 | 5 |", "|---|---|---|---|---|"]
        if title != "Balanced sample":
            printed = " | ".join(_printed(rows[n]) for n in NUMBERS)
            lines.append(f"| the paper's robot | {printed} |")
        for prefix, name in FUSIONS.items():
            own = [rows[prefix + n] for n in NUMBERS]
            lines.append(f"| {name} | {' | '.join(map(_right, own))} |")
            balanced = (f"{100 * row['pooled']['balanced']:.1f}" for row in own)
            lines.append(f"| {name}, balanced | {' | '.join(balanced)} |")
            for key in ("accuracy", "balanced") if prefix else ():
                shown = " | ".join(_points(row["changes"][key]) for row in own)
                what = "plain" if key == "accuracy" else key
                lines.append(f"| {name} against `paper`, {what}, points | {shown} |")
        base = rows["1"]["pooled"]
        said = f"Base rate {100 * base['base_rate']:.1f} %, {base['accuracy']['n']} places"
        lines += ["", f"{said} on {base['mountings']} mountings.", ""]
    rows = {row["method"]: row["cells"] for row in answer["paper_protocol"]["table2"]}
    heads = [f"{c['piece']}, {c['bottom']}" for c in rows["3"]]
    lines.append(f"| Paper's protocol, n = 3 | {' | '.join(heads)} |")
    lines.append("|---" * (len(heads) + 1) + "|")
    for name, key in (("the paper's robot", "paper"), ("base rate", "base_rate")):
        lines.append(f"| {name} | {' | '.join(f'{100 * c[key]:.1f}' for c in rows['3'])} |")
    for prefix, name in FUSIONS.items():
        shown = (f"{100 * c['accuracy']['value']:.1f}" for c in rows[f"{prefix}3"])
        lines.append(f"| {name} | {' | '.join(shown)} |")
    return "\n".join([*lines, "", _provenance(answer)])


def _printed(row: Json) -> str:
    values = [cell["paper"] for cell in row["cells"] if cell["paper"] is not None]
    return f"{100 * sum(values) / len(values):.1f}" if values else "-"


def _right(row: Json) -> str:
    value, low, high = (100 * row["pooled"]["accuracy"][key] for key in ("value", "low", "high"))
    return f"{value:.1f} ({low:.1f} to {high:.1f})"


def calibrations(cards: Json) -> str:
    """Return one row for each shipped network that ``paper-calibrated`` uses."""
    lines = [
        "| network | temperature | bias | prior | expected calibration error before, after |",
        "|---|---|---|---|---|",
    ]
    for bench, suffix in (("bench-v1", "-ft+tac"), ("mixed", "")):
        for piece in ("pot", "barrel", "mushroom", "mug"):
            card = cards.get(f"{bench}/{piece}{suffix}")
            if card:
                c = card["calibration"]
                errors = f"{c['error_before']:.3f}, {c['error_after']:.3f}"
                numbers = f"{c['temperature']:.2f} | {c['bias']:+.2f} | {c['prior']:.3f} | {errors}"
                lines.append(f"| {piece}, {bench}, {card['modality']} | {numbers} |")
    return "\n".join(lines)


def model_cards() -> Json:
    """Return the cards of the shipped models, by bench and name."""
    found = {f"mixed/{path.stem}": path for path in MODELS.glob("*.json")}
    found |= {f"bench-v1/{path.stem}": path for path in (MODELS / "bench-v1").glob("*.json")}
    return {name: json.loads(path.read_text("utf-8")) for name, path in found.items()}


def guarded(answer: Json) -> str:
    """Return the alarms of a guard, and the outcomes in the second world."""
    known = ", ".join(f"{count} {piece}" for piece, count in sorted(answer["calibration"].items()))
    there = answer["elsewhere"]
    counts = [
        ", ".join(f"{there[key][word]} {word.replace('_', ' ')}" for word in sorted(there[key]))
        for key in ("outcomes", "before_alarm")
    ]
    text = (
        f"Calibration on {answer['bench']}: trials with {known}. Trials in the second world: "
        f"{counts[0]}; those before the alarms: {counts[1] or 'none'}. Sources of the jobs: "
        f"`{answer['code']}`."
    )
    table = markdown([guard_table(answer)]).partition("\n\n")[2].strip()
    return f"{table}\n\n{text}"


def rendered(name: str, answer: Json) -> str:
    if name == CALIBRATIONS:
        return calibrations(answer)
    if answer["format"].startswith("touchdown-guard"):
        return guarded(answer)
    if answer["format"].startswith("touchdown-tables"):
        return stability(answer)
    if "fresh" in name:
        return fresh(answer)
    if answer.get("changes") or answer.get("of_ceiling"):
        return compared(answer)
    table = statics(answer) if "statics" in name else loops(answer)
    return f"{table}\n\n{_provenance(answer)}" if "sources" in answer else table


def fresh(answer: Json) -> str:
    """Return the counts on fresh outlines: a row for each piece, each class, and all of them."""
    lines = [
        "| | trials | placed, % | unsafe, % of the trials | unsafe, % of the releases |",
        "|---|---|---|---|---|",
    ]
    rows = [(cell["piece"], cell) for cell in answer["cells"]]
    pooled = [row for row in answer["pooled"] if row["tower"] == "fresh"]
    rows += [(row["outline"], row) for row in pooled if "outline" in row]
    rows += [("**all**", row) for row in pooled if "outline" not in row]
    for name, row in rows:
        counts = [row[key] for key in ("placed", "unsafe", "unsafe_of_released")]
        shares = " | ".join(_share(round(c["value"] * c["n"]), c["n"]) for c in counts)
        lines.append(f"| {name} | {counts[0]['n']} | {shares} |")
    return "\n".join([*lines, "", _provenance(answer)])


def written(page: str, answers: dict[str, Json]) -> str:
    for name, answer in answers.items():
        block = re.compile(rf"(<!-- {name} -->\n).*?(\n<!-- end -->)", re.DOTALL)
        made = rendered(name, answer)
        page, count = block.subn(lambda m, made=made: m[1] + made + m[2], page)
        if count != 1:
            raise ValueError(f"{count} places for the table {name}")
    return page


def named(page: str) -> dict[str, Json]:
    """Return the results that the page has places for."""
    names = [name for name in re.findall(r"<!-- ([\w-]+) -->\n", page) if name != "end"]
    return {
        name: model_cards()
        if name == CALIBRATIONS
        else json.loads((DOCS / "results" / f"{name}.json").read_text("utf-8"))
        for name in names
    }


if __name__ == "__main__":
    for path in PAGES:
        text = path.read_text("utf-8")
        path.write_text(written(text, named(text)), "utf-8")
        sys.stdout.write(f"{path}\n")
