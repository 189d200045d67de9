"""Render the tables of docs/learned-fusion.md: ``python -m tests.fusion_tables``.

Each table is between ``<!-- NAME -->`` and ``<!-- end -->`` and shows the comparison
``docs/results/NAME.json``.
"""

import json
import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from touchdown.backend.experiments.statistics import estimate_rate

PAGE = Path(__file__).parents[1] / "docs" / "learned-fusion.md"
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


def loops(answer: Json) -> str:
    """Return the counts of trials: a row for each cell, each piece, and all of them."""
    cells = [cell for cell in answer["cells"] if cell["strategy"] == "fused"]
    pieces = sorted({cell["piece"] for cell in cells}, reverse=True)
    lines = [
        "| | trials | placed, % | unsafe, % | placed / fell / knocked over / gave up / aborted "
        "| probes of the placed |",
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


def written(page: str, answers: dict[str, Json]) -> str:
    for name, answer in answers.items():
        kind = statics if "statics" in name else loops
        block = re.compile(rf"(<!-- {name} -->\n).*?(\n<!-- end -->)", re.DOTALL)
        made = kind(answer)
        page, count = block.subn(lambda m, made=made: m[1] + made + m[2], page)
        if count != 1:
            raise ValueError(f"{count} places for the table {name}")
    return page


def named(page: str) -> dict[str, Json]:
    """Return the comparisons that the page has places for."""
    names = re.findall(r"<!-- ([\w-]+) -->\n", page)
    folder = PAGE.parent / "results"
    return {
        name: json.loads((folder / f"{name}.json").read_text("utf-8"))
        for name in names
        if name != "end"
    }


if __name__ == "__main__":
    text = PAGE.read_text("utf-8")
    PAGE.write_text(written(text, named(text)), "utf-8")
    sys.stdout.write(f"{PAGE}\n")
