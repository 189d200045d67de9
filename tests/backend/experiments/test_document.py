"""Report pages equal their golden files.

After an intended change of a page run this file with ``REWRITE_GOLDEN=1`` and read the difference.
"""

from __future__ import annotations

import json
import os
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from tests.backend.experiments.test_tables import facts, page
from touchdown.backend.cli.command_line import main
from touchdown.backend.core import InputError, Outcome
from touchdown.backend.experiments.comparison import comparison_report
from touchdown.backend.experiments.document import Report, ReportSection, ReportTable, report_page
from touchdown.backend.experiments.results import read_report, report_of

ROOT = Path(__file__).resolve().parents[3]
RESULTS, GOLDEN = ROOT / "docs" / "results", ROOT / "tests" / "data" / "golden" / "reports"


def assert_golden(path: Path, text: str) -> None:
    if os.environ.get("REWRITE_GOLDEN"):
        path.write_text(text, "utf-8")
    assert path.read_text("utf-8") == text


@pytest.mark.parametrize("name", ["beyond-statics-pot", "beyond-towers"])
def test_the_comparison_of_strategies_has_its_page(name: str) -> None:
    answer = json.loads((RESULTS / f"{name}.json").read_bytes())
    assert_golden(GOLDEN / f"{name}.html", report_page(comparison_report(answer)))


def test_the_report_of_two_runs(tmp_path: Path) -> None:
    text = page(tmp_path, facts(probes=2), facts(Outcome.FELL, probes=1)[:-1])
    text, written = re.subn(r"on [\d-]+ at [\d:]+ by touchdown \S+</p>", "on DATE</p>", text)
    assert written == 1
    assert_golden(GOLDEN / "runs.html", text)


Json = dict[str, Any]
FULL = RESULTS / "tables-full.json"


@pytest.fixture(scope="module")
def full() -> Json:
    found: Json = json.loads(FULL.read_bytes())
    return found


def grid_of(report: Report, title: str) -> ReportTable:
    section = section_of(report, title)
    grid = section.parts[0]
    assert isinstance(grid, ReportTable)
    return grid


def section_of(report: Report, title: str) -> ReportSection:
    return next(section for section in report.sections if section.title.startswith(title))


def compared(strategy: str, bottom: str, **outcomes: int) -> Json:
    n = sum(outcomes.values())
    unsafe = outcomes.get("fell", 0) + outcomes.get("knocked_over", 0)
    rate = {"low": 0.1, "high": 0.9, "n": n}
    return {
        "strategy": strategy,
        "piece": "pot",
        "bottom": bottom,
        "placed": {"value": outcomes["placed"] / n, **rate},
        "unsafe": {"value": unsafe / n, **rate},
        "outcomes": outcomes,
        "probes": 3.0,
        "excess_probes_median": 1.0,
        "seed": 7,
        "jobs": ["a" * 32, "b" * 32],
    }


def answer(*cells: Json, bench: str = "") -> Json:
    return {
        "format": "touchdown-beyond/2",
        "bench_sha256": bench,
        "code": "1",
        "models": {"pot": "c" * 32},
        "cells": list(cells),
        "pooled": [],
    }


def test_the_paper_stands_below_each_value_and_the_job_with_it(full: Json) -> None:
    grid = grid_of(report_of(full), "Table 1")
    name, entries = grid.rows[0]
    assert name == "FT"
    assert entries[0].value == f"{100 * full['table1'][0]['cells'][0]['value']:.1f}"
    assert entries[0].notes == ("paper 27.4",)
    assert entries[0].jobs == (full["table1"][0]["cells"][0]["job"],)
    assert len(entries) == len(grid.columns) == 7


def test_comparisons_stand_side_by_side_and_name_the_jobs_of_their_cells(full: Json) -> None:
    small = compared("fused", "short", placed=1, fell=1)
    large = compared("fused", "short", placed=6, fell=2, gave_up=2)
    tower = compared("pressure", "short+long", placed=3, aborted=1)
    report = report_of({**full, "beyond": [answer(small, tower), answer(large)]})
    found = [s for s in report.sections if s.title.startswith("Strategies")]
    assert [s.title for s in found] == ["Strategies: fused, pressure"]
    assert "networks: pot cccccccc" in found[0].text[1]
    grid = found[0].parts[0]
    assert isinstance(grid, ReportTable)
    rows = dict(grid.rows)
    assert list(rows) == ["fused pot short", "pressure pot short+long"]
    placed = rows["fused pot short"][1]
    assert placed.value == "60.0 (10.0 to 90.0)"
    assert placed.trace == f"job {'a' * 32} and 1 more, seed 7"
    assert rows["fused pot short"][4].value == "placed 6, fell 2, gave up 2"
    assert rows["pressure pot short+long"][1].value.startswith("75.0")


def test_without_a_comparison_there_are_no_columns_by_strategy(full: Json) -> None:
    bare = {key: value for key, value in full.items() if key != "beyond"}
    assert not [s for s in report_of(bare).sections if s.title.startswith("Strategies")]


