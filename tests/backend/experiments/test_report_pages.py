"""Report pages and Markdown tables equal their golden files.

After an intended change of a page run this file with ``REWRITE_GOLDEN=1`` and read the difference.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from tests.backend.experiments.test_report import facts, page
from touchdown.backend.core.values import Outcome
from touchdown.backend.experiments.comparison import comparison_report, comparison_tables
from touchdown.backend.experiments.document import report_page, to_markdown
from touchdown.backend.experiments.results import read_report
from touchdown.backend.experiments.sensitivity import sensitivity_report

ROOT = Path(__file__).resolve().parents[3]
RESULTS, GOLDEN = ROOT / "docs" / "results", ROOT / "tests" / "data" / "golden" / "reports"


def assert_golden(path: Path, text: str) -> None:
    if os.environ.get("REWRITE_GOLDEN"):
        path.write_text(text, "utf-8")
    assert path.read_text("utf-8") == text


def test_the_published_tables_page_is_rendered_from_its_data() -> None:
    report = read_report(RESULTS / "tables-full.json")[1]
    assert_golden(RESULTS / "tables-full.html", report_page(report))


def test_the_published_sensitivity_page_is_rendered_from_its_data() -> None:
    answer = json.loads((RESULTS / "sensitivity-pot.json").read_bytes())
    assert_golden(RESULTS / "sensitivity-pot.html", report_page(sensitivity_report(answer)))


@pytest.mark.parametrize("name", ["beyond-statics-pot", "beyond-towers"])
def test_the_comparison_of_strategies_has_its_page_and_its_tables(name: str) -> None:
    answer = json.loads((RESULTS / f"{name}.json").read_bytes())
    assert_golden(GOLDEN / f"{name}.html", report_page(comparison_report(answer)))
    assert_golden(GOLDEN / f"{name}.md", to_markdown(comparison_tables(answer)))


def test_the_report_of_two_runs(tmp_path: Path) -> None:
    text = page(tmp_path, facts(probes=2), facts(Outcome.FELL, probes=1)[:-1])
    assert_golden(GOLDEN / "runs.html", text)
