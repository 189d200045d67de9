"""Whether a small experiment promises what a large one found: are its intervals wide enough?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

Answer = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Within:
    """``cells`` compared, and the names of those whose 95 % interval misses the other's value."""

    cells: int
    outside: tuple[str, ...]

    @property
    def share(self) -> float:
        """Return the share of cells that agree; 1 without any."""
        return 1.0 - len(self.outside) / self.cells if self.cells else 1.0


def within(small: Answer, large: Answer) -> Within:
    """Compare the cells that two contents of ``tables.json`` have in common."""
    values = dict(_rates(large))
    outside, count = [], 0
    for name, rate in _rates(small):
        other = values.get(name)
        if other is not None:
            count += 1
            if not rate["low"] <= other["value"] <= rate["high"]:
                outside.append(name)
    return Within(count, tuple(outside))


def _rates(answer: Answer) -> Iterator[tuple[str, Mapping[str, float]]]:
    """Yield each cell that has a value, by a name that says table, row, piece and bottom."""
    rows = {"table1": ("metric", "model"), "table2": ("method",), "table3": ("strategy", "tower")}
    for table, keys in rows.items():
        for row in answer[table]:
            named = " ".join(str(row[key]) for key in keys)
            for cell in row["cells"]:
                rate = cell.get("accuracy", cell) if table == "table2" else cell
                if rate.get("value") is not None:
                    where = f"{cell.get('piece', '')} {cell.get('bottom', '')}"
                    yield f"{table} {named} {where}", rate