class Tags(HTMLParser):
    """Names of elements that were opened and not closed."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "br", "image", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_is_whole_needs_nothing_and_says_every_cell_of_the_report(full: Json) -> None:
    report = report_of({**full, "code": "<1>"})
    page = report_page(report)
    tags = Tags()
    tags.feed(re.sub(r"<(path|rect|circle|polyline|polygon|image)[^>]*/>", "", page))
    assert tags.open == []
    assert "program &lt;1&gt;" in page
    assert not re.findall(r"(?:href|src)=\"(?!data:)", page)
    for section in report.sections:
        for part in section.parts:
            if isinstance(part, ReportTable):
                for _, entries in part.rows:
                    assert all(f">{entry.value}<" in page for entry in entries)
            else:
                assert all(picture.svg in page for picture in part.pictures)


def test_the_published_report_is_what_its_data_give_and_names_a_job_for_every_cell() -> None:
    found, report = read_report(FULL)
    assert_golden(FULL.with_suffix(".html"), report_page(report))
    cells = [
        c for table in ("table1", "table2", "table3") for row in found[table] for c in row["cells"]
    ]
    assert len(cells) == 36 + 30 + 15
    assert all(re.fullmatch("[0-9a-f]{32}", cell["job"]) and cell["seed"] for cell in cells)
    titles = [section.title for section in report.sections]
    assert {"Table 3: stacking", "Belief maps by probe"} <= set(titles)
    assert any(title.startswith("Strategies: ") for title in titles)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"\x00\xff{", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b"[]", "not a report"),
        (b'{"format": "touchdown-beyond/2"}', "format is 'touchdown-beyond/2'"),
        (b'{"format": "touchdown-tables/1"}', "damaged .KeyError"),
    ],
)
def test_a_file_that_is_no_report_is_one_clear_error(
    tmp_path: Path, content: bytes, says: str
) -> None:
    path = tmp_path / "tables.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=says) as caught:
        read_report(path)
    assert caught.value.where == str(path)


def damaged(value: object, at: int) -> tuple[object, int]:
    """Return ``value`` with the ``at``-th leaf replaced by a wrong one, and how many it has."""
    if isinstance(value, dict):
        made: object = {}
        for key, inner in value.items():
            made[key], at = damaged(inner, at)  # type: ignore[index]
        return made, at
    if isinstance(value, list):
        items = []
        for inner in value:
            item, at = damaged(inner, at)
            items.append(item)
        return items, at
    return ({"wrong": []} if at == 0 else value), at - 1


def test_whatever_is_damaged_it_is_told_or_does_not_matter(full: Json, tmp_path: Path) -> None:
    shortest = min(full["beyond"], key=lambda answer: len(json.dumps(answer)))
    small = {**full, "figures": {}, "beyond": [shortest]}
    leaves = -damaged(small, 0)[1]
    path = tmp_path / "tables.json"
    refused = 0
    for at in range(0, leaves, leaves // 25):
        path.write_text(json.dumps(damaged(small, at)[0]), encoding="utf-8")
        try:
            read_report(path)
        except InputError:
            refused += 1
    assert refused > 5


@pytest.mark.parametrize(
    "inside",
    [
        "<script>alert(1)</script>",
        '<rect onclick="alert(1)"/>',
        '<image href="file:///etc/hostname"/>',
        '<rect fill="url(http://elsewhere)"/>',
        "<rect>",
        "</svg></div><svg>",
    ],
)
def test_a_film_of_a_foreign_file_only_draws(full: Json, inside: str) -> None:
    def film(svg: str) -> Json:
        return {"title": "Pot", "end": "", "probes": [{"svg": svg, "why": "<b>"}]}

    fine = {"films": [film('<svg width="9"><rect fill="#123456"/></svg>')]}
    assert "&lt;b&gt;" in report_page(report_of({**full, "figures": fine}))
    for svg in (f"<svg>{inside}</svg>", f'<!DOCTYPE svg [<!ENTITY a "b">]><svg>{inside}</svg>'):
        with pytest.raises(ValueError, match="drawing"):
            report_of({**full, "figures": {"films": [film(svg)]}})


def test_the_page_is_written_anew_with_comparisons_of_its_own_bench(
    full: Json, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, other = tmp_path / "mine.json", tmp_path / "beyond.json"
    file.write_text(json.dumps({**full, "figures": {}}), encoding="utf-8")
    cell = compared("looking", "long", placed=2, gave_up=1)
    words = ["experiment", "report", "--tables", str(file), "--beyond", str(other)]
    other.write_text(json.dumps(answer(cell, bench="0" * 64)), encoding="utf-8")
    before = file.read_bytes()
    assert main(words) == 2
    assert "another bench" in capsys.readouterr().err
    assert file.read_bytes() == before
    other.write_text(json.dumps(answer(cell, bench=full["bench_sha256"])), encoding="utf-8")
    assert main(words) == 0
    assert "looking" in file.with_suffix(".html").read_text("utf-8")
    assert main(["experiment", "report", "--tables", str(file)]) == 0
    assert [a["cells"] for a in json.loads(file.read_bytes())["beyond"]] == [[cell]]
