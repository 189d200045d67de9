"""Nothing that a test of the window looks at may wait for the wall clock."""

import ast
import importlib
from pathlib import Path

import pytest

from tests.prompt_window import PACES
from touchdown.widgets.base.freshness import BUDGET_S

APP = Path(__file__).resolve().parents[2] / "app"


def compared(tree):
    """Names that a difference to an earlier ``now_s`` is compared with."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare) and isinstance(node.left, ast.BinOp):
            names = {n.id for n in ast.walk(node.left) if isinstance(n, ast.Name)}
            if isinstance(node.left.op, ast.Sub) and "now_s" in names:
                yield from (right.id for right in node.comparators if isinstance(right, ast.Name))


NO_PACE = {("touchdown.app.calibrate.presenter", "STANDINGS_S"),
           ("touchdown.app.collect.origin", "WINDOW_S"),
           ("touchdown.app.label.editing", "PAUSE_S")}  # fmt: skip
"""Compared likewise, but nothing is drawn by it at once."""


def test_every_pace_of_the_window_is_known():
    found = set()
    for path in APP.rglob("*.py"):
        text = path.read_text("utf-8")
        if "now_s -" in text:
            module = ".".join(("touchdown", *path.relative_to(APP.parent).with_suffix("").parts))
            found |= {(module, name) for name in compared(ast.parse(text))}
    assert found == NO_PACE | set(PACES.items())


def test_everything_is_due_at_every_turn(main):
    assert main.pump._budget_s == float("inf")
    assert [getattr(importlib.import_module(module), name) for module, name in PACES.items()] == [
        0.0
    ] * len(PACES)


@pytest.mark.usual_pace
def test_a_test_of_the_pace_has_the_one_of_its_users(main):
    assert main.pump._budget_s == BUDGET_S
    assert all(getattr(importlib.import_module(m), name) > 0.0 for m, name in PACES.items())
