"""Documents keep their word: links lead somewhere, examples name what exists, JSON is JSON."""

import ast
import importlib
import importlib.util
import json
import re
from pathlib import Path

import pytest

import touchdown as td
from tests.bench import figures
from tests.bench.run import MODULES
from tests.fusion_tables import CALIBRATIONS, PAGES, loops, named, written
from touchdown.backend.cli.command_line import VERBS
from touchdown.backend.cli.doctor.command import DoctorCheck

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
COMMANDS = (ROOT / "docs" / "command-line.md").read_text("utf-8")


def _name(path):
    return str(path.relative_to(ROOT))


def _blocks(text, language):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def _anchors(path):
    headings = re.findall(r"^#+ (.+)$", path.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", text).strip().lower().replace(" ", "-") for text in headings}


def test_the_glossary_has_at_most_60_terms():
    rows = re.findall(r"^\| (?!term \|)", (ROOT / "CONTEXT.md").read_text("utf-8"), re.MULTILINE)
    assert 30 < len(rows) <= 60


@pytest.mark.parametrize("path", DOCUMENTS, ids=_name)
def test_links_lead_somewhere(path):
    links = re.findall(r"\]\(([^)#\s]+)", path.read_text("utf-8"))
    local = [link for link in links if "://" not in link and not link.startswith("mailto:")]
    assert [link for link in local if not (path.parent / link).exists()] == []
    links = re.findall(r"\]\(([^)#\s:]*)#([^)\s]+)\)", path.read_text("utf-8"))
    missing = [
        f"{file}#{anchor}"
        for file, anchor in links
        if file.endswith(".md") and anchor not in _anchors((path.parent / file).resolve())
    ]
    assert missing == []


@pytest.mark.parametrize("path", DOCUMENTS, ids=_name)
def test_examples_name_what_exists(path):
    for block in _blocks(path.read_text("utf-8"), "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "touchdown":
                module = importlib.import_module(node.module)
                assert [a.name for a in node.names if not hasattr(module, a.name)] == []


@pytest.mark.parametrize("path", DOCUMENTS, ids=_name)
def test_named_paths_exist(path):
    named = re.findall(
        r"`((?:app|backend|docs|resources|tests|widgets)/[\w./-]+)`", path.read_text("utf-8")
    )
    assert [each for each in named if not (ROOT / each).exists()] == []


def test_json_examples_are_json_and_that_of_doctor_has_the_fields_of_a_check():
    examples = [json.loads(block) for block in _blocks(COMMANDS, "json")]
    assert len(examples) >= 5
    (example,) = [example for example in examples if "checks" in example]
    DoctorCheck(**example["checks"][0])


@pytest.mark.parametrize("path", DOCUMENTS, ids=_name)
def test_named_make_targets_exist(path):
    makefile = (ROOT / "Makefile").read_text("utf-8")
    code = "\n".join(
        re.findall(r"```console\n.*?```|`[^`\n]+`", path.read_text("utf-8"), re.DOTALL)
    )
    named = set(re.findall(r"(?:^|`)make ([a-z-]+)", code, re.MULTILINE))
    assert {t for t in named if not re.search(rf"^{t}:", makefile, re.MULTILINE)} == set()


def test_every_verb_stands_in_the_command_table():
    assert [
        verb for verb in VERBS if not re.search(rf"^\|.*`[^`\n]*\b{verb}\b", COMMANDS, re.M)
    ] == []


def test_every_row_of_a_list_has_tests_that_carry_its_id():
    rows = {
        name
        for page in ("faults.md", "window.md")
        for names in re.findall(
            r"^\| ([A-Z]\d+(?:, [A-Z]\d+)*) ",
            (ROOT / "docs" / page).read_text("utf-8"),
            re.MULTILINE,
        )
        for name in names.split(", ")
    }
    markers = {
        name
        for path in (ROOT / "tests").rglob("test_*.py")
        for names in re.findall(r"mark\.promise\(([^)]*)\)", path.read_text("utf-8"))
        for name in re.findall(r'"(\w+)"', names)
    }
    assert len(rows) >= 45 + 18 + 14
    assert rows == markers


def _measurements():
    """Return the names of the functions that ``make bench`` runs."""
    return {
        name
        for module in MODULES
        for path in [ROOT / f"{module.replace('.', '/')}.py"]
        for name in re.findall(r"@figure\(.*\)\ndef (\w+)", path.read_text("utf-8"))
    }


def test_every_figure_of_the_list_of_faults_is_measured_and_its_module_named():
    named = set(re.findall(r'"([a-z_]+)"', (ROOT / "docs" / "faults.md").read_text("utf-8")))
    assert len(named) >= 20
    assert named - _measurements() == set()


def test_the_page_of_figures_is_rendered_from_its_data():
    records, text = figures.read_records(), figures.PAGE.read_text("utf-8")
    assert figures.page(text, records) == text
    assert all(tuple(record) in (figures.KEYS, (*figures.KEYS, "seconds")) for record in records)
    assert {record["measure"] for record in records} - {""} <= _measurements()
    names = [(record["group"], record["figure"]) for record in records]
    assert len(names) == len(set(names))


def test_the_tables_of_results_are_rendered_from_their_data():
    tables = set()
    for path in PAGES:
        page = path.read_text("utf-8")
        answers = named(page)
        assert written(page, answers) == page, path
        tables |= set(answers)
    assert {"beyond-fused", "beyond-fused-statics", CALIBRATIONS} <= tables


def test_a_row_of_learned_fusion_counts_every_trial():
    outcomes = {"placed": 18, "fell": 1, "knocked_over": 1}
    cell = {"strategy": "fused", "piece": "pot", "bottom": "short", "probes": 4.0}
    row = loops({"cells": [{**cell, "outcomes": outcomes}]}).splitlines()[2]
    # Wilson's interval of 18 of 20 and of 2 of 20, from tables.
    assert row == (
        "| pot on Short | 20 | 90 (70 to 97) | 10 (3 to 30) | 18 / 1 / 1 / 0 / 0 | 4.0 |"
    )


def test_every_picture_of_a_state_is_one_that_is_made():
    text = (ROOT / "docs" / "window.md").read_text("utf-8").partition("## States of the pill")[2]
    made = "".join((ROOT / "tests" / n).read_text("utf-8")
                   for n in ("screens.py", "screen_panels.py", "screen_states.py"))  # fmt: skip
    names = re.findall(r"`([a-z-]+)`", text)
    assert len(names) >= 18
    assert [name for name in names if f'"{name}"' not in made] == []


@pytest.fixture(scope="module")
def pages():
    """Return the module that makes pages of the site."""
    spec = importlib.util.spec_from_file_location("pages", ROOT / "docs" / "_ext" / "pages.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_page_stands_in_one_list_of_the_site(pages):
    listed = [
        str((ROOT / "docs" / link).resolve().relative_to(ROOT))
        for title, text in pages.sections().items()
        if title
        for link in re.findall(r"^- \[[^]]+\]\(([^)#]+)\)", text, re.MULTILINE)
    ]
    decisions = (ROOT / "docs" / "decisions" / "README.md").read_text("utf-8")
    listed += [f"docs/decisions/{link}" for link in re.findall(r"\]\(([^)]+)\)", decisions)]
    assert sorted(listed) == sorted({*map(_name, DOCUMENTS)} - {"README.md", "docs/README.md"})


def test_the_page_of_arguments_names_every_verb_and_option(pages):
    page = pages.arguments_page()
    assert [verb for verb in VERBS if f"\ntouchdown {verb}\n---" not in page] == []
    assert ".. option:: --strategy {paper,paper-calibrated," in page
    assert page.count(".. option::") > 200


def test_the_page_of_settings_has_defaults_ranges_and_comments(pages):
    page = pages.settings_page()
    row = "``depth_mm``\n     - ``1.5``\n     - > 0, ≤ 100\n     - commanded travel after first"
    assert row in page
    assert "   * - ``least_x_mm``" in page


def test_the_page_of_the_api_names_every_public_name_once():
    listed = re.findall(r"^   (\w+)$", (ROOT / "docs" / "api.rst").read_text("utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(set(td.__all__) - {"__version__"})


@pytest.mark.parametrize("path", EXAMPLES, ids=_name)
def test_an_example_has_a_title_a_text_a_picture_and_public_names(path):
    tree = ast.parse(path.read_text("utf-8"))
    title, line, text = ast.get_docstring(tree).split("\n", 2)
    assert line == "=" * len(title)
    assert len(text.strip()) > 40
    nodes = list(ast.walk(tree))
    assert any(ast.unparse(n) == "plt.show()" for n in nodes if isinstance(n, ast.Expr))
    used = {n.attr for n in nodes if isinstance(n, ast.Attribute) and ast.unparse(n.value) == "td"}
    assert used <= set(td.__all__)
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module.startswith("touchdown"):
            public = importlib.import_module(node.module).__all__
            assert {alias.name for alias in node.names} <= set(public)


def test_the_gallery_has_a_dozen_examples():
    assert len(EXAMPLES) >= 12
