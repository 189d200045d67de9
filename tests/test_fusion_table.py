"""The tables of docs/learned-fusion.md are those of the results beside it."""

from __future__ import annotations

from tests.fusion_tables import PAGE, loops, named, written


def test_the_page_shows_what_the_results_hold() -> None:
    page = PAGE.read_text("utf-8")
    answers = named(page)
    assert {"beyond-fused", "beyond-fused-statics"} <= set(answers)
    assert written(page, answers) == page


def test_a_row_counts_every_trial() -> None:
    outcomes = {"placed": 18, "fell": 1, "knocked_over": 1}
    cell = {"strategy": "fused", "piece": "pot", "bottom": "short", "probes": 4.0}
    row = loops({"cells": [{**cell, "outcomes": outcomes}]}).splitlines()[2]
    # Wilson's interval of 18 of 20 and of 2 of 20, from tables.
    assert row == (
        "| pot on Short | 20 | 90 (70 to 97) | 10 (3 to 30) | 18 / 1 / 1 / 0 / 0 | 4.0 |"
    )
