"""Tags ``split:<side>``, by which a person says on which side of a split an episode is."""

from __future__ import annotations

from backend.catalogue.database import Database

SPLIT_TAG = "split:"


def tagged_sides(database: Database) -> dict[str, str]:
    """Return the side of every tagged episode."""
    rows = database.rows(
        "SELECT episode, name FROM mark WHERE present AND name LIKE ?", (f"{SPLIT_TAG}%",)
    )
    return {episode: name.removeprefix(SPLIT_TAG) for episode, name in rows}
