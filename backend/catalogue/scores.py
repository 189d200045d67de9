"""What a job computed about episodes: scores that order queues, and offsets a model suggests.

Written by whoever runs the model, with the hash of its weights; never a label by itself.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

from backend.catalogue.database import Database
from backend.catalogue.values import Label, Revision
from backend.core.faults import InputError

SCORES = ("doubt", "disagreement", "uncertainty", "duplicates")
"""``doubt``: how much likelier the signals are a few mm away. ``duplicates``: how far the
label lies off those of the most alike signals, in what is usual among them."""

MODEL = "model:"


@dataclass(frozen=True, slots=True)
class Suggestion:
    """The offset a model would give; ``source`` is ``model:<sha256 of its weights>``."""

    label: Label
    source: str
    at_ns: int


class Scores:
    """Scores and suggestions of one dataset; the newest of each kind per episode."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def put(self, name: str, values: Mapping[str, float], model: str) -> None:
        """Store a score for many episodes, as computed for their present labels by ``model``."""
        if name not in SCORES:
            raise InputError(f"There is no score '{name}'.", "score", f"Use {', '.join(SCORES)}.")
        now = time.time_ns()
        rows = [(name, value, model, now, episode) for episode, value in values.items()]
        with self._database.transaction() as connection:
            connection.executemany(
                "INSERT OR REPLACE INTO score (name, episode, value, model, rev_uuid, at_ns)"
                " SELECT ?, h.episode, ?, ?, h.rev_uuid, ? FROM label_head h WHERE h.episode = ?",
                rows,
            )

    def of(self, uuid: str) -> dict[str, float]:
        """Return the scores of an episode by name."""
        return dict(self._database.rows("SELECT name, value FROM score WHERE episode = ?", (uuid,)))

    def of_revision(self, name: str, uuid: str) -> tuple[str, float] | None:
        """Return a score with the revision for which it was computed, None without one."""
        row = self._database.first(
            "SELECT rev_uuid, value FROM score WHERE name = ? AND episode = ?", (name, uuid)
        )
        return None if row is None else (str(row[0]), float(row[1]))

    def suggest(self, labels: Mapping[str, Label], model: str) -> None:
        """Store the offsets that ``model`` (hash of its weights) gives, with their sigma."""
        now = time.time_ns()
        rows = [
            (uuid, label.x_um, label.y_um, label.theta_mdeg, label.sigma_um, model, now)
            for uuid, label in labels.items()
        ]
        with self._database.transaction() as connection:
            connection.executemany(
                "INSERT OR REPLACE INTO suggestion VALUES (?, ?, ?, ?, ?, ?, ?)", rows
            )

    def suggestion(self, uuid: str) -> Suggestion | None:
        """Return what a model suggests for an episode, or None."""
        row = self._database.first(
            "SELECT x_um, y_um, theta_mdeg, sigma_um, model, at_ns FROM suggestion"
            " WHERE episode = ?",
            (uuid,),
        )
        return None if row is None else Suggestion(Label(*row[:4]), f"{MODEL}{row[4]}", row[5])


def disagreement(head: Revision, suggestion: Suggestion) -> float | None:
    """Return the distance of label and suggestion in standard uncertainties; None without both."""
    a, b = head.label, suggestion.label
    if a.x_um is None or a.y_um is None or b.x_um is None or b.y_um is None:
        return None
    sigma = ((a.sigma_um or 0) ** 2 + (b.sigma_um or 0) ** 2) ** 0.5
    if not sigma:
        return None
    return float(((a.x_um - b.x_um) ** 2 + (a.y_um - b.y_um) ** 2) ** 0.5 / sigma)
