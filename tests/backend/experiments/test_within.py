"""Intervals of a small experiment against the values of a large one."""

from __future__ import annotations

from typing import Any

import pytest

from touchdown.backend.experiments.statistics import compare_intervals


def tables(iou: float, right: float, placed: float, half: float) -> dict[str, Any]:
    """Return tables of one cell each, their intervals ``half`` to both sides."""

    def rate(value: float) -> dict[str, Any]:
        return {"value": value, "low": value - half, "high": value + half, "n": 40}

    where = {"piece": "pot", "bottom": "short"}
    empty = {"piece": "pot", "bottom": "long", "value": None, "low": None, "high": None, "n": 0}
    return {
        "table1": [{"metric": "iou", "model": "FT", "cells": [{**where, **rate(iou)}, empty]}],
        "table2": [{"method": "1", "cells": [{**where, "accuracy": rate(right)}, {**where}]}],
        "table3": [
            {"strategy": "paper", "tower": "one", "cells": [{**where, **rate(placed)}]},
            {"strategy": "paper", "tower": "two", "cells": []},
        ],
    }


def test_cells_whose_interval_misses_the_value_are_named() -> None:
    found = compare_intervals(tables(0.5, 0.6, 0.7, 0.1), tables(0.59, 0.6, 0.85, 0.01))
    assert found.cells == 3
    assert found.outside == ("table3 paper one pot short",)
    assert found.share == pytest.approx(2 / 3)


def test_the_width_of_the_small_one_decides() -> None:
    narrow, wide = tables(0.5, 0.6, 0.7, 0.01), tables(0.55, 0.65, 0.75, 0.1)
    assert len(compare_intervals(narrow, wide).outside) == 3
    assert compare_intervals(wide, narrow).outside == ()
